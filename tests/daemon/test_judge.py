"""The judge: sound readings get a verdict, everything else gets `unknown` with its reason."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from daemon.judge.decision import decide
from daemon.judge.health import REASON_OF_FAULT
from daemon.judge.verdict import ADVICE, Outcome, Reason
from drivers.base import ElectrodeFault, TactileReading
from models.contract import ModelError
from tests.daemon.fakes import FINGERS, HIGH, LOW, MARGIN, MS, Clock, FakeModel, pipeline, reading


@pytest.mark.parametrize(
    ("p_slip", "threshold", "outcome"),
    [
        (0.0, 0.5, Outcome.STABLE),
        (0.4999, 0.5, Outcome.STABLE),
        (0.5, 0.5, Outcome.SLIP),
        (1.0, 0.5, Outcome.SLIP),
        (0.3, 0.3, Outcome.SLIP),
        (None, 0.5, Outcome.UNKNOWN),
        (math.nan, 0.5, Outcome.UNKNOWN),
        (math.inf, 0.5, Outcome.UNKNOWN),
        (-math.inf, 0.5, Outcome.UNKNOWN),
        (-1e-9, 0.5, Outcome.UNKNOWN),
        (1.0000001, 0.5, Outcome.UNKNOWN),
    ],
)
def test_decision(p_slip: float | None, threshold: float, outcome: Outcome) -> None:
    assert decide(p_slip, [], threshold) is outcome


@pytest.mark.parametrize("reason", Reason)
def test_any_reason_makes_the_verdict_unknown(reason: Reason) -> None:
    assert decide(0.0, [reason], 0.5) is Outcome.UNKNOWN


def test_every_reason_says_what_to_do_and_every_fault_has_a_reason() -> None:
    assert set(ADVICE) == set(Reason)
    assert set(REASON_OF_FAULT) == {fault for fault in ElectrodeFault if fault}


@pytest.mark.parametrize(("p_slip", "outcome"), [(0.1, Outcome.STABLE), (0.9, Outcome.SLIP)])
def test_a_sound_reading_is_judged(p_slip: float, outcome: Outcome) -> None:
    clock = Clock()
    judgement = pipeline(FakeModel(p_slip), clock).judge(reading(clock()))
    assert judgement.outcome is outcome
    assert judgement.p_slip == p_slip
    assert judgement.reasons == ()
    assert judgement.grasp == 1


def test_each_reading_is_a_grasp_of_its_own() -> None:
    clock = Clock()
    judge = pipeline(FakeModel(), clock)
    assert [judge.judge(reading(clock(), seed)).grasp for seed in range(3)] == [1, 2, 3]


@pytest.mark.parametrize("fault", [fault for fault in ElectrodeFault if fault])
def test_one_flagged_electrode_makes_the_verdict_unknown(fault: ElectrodeFault) -> None:
    clock, model = Clock(), FakeModel()
    bad = reading(clock())
    bad.faults[2, 23] = fault
    judgement = pipeline(model, clock).judge(bad)
    assert judgement.outcome is Outcome.UNKNOWN
    assert judgement.reasons == (REASON_OF_FAULT[fault],)
    assert judgement.p_slip is None
    assert model.runs == 0


def test_a_fault_flag_that_nobody_knows_is_still_a_fault() -> None:
    clock = Clock()
    bad = reading(clock())
    bad.faults[0, 0] = 128
    assert pipeline(FakeModel(), clock).judge(bad).outcome is Outcome.UNKNOWN


def _set(finger: int, electrode: int, count: int) -> Callable[[TactileReading], None]:
    def change(bad: TactileReading) -> None:
        bad.counts[finger, electrode] = count

    return change


def _flatten(bad: TactileReading) -> None:
    bad.counts[1] = 2000


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (_set(0, 0, 0), Reason.SATURATED),
        (_set(2, 5, 4095), Reason.SATURATED),
        (_set(1, 3, 65535), Reason.SATURATED),
        (_set(1, 3, LOW - MARGIN - 1), Reason.NEVER_SEEN),
        (_set(1, 3, HIGH + MARGIN + 1), Reason.NEVER_SEEN),
        (_flatten, Reason.FLAT),
    ],
)
def test_counts_that_cannot_be_judged_are_unknown(
    change: Callable[[TactileReading], None], reason: Reason
) -> None:
    clock, model = Clock(), FakeModel()
    bad = reading(clock())
    change(bad)
    judgement = pipeline(model, clock).judge(bad)
    assert judgement.outcome is Outcome.UNKNOWN
    assert judgement.reasons == (reason,)
    assert model.runs == 0


@pytest.mark.parametrize("count", [LOW - MARGIN, HIGH + MARGIN])
def test_counts_at_the_edge_of_what_was_seen_are_judged(count: int) -> None:
    clock = Clock()
    edge = reading(clock())
    edge.counts[1, 3] = count
    assert pipeline(FakeModel(), clock).judge(edge).outcome is Outcome.STABLE


def test_a_finger_that_repeats_itself_is_frozen_until_it_moves() -> None:
    clock = Clock()
    judge = pipeline(FakeModel(), clock)
    first, second, third = reading(clock(), 1), reading(clock(), 2), reading(clock(), 3)
    second.counts[1] = first.counts[1]
    assert judge.judge(first).outcome is Outcome.STABLE
    assert judge.judge(second).reasons == (Reason.FROZEN,)
    assert judge.judge(third).outcome is Outcome.STABLE


def test_an_electrode_that_keeps_its_count_is_frozen_in_time() -> None:
    clock = Clock()
    judge = pipeline(FakeModel(), clock)
    outcomes = []
    for number in range(40):
        stuck = reading(clock(), seed=number)
        stuck.counts[2, 7] = 2000 if number < 30 else 2001 + number
        outcomes.append(judge.judge(stuck).reasons)
    # 16 repeats after the first make it frozen, until it moves again.
    assert outcomes == [()] * 16 + [(Reason.FROZEN,)] * 14 + [()] * 10


@pytest.mark.parametrize(
    ("age_ns", "stale"),
    [(0, False), (100 * MS, False), (100 * MS + 1, True), (10**15, True), (-1, True)],
)
def test_an_old_reading_and_one_from_the_future_are_stale(age_ns: int, stale: bool) -> None:
    clock = Clock(10**16)
    judgement = pipeline(FakeModel(), clock).judge(reading(clock() - age_ns))
    assert (judgement.outcome is Outcome.UNKNOWN) is stale
    assert judgement.reasons == ((Reason.STALE,) if stale else ())


def test_a_slow_network_makes_the_verdict_stale() -> None:
    clock = Clock()

    class SlowModel(FakeModel):
        def run(self) -> tuple[float, float]:
            clock.now_ns += 101 * MS
            return super().run()

    judgement = pipeline(SlowModel(), clock).judge(reading(clock()))
    assert judgement.reasons == (Reason.STALE,)
    assert judgement.p_slip is None


@pytest.mark.parametrize(
    "answer", [math.nan, math.inf, -math.inf, -0.1, 1.1, RuntimeError("session is gone")]
)
def test_a_network_without_a_probability_is_unknown(answer: float | Exception) -> None:
    clock = Clock()
    judgement = pipeline(FakeModel(answer), clock).judge(reading(clock()))
    assert judgement.outcome is Outcome.UNKNOWN
    assert judgement.reasons == (Reason.MODEL_FAILED,)
    assert judgement.p_slip is None


def test_probabilities_that_do_not_sum_to_one_are_refused() -> None:
    class Skewed(FakeModel):
        def run(self) -> tuple[float, float]:
            return 0.1, 0.1

    clock = Clock()
    assert pipeline(Skewed(), clock).judge(reading(clock())).reasons == (Reason.MODEL_FAILED,)


@pytest.mark.parametrize("fingers", [("ff", "mf"), ("mf", "ff", "th"), (*FINGERS, "lf")])
def test_a_model_for_other_fingers_is_refused(fingers: tuple[str, ...]) -> None:
    with pytest.raises(ModelError, match="in this order"):
        pipeline(FakeModel(), Clock(), fingers)


def test_a_reading_of_other_fingers_is_unknown() -> None:
    clock = Clock()
    two = TactileReading(
        clock(), 0, np.full((2, 24), 2000, dtype=np.uint16), np.zeros((2, 24), dtype=np.uint8)
    )
    assert pipeline(FakeModel(), clock).judge(two).reasons == (Reason.MODEL_MISMATCH,)


def test_silence_is_stale() -> None:
    judgement = pipeline(FakeModel(), Clock()).silence(5)
    assert judgement.outcome is Outcome.UNKNOWN
    assert judgement.reasons == (Reason.STALE,)
    assert judgement.t_ns == 5


@st.composite
def readings(draw: st.DrawFn) -> tuple[TactileReading, int]:
    """Any reading a driver could hand over, with its age in ns."""
    fingers = draw(st.sampled_from([1, 3]))
    wild = hnp.arrays(np.uint16, (fingers, 24), elements=st.integers(0, 65535))
    tame = hnp.arrays(np.uint16, (fingers, 24), elements=st.integers(LOW, HIGH))
    faults = np.zeros((fingers, 24), dtype=np.uint8)
    if draw(st.booleans()):
        faults[0, draw(st.integers(0, 23))] = draw(st.integers(0, 255))
    age_ns = draw(st.sampled_from([0, 99 * MS, 101 * MS, -1, 10**12]))
    return TactileReading(0, 0, draw(st.one_of(wild, tame)), faults), age_ns


@given(
    sequence=st.lists(readings(), max_size=8),
    p_slip=st.one_of(st.floats(), st.floats(0, 1)),
)
@settings(max_examples=300, deadline=None)
def test_stable_needs_a_fresh_healthy_seen_reading_and_a_probability(
    sequence: list[tuple[TactileReading, int]], p_slip: float
) -> None:
    clock = Clock(10**15)
    judge = pipeline(FakeModel(p_slip), clock)
    before: TactileReading | None = None
    for raw, age_ns in sequence:
        given_reading = TactileReading(clock() - age_ns, 0, raw.counts, raw.faults)
        judgement = judge.judge(given_reading)
        assert (judgement.outcome is Outcome.UNKNOWN) is bool(judgement.reasons)
        assert (judgement.p_slip is None) is (judgement.outcome is Outcome.UNKNOWN)
        if judgement.outcome is not Outcome.UNKNOWN:
            assert raw.counts.shape == (3, 24)
            assert not raw.faults.any()
            assert 0 <= age_ns <= 100 * MS
            assert LOW - MARGIN <= raw.counts.min() <= raw.counts.max() <= HIGH + MARGIN
            assert (raw.counts.std(axis=1) > 0).all()
            assert 0.0 <= p_slip <= 1.0
            assert (judgement.outcome is Outcome.STABLE) is (p_slip < 0.5)
            if before is not None and before.counts.shape == raw.counts.shape:
                assert not (before.counts == raw.counts).all(axis=1).any()
        before = given_reading
