"""Latencies, late readings and replay scores, against numpy, definitions, and by hand."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from graspd.daemon.judge.reasons import Decision, GateState, Reason
from graspd.daemon.publish.messages import Verdict
from graspd.daemon.publish.outbox import BUCKETS, Deadlines, LatencyHistogram
from graspd.daemon.run.summary import RunSummary, Tally
from graspd.daemon.trust.lift_book import GraspId
from tests.daemon.fakes import MS, reading
from tests.kit.messages import GOLDEN_VERDICT

PERIOD_NS = 10 * MS


@pytest.mark.parametrize("seed", range(3))
def test_quantiles_are_right_to_two_percent(seed: int) -> None:
    durations_us = np.random.default_rng(seed).lognormal(5.0, 1.5, 5000)
    histogram = LatencyHistogram()
    for duration_us in durations_us:
        histogram.add(float(duration_us))
    for fraction in (0.01, 0.5, 0.99, 0.999):
        exact = np.quantile(durations_us, fraction, method="inverted_cdf")
        assert histogram.quantile_us(fraction) == pytest.approx(exact, rel=0.0201)
    assert histogram.max_us == durations_us.max()
    assert histogram.count == 5000


def test_extreme_durations_stay_in_the_histogram() -> None:
    histogram = LatencyHistogram()
    assert histogram.quantile_us(0.5) == 0.0
    for duration_us in (0.0, 1e-9, 1e20):
        histogram.add(duration_us)
    assert histogram.quantile_us(1.0) > 9.9e7
    assert len(histogram.buckets) == BUCKETS


@pytest.mark.parametrize(
    ("times_ms", "counted", "longest_us"),
    [
        ({0: 100, 1: 110, 2: 121, 3: 130}, 3, 1000.0),
        ({0: 100, 2: 120, 3: 130}, 1, 0.0),
        ({0: 100, 1: 110, 2: 3110, 3: 3120}, 2, 0.0),
    ],
    ids=["distance from the period", "lost reading", "outage"],
)
def test_jitter_leaves_out_lost_readings_and_outages(
    times_ms: dict[int, int], counted: int, longest_us: float
) -> None:
    deadlines = Deadlines()
    for seq, t_ms in times_ms.items():
        deadlines.add(reading(t_ms * MS, seq=seq), 0.5, PERIOD_NS)
    assert deadlines.jitter.count == counted
    assert deadlines.jitter.max_us == pytest.approx(longest_us)


@pytest.mark.parametrize(("period_ns", "late", "counted"), [(PERIOD_NS, 1, 3), (None, 0, 0)])
def test_a_verdict_older_than_a_period_is_late(
    period_ns: int | None, late: int, counted: int
) -> None:
    deadlines = Deadlines()
    for seq, age_ms in enumerate((0.5, 10.0, 10.5, 2.0)):
        deadlines.add(reading(seq * PERIOD_NS, seq=seq), age_ms, period_ns)
    assert (deadlines.late, deadlines.jitter.count) == (late, counted)
    assert deadlines.worst_age_ms == 10.5


def verdict(outcome: Decision) -> Verdict:
    reasons = [Reason.STALE] if outcome is Decision.UNKNOWN else []
    return msgspec.structs.replace(
        GOLDEN_VERDICT, verdict=outcome, reasons=reasons, grasp=1, gate=None
    )


def test_scores_follow_their_definitions_with_slip_positive() -> None:
    summary = RunSummary()
    cases = [
        (Decision.SLIP, True, 8),
        (Decision.STABLE, True, 2),
        (Decision.SLIP, False, 1),
        (Decision.STABLE, False, 9),
        (Decision.UNKNOWN, True, 3),
        (Decision.STABLE, None, 5),
    ]
    for outcome, slipped, number in cases:
        for _ in range(number):
            summary.add(verdict(outcome), slipped)
    # By hand: precision 8/9, recall 8/10, F1 their harmonic mean, accuracy 17/20.
    assert summary.tally.scores() == pytest.approx(
        {"accuracy": 0.85, "precision": 8 / 9, "recall": 0.8, "f1": 2 / (9 / 8 + 10 / 8)}
    )
    assert summary.tally.labelled == 23
    assert summary.as_dict(1.0, None)["judged_and_labelled"] == 20
    assert summary.as_dict(1.0, None)["reasons"] == {"stale": 3}


@pytest.mark.parametrize(("slipped", "scores"), [(None, None), (False, {"accuracy": 1.0})])
def test_scores_that_cannot_be_computed_are_left_out(
    slipped: bool | None, scores: dict[str, float] | None
) -> None:
    summary = RunSummary()
    summary.add(verdict(Decision.STABLE), slipped)
    assert summary.tally.scores() == scores
    assert any("recorded" in line for line in summary.lines(1.0, None)) is (scores is not None)


def test_coverage_and_shares_of_slips_match_a_count_by_hand() -> None:
    tally = Tally()
    cases = [
        (Decision.STABLE, False, 60),
        (Decision.STABLE, True, 4),
        (Decision.STABLE, False, 30),
        (Decision.SLIP, True, 10),
        (Decision.SLIP, False, 5),
        (Decision.UNKNOWN, True, 6),
        (Decision.UNKNOWN, False, 5),
    ]
    for decision, slipped, number in cases:
        for _ in range(number):
            tally.add(decision, (), slipped)
    assert tally.stable == (94, 4)
    # By hand: 90 of 100 good lifts, 4 of 20 slips; four in a row are in one window of 50.
    assert tally.worth() == pytest.approx(
        {
            "coverage": 0.9,
            "slips_among_stable": 4 / 94,
            "worst_window": 0.08,
            "slips_called_stable": 0.2,
            "stable_called_slip": 0.05,
        }
    )


def test_an_outcome_reported_later_counts_like_a_recorded_one() -> None:
    early, late = RunSummary(), RunSummary()
    for grasp, slipped in enumerate((True, False, True, False), 1):
        said = verdict(Decision.STABLE if grasp < 3 else Decision.SLIP)
        said = msgspec.structs.replace(said, grasp=grasp)
        early.add(said, slipped)
        late.add(said, None)
        late.outcome(GraspId(said.boot_id, grasp), slipped=slipped)
        # Told twice: the first counts.
        late.outcome(GraspId(said.boot_id, grasp), slipped=not slipped)
    assert late.tally.labelled == 4
    assert late.tally.as_dict() == early.tally.as_dict()


def test_equal_grasp_numbers_of_two_starts_are_two_grasps() -> None:
    summary = RunSummary()
    for boot in "ab":
        said = verdict(Decision.STABLE)
        summary.add(
            msgspec.structs.replace(said, boot_id=boot * 32, gate=GateState.JUDGED, judged=True),
            None,
        )
    assert (summary.grasps, summary.again) == (2, 0)
    summary.outcome(GraspId("c" * 32, 1), slipped=True)
    assert summary.tally.labelled == 0
    summary.outcome(GraspId("a" * 32, 1), slipped=False)
    assert (summary.tally.held, summary.tally.slipped) == (1, 0)
