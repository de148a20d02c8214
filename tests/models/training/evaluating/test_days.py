"""Other days: judged exactly as the daemon judges them, and counted as what they came to."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("torch", reason="needs the extra `train`")

from graspd.daemon.judge.calibration import SessionCalibration
from graspd.daemon.judge.network import Plausibility
from graspd.models.contract import SessionInput, Sharpness
from graspd.models.inputs import SessionBuilder
from graspd.models.training.data.protocols import splits
from graspd.models.training.evaluating import jobs
from graspd.models.training.evaluating.days import CALIBRATED_FROM, Day, SessionDay
from graspd.models.training.evaluating.jobs import Job, JobResult
from graspd.models.training.evaluating.summaries import VerdictFigures, day_figures
from graspd.models.training.fitting.standards import PRIOR_GRASPS
from graspd.models.training.fitting.trained import Trained, train
from graspd.models.training.systems.registry import SYSTEMS
from tests.models.training.samples import sessions

GRASPS = sessions(160)
NOTHING = np.zeros((3, 24), np.bool_)
CLIP = 3.0


@pytest.fixture(scope="module")
def trained() -> Trained:
    return train(SYSTEMS["svm-session"], GRASPS.rows(GRASPS.rows_of(("palm_down",))), 0)


@pytest.fixture(scope="module")
def stream() -> NDArray[np.uint16]:
    """A drifted day, with broken electrodes, moved fingers and nonsense in it."""
    random = np.random.default_rng(0)
    counts = GRASPS.counts[GRASPS.rows_of(("palm_45",))].copy()
    for number, reading in enumerate(counts):
        if number % 9 == 1:
            places = random.choice(72, size=1 + number % 4, replace=False)
            reading.flat[places] = random.integers(200, 4000, len(places))
        if number % 13 == 2:
            reading[number % 3] = np.clip(reading[number % 3].astype(int) + 400, 0, 4095)
        if number % 17 == 3:
            reading.flat[:] = random.permutation(reading.ravel())
    return counts


def test_a_session_is_judged_as_the_daemon_judges_it(
    trained: Trained, stream: NDArray[np.uint16]
) -> None:
    assert trained.standards is not None
    prior, day = trained.standards.prior, SessionDay(trained)
    wanted = SessionInput(
        mean=tuple(prior.mean.tolist()),
        spread=tuple(prior.spread.tolist()),
        clip=CLIP,
        prior_grasps=PRIOR_GRASPS,
        calibrated_from=float(CALIBRATED_FROM),
        sharpness=(Sharpness(0.0, 1.0),),
    )
    electrodes = Day(trained).electrodes
    session = SessionCalibration(wanted, electrodes.centre, electrodes.spread)
    daemon = Plausibility(("ff", "mf", "th"), electrodes)
    builder, expected = SessionBuilder(3, CLIP), np.empty(78, np.float32)
    refused_by_daemon = []
    for reading in stream:
        builder.use(session.now.features_mean, session.now.features_spread)
        examined = daemon.examine(reading, NOTHING, session.now)
        builder.build(examined.counts, expected)
        margin, refused = day.judge(reading)
        assert refused == bool(examined.reasons)
        assert margin == pytest.approx(trained.fitted.margins(expected[np.newaxis])[0], abs=1e-4)
        if examined.grasp is not None:
            session.observe(examined.grasp, slip=None if refused else margin > 0.0)
        assert day.session.grasps == session.grasps
        refused_by_daemon.append(refused)
    assert 10 < sum(refused_by_daemon) < len(stream) - 10
    assert 20 < session.grasps < len(stream)


def test_without_a_session_it_is_looked_at_as_the_daemon_does(stream: NDArray[np.uint16]) -> None:
    trained = train(SYSTEMS["svm"], GRASPS.rows(GRASPS.rows_of(("palm_down", "palm_45"))), 0)
    day = Day(trained)
    daemon = Plausibility(("ff", "mf", "th"), day.electrodes)
    looks = [day.look(reading) for reading in stream]
    for reading, (counts, seen, _) in zip(stream, looks, strict=True):
        examined = daemon.examine(reading, NOTHING)
        assert seen != bool(examined.reasons)
        if seen:
            assert counts == pytest.approx(examined.counts, abs=1e-6)
    assert 10 < sum(seen for _, seen, _ in looks) < len(stream) - 10


def test_a_job_of_days_says_what_is_refused_and_how_old_the_session_was() -> None:
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
