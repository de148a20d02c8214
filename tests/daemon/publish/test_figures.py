"""Latency percentiles and replay scores, against numpy and scikit-learn's definitions."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.judge.reasons import Decision, Reason
from daemon.publish.latency import BUCKETS, LatencyHistogram
from daemon.publish.messages import DECISION_CODE, Verdict
from daemon.run.summary import Summary


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
    for duration_us in (0.0, 1e-9, 1e20):
        histogram.add(duration_us)
    assert histogram.quantile_us(1.0) > 9.9e7
    assert len(histogram.buckets) == BUCKETS


def test_an_empty_histogram_is_zero() -> None:
    assert LatencyHistogram().quantile_us(0.5) == 0.0


def verdict(outcome: Decision) -> Verdict:
    unknown = outcome is Decision.UNKNOWN
    return Verdict(
        boot_id="0",
        seq=0,
        t=0.0,
        t_mono_ns=0,
        grasp=1,
        verdict=outcome,
        verdict_code=DECISION_CODE[outcome],
        p_slip=None if unknown else 0.5,
        valid=not unknown,
        reasons=[Reason.STALE] if unknown else [],
        age_ms=0.0,
        latency_us=100.0,
        silence_ms=100.0,
        model="fake",
        model_sha="0",
    )


def test_scores_follow_their_definitions_with_slip_positive() -> None:
    summary = Summary()
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
    assert summary.as_dict(1.0)["judged_and_labelled"] == 20
    assert summary.as_dict(1.0)["reasons"] == {"stale": 3}


def test_no_labels_means_no_scores() -> None:
    summary = Summary()
    summary.add(verdict(Decision.STABLE), None)
    assert summary.tally.scores() is None
    assert not any("recorded" in line for line in summary.lines(1.0))


def test_a_score_without_a_denominator_is_left_out() -> None:
    summary = Summary()
    summary.add(verdict(Decision.STABLE), False)
    assert summary.tally.scores() == {"accuracy": 1.0}
