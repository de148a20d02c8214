"""The judge: sound readings get a verdict, everything else gets `unknown` with its reason."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.daemon.judge.health import REASON_OF_FAULT
from graspd.daemon.judge.reasons import ADVICE, Decision, Reason
from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.models.contract import ModelError
from tests.daemon.fakes import FINGERS, HIGH, LOW, MARGIN, MS, Clock, FakeModel, pipeline, reading


def test_every_reason_has_advice_and_every_fault_a_reason() -> None:
    assert set(ADVICE) == set(Reason)
    assert set(REASON_OF_FAULT) == {fault for fault in ElectrodeFault if fault}


@pytest.mark.parametrize(
    ("answer", "decision", "reasons"),
    [
        (0.1, Decision.STABLE, ()),
        (0.9, Decision.SLIP, ()),
        (RuntimeError("no session"), Decision.UNKNOWN, (Reason.MODEL_FAILED,)),
    ],
    ids=["stable", "slip", "fails"],
)
def test_a_sound_reading_is_judged_as_the_network_answers(
    answer: float | Exception, decision: Decision, reasons: tuple[Reason, ...]
) -> None:
    clock = Clock()
    judge = pipeline(FakeModel(answer), clock)
    judgement = judge.judge(reading(clock()))
    assert (judgement.decision, judgement.reasons) == (decision, reasons)
    assert judgement.p_slip == (None if reasons else answer)
    assert judgement.moment.grasp == 1
    assert judge.health() == ({"model": Reason.MODEL_FAILED} if reasons else {})


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


COUNTS = {
    LOW - MARGIN - 1: (Reason.NEVER_SEEN,),
    LOW - MARGIN: (),
    HIGH + MARGIN: (),
    HIGH + MARGIN + 1: (Reason.NEVER_SEEN,),
}


@pytest.mark.parametrize("count", COUNTS)
def test_counts_beyond_what_was_seen_are_kept_from_the_network(count: int) -> None:
    clock, model = Clock(), FakeModel()
    given = reading(clock())
    given.counts[1, 3] = count
    judgement = pipeline(model, clock).judge(given)
    assert judgement.reasons == COUNTS[count]
    assert (judgement.decision is Decision.UNKNOWN) == bool(COUNTS[count])
    assert model.runs == (0 if COUNTS[count] else 1)


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
