"""Other days: judged by the daemon's own judge, and counted as what they came to."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

from graspd.models.training.data.protocols import splits
from graspd.models.training.evaluating import jobs
from graspd.models.training.evaluating.jobs import Job, JobResult
from graspd.models.training.evaluating.summaries import VerdictFigures, day_figures
from graspd.models.training.systems.registry import SYSTEMS
from tests.models.training.samples import sessions

GRASPS = sessions(160)


def test_a_job_of_days_has_refusals_and_session_ages() -> None:
    result = jobs.run(Job(SYSTEMS["svm-session"], "days", 0, 1, 2), GRASPS)
    assert set(result.margins) == set(result.refused) == {"running", "running-sorted"}
    for ages in result.ages.values():
        assert sorted(ages.tolist()) == sorted({*ages.tolist()})  # one table, each grasp learned
    back = JobResult.from_bytes(result.to_bytes())
    assert all(np.array_equal(back.refused[name], result.refused[name]) for name in back.refused)
    assert list(jobs.run(Job(SYSTEMS["svm"], "days", 0, 1, 2), GRASPS).refused) == ["none"]


def test_verdicts_are_counted_by_what_they_cost() -> None:
    slipped = np.array([True] * 4 + [False] * 6)
    called = np.array([True, True, True, False, True, True, False, False, False, False])
    figures = VerdictFigures.of(called, slipped)
    assert figures.f1 == pytest.approx(2 * 3 / (2 * 3 + 1 + 2))
    assert figures.slips_among_stable == pytest.approx(1 / 5)
    assert figures.slips_called_stable == pytest.approx(1 / 4)
    assert figures.stable_called_slip == pytest.approx(2 / 6)
    nothing = VerdictFigures.of(np.array([], np.bool_), np.array([], np.bool_))
    assert (nothing.grasps, nothing.slips_among_stable) == (0, None)


def test_each_stream_is_counted_for_itself_and_the_refused_apart() -> None:
    truth = np.where(GRASPS.slipped, 1.0, -1.0)
    made = splits("days", GRASPS, 0, 2)
    results = []
    for split in made:
        wrong = split.name.startswith("B")
        refused = GRASPS.table_of[split.test] == 2
        margins = {"none": truth[split.test] * (-1.0 if wrong else 1.0)}
        results.append(JobResult(split.test, margins, 1, 1.0, 1, {}, {"none": refused}))
    found = day_figures("none", [results, results], GRASPS)
    assert [found[name].every.f1 for name in ("A palm_45", "B palm_down", "C palm_side")] == [
        1,
        0,
        1,
    ]
    assert found["A palm_45"].every.grasps == 320  # each once for each seed
    assert found["A palm_45"].coverage == 0.0
    assert found["A palm_45"].judged.slips_among_stable is None
    assert found["A palm_45"].refused_slipped == pytest.approx(GRASPS.slipped[320:].mean())
    assert found["A and C"].coverage == pytest.approx(2 / 3)
    assert found["B palm_side"].every.slips_called_stable == 1.0
    assert found["all"].every.slips_called_stable == pytest.approx(
        2
        * GRASPS.slipped[:320].sum()
        / (2 * (2 * GRASPS.slipped[:320].sum() + GRASPS.slipped[320:].sum()))
    )
