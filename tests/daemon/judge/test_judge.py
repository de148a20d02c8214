"""The judge: sound readings get a verdict, everything else gets `unknown` with its reason."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from graspd.daemon.judge.health import REASON_OF_FAULT
from graspd.daemon.judge.reasons import ADVICE, Decision, Reason
from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.models.contract import ModelError
from tests.daemon.fakes import FINGERS, HIGH, LOW, MARGIN, MS, Clock, FakeModel, pipeline, reading


def test_every_reason_has_advice_and_every_fault_a_reason() -> None:
    assert set(ADVICE) == set(Reason)
    assert set(REASON_OF_FAULT) == {fault for fault in ElectrodeFault if fault}


@pytest.mark.parametrize(("p_slip", "decision"), [(0.1, Decision.STABLE), (0.9, Decision.SLIP)])
def test_a_sound_reading_is_judged(p_slip: float, decision: Decision) -> None:
    clock = Clock()
    judgement = pipeline(FakeModel(p_slip), clock).judge(reading(clock()))
    assert judgement.decision is decision
    assert judgement.p_slip == p_slip
    assert judgement.reasons == ()
    assert judgement.moment.grasp == 1


OF_AN_ELECTRODE = (
    ElectrodeFault.MISSING,
    ElectrodeFault.NOT_A_COUNT,
    ElectrodeFault.PARITY,
    ElectrodeFault.ERROR_WORD,
)


@pytest.mark.parametrize("fault", OF_AN_ELECTRODE)
@pytest.mark.parametrize("value", [0, 1234, 4095, 65535])
def test_a_flagged_electrode_is_repaired_and_named_whatever_it_reads(
    fault: ElectrodeFault, value: int
) -> None:
    clock = Clock()
    bad = reading(clock())
    bad.faults[2, 23] = fault
    bad.counts[2, 23] = value
    model = FakeModel()
    judgement = pipeline(model, clock).judge(bad)
    assert judgement.decision is Decision.STABLE
    assert judgement.opinion.repaired == ("th_24",)
    # What the network saw is the image with the training's mean: the fake's electrodes are
    # independent of each other, so nothing else is expected of one.
    bad.counts[2, 23] = 2000
    expected = np.empty(model.inputs.shape, dtype=np.float32)
    model.inputs.build(bad.counts, expected)
    np.testing.assert_allclose(model.input, expected, atol=1e-3)


def _set(finger: int, electrode: int, count: int) -> Callable[[TactileReading], None]:
    def change(bad: TactileReading) -> None:
        bad.counts[finger, electrode] = count

    return change


def _flatten(bad: TactileReading) -> None:
    bad.counts[1] = 2000


@pytest.mark.parametrize(
    ("change", "reason"),
    [
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
    assert judgement.decision is Decision.UNKNOWN
    assert judgement.reasons == (reason,)
    assert model.runs == 0


@pytest.mark.parametrize("count", [LOW - MARGIN, HIGH + MARGIN])
def test_counts_at_the_edge_of_what_was_seen_are_judged(count: int) -> None:
    clock = Clock()
    edge = reading(clock())
    edge.counts[1, 3] = count
    assert pipeline(FakeModel(), clock).judge(edge).decision is Decision.STABLE


@pytest.mark.parametrize(
    ("age_ns", "stale"),
    [(0, False), (100 * MS, False), (100 * MS + 1, True), (10**15, True), (-1, True)],
)
def test_an_old_reading_and_one_from_the_future_are_stale(age_ns: int, stale: bool) -> None:
    clock = Clock(10**16)
    judgement = pipeline(FakeModel(), clock).judge(reading(clock() - age_ns))
    assert (judgement.decision is Decision.UNKNOWN) is stale
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
    assert judgement.decision is Decision.UNKNOWN
    assert judgement.reasons == (Reason.STALE,)
    assert judgement.t_ns == 5


@st.composite
def readings(draw: st.DrawFn) -> tuple[TactileReading, int]:
    """Any reading a driver could hand over, with its age in ns."""
    fingers = draw(st.sampled_from([1, 3]))
    wild = hnp.arrays(np.uint16, (fingers, 24), elements=st.integers(0, 65535))
    tame = hnp.arrays(np.uint16, (fingers, 24), elements=st.integers(LOW, HIGH))
    faults = np.zeros((fingers, 24), dtype=np.uint8)
    for place in draw(st.lists(st.integers(0, 24 * fingers - 1), max_size=20)):
        faults[divmod(place, 24)] = draw(st.integers(0, 255))
    age_ns = draw(st.sampled_from([0, 99 * MS, 101 * MS, -1, 10**12]))
    return TactileReading(0, 0, draw(st.one_of(wild, tame)), faults), age_ns


@given(
    sequence=st.lists(readings(), max_size=8),
    p_slip=st.one_of(st.floats(), st.floats(0, 1)),
)
@settings(max_examples=100)
def test_stable_needs_a_fresh_healthy_seen_reading_and_a_probability(
    sequence: list[tuple[TactileReading, int]], p_slip: float
) -> None:
    clock = Clock(10**15)
    judge = pipeline(FakeModel(p_slip), clock)
    before: TactileReading | None = None
    for raw, age_ns in sequence:
        given_reading = TactileReading(clock() - age_ns, 0, raw.counts, raw.faults)
        judgement = judge.judge(given_reading)
        assert (judgement.decision is Decision.UNKNOWN) is bool(judgement.reasons)
        assert (judgement.p_slip is None) is (judgement.decision is Decision.UNKNOWN)
        if judgement.decision is not Decision.UNKNOWN:
            assert raw.counts.shape == (3, 24)
            assert not (raw.faults & (ElectrodeFault.HELD | ElectrodeFault.CUT_OFF | 0xC0)).any()
            broken = (raw.faults != 0) | (raw.counts == 0) | (raw.counts >= 4095)
            assert broken.sum() <= 12
            assert (broken.sum(axis=1) <= 8).all()
            names = {f"{FINGERS[finger]}_{column + 1}" for finger, column in np.argwhere(broken)}
            assert names <= set(judgement.opinion.repaired)
            assert 0 <= age_ns <= 100 * MS
            sound = raw.counts[~broken]
            assert LOW - MARGIN <= sound.min() <= sound.max() <= HIGH + MARGIN
            for finger, out in zip(raw.counts, broken, strict=True):
                assert len(set(finger[~out].tolist())) > 1
            assert 0.0 <= p_slip <= 1.0
            assert (judgement.decision is Decision.STABLE) is (p_slip < 0.5)
            if before is not None and before.counts.shape == raw.counts.shape:
                assert not (before.counts == raw.counts).all(axis=1).any()
        before = given_reading


def test_a_wholly_flagged_finger_is_missing_not_frozen() -> None:
    clock = Clock()
    judge = pipeline(FakeModel(), clock)
    for number in range(3):
        bad = reading(clock(), number)
        bad.counts[1] = 0
        bad.faults[1] = ElectrodeFault.MISSING
        assert judge.judge(bad).reasons == (Reason.SENSOR_MISSING, Reason.ELECTRODES_BROKEN)
