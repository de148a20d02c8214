"""The judge: sound readings get a verdict, under the set risk, everything else gets `unknown`."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.daemon.judge.health import REASON_OF_FAULT
from graspd.daemon.judge.pipeline import Judgement, Pipeline
from graspd.daemon.judge.reasons import ADVICE, Decision, Reason
from graspd.daemon.trust.lift_book import GraspId
from graspd.daemon.trust.trust import Trust
from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.models.contract import ModelError
from graspd.models.trust.risk import RiskLimits
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
def test_counts_far_outside_the_training_never_reach_the_network(count: int) -> None:
    clock, model = Clock(), FakeModel()
    given = reading(clock())
    given.counts[1, 3] = count
    judgement = pipeline(model, clock).judge(given)
    assert judgement.reasons == COUNTS[count]
    assert (judgement.decision is Decision.UNKNOWN) == bool(COUNTS[count])
    assert model.runs == (0 if COUNTS[count] else 1)


def test_a_slow_model_makes_the_verdict_stale() -> None:
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


def test_a_verdict_without_a_new_reading_is_stale() -> None:
    clock = Clock()
    last_ns = clock() - 10**9
    judgement = pipeline(FakeModel(), clock).silence(last_ns)
    assert (judgement.decision, judgement.t_ns) == (Decision.UNKNOWN, last_ns)
    assert judgement.reasons == (Reason.STALE,), "named once"


BOOT = "b" * 32


def trusting(
    model: FakeModel, clock: Clock, limits: RiskLimits | None = None, *, learns: bool = True
) -> Pipeline:
    judge = pipeline(model, clock, trust=Trust(model.sha256, 0, limits, learns=learns))
    judge.boot_id = BOOT
    return judge


def lift(judge: Pipeline, clock: Clock, seed: int, *, slipped: bool) -> Judgement:
    """Judge the grasp that `seed` draws, report its outcome, and return the judgement."""
    judgement = judge.judge(reading(clock(), seed))
    judge.outcome(GraspId(BOOT, judgement.moment.grasp), slipped=slipped)
    return judgement


def test_outcomes_move_the_probability_and_not_what_the_network_says() -> None:
    clock = Clock()
    judge = trusting(FakeModel(0.3), clock)
    found = [lift(judge, clock, seed, slipped=True) for seed in range(30)]
    worth = [judgement.assessment for judgement in found]
    assert [None if each is None else each.outcomes for each in worth] == list(range(30))
    assert {judgement.opinion.p_slip for judgement in found if judgement.p_slip} == {0.3}
    assert found[0].p_slip == 0.3
    assert found[-1].decision is Decision.SLIP
    assert found[-1].p_slip is not None
    assert found[-1].p_slip > 0.6


def test_until_the_warm_up_ends_grasps_are_unproven_and_supervised() -> None:
    clock = Clock()
    judge = trusting(FakeModel(0.3), clock, RiskLimits(0.05, warm_up=3))
    found = [lift(judge, clock, seed, slipped=False) for seed in range(4)]
    for left, judgement in zip((3, 2, 1), found, strict=False):
        assert judgement.decision is Decision.UNKNOWN
        assert judgement.reasons == (Reason.UNPROVEN,)
        assert judgement.p_slip is None
        assert judgement.supervised
        assert judgement.risk is not None
        assert judgement.risk.warm_up_left == left
    assert found[3].reasons in ((), (Reason.LOW_CONFIDENCE,))
    assert not found[3].supervised
    judge.sensors_exchanged()
    risk = judge.judge(reading(clock(), 9)).risk
    assert risk is not None
    assert risk.warm_up_left == 3


def test_outcomes_are_noted_without_learning_too() -> None:
    clock = Clock()
    judge = pipeline(FakeModel(), clock)
    grasp = GraspId("", judge.judge(reading(clock())).moment.grasp)
    told = [judge.outcome(grasp, slipped=slipped) for slipped in (True, True, False)]
    assert told == ["taken", "repeated", "contradicts"]


def test_unusable_or_stale_readings_ask_for_no_supervised_lift() -> None:
    clock = Clock()
    judge = trusting(FakeModel(0.3), clock, RiskLimits(0.05, warm_up=50))
    bad = reading(clock())
    bad.faults[0, 0] = ElectrodeFault.HELD
    assert not judge.judge(bad).supervised
    old = reading(clock() - 10**9)
    judgement = judge.judge(old)
    assert Reason.STALE in judgement.reasons
    assert not judgement.supervised


def test_a_slip_is_called_slip_even_in_the_warm_up() -> None:
    clock = Clock()
    judge = trusting(FakeModel(0.9), clock, RiskLimits(0.05, warm_up=1))
    judgement = judge.judge(reading(clock()))
    assert (judgement.decision, judgement.reasons) == (Decision.SLIP, ())
    assert judgement.supervised, "whatever the verdict"


def test_when_too_many_slipped_nothing_is_stable_any_more() -> None:
    clock, limits = Clock(), RiskLimits(0.05)
    trust = Trust("model", 0, limits, learns=False)
    for _ in range(6):
        trust.risk.take(stable=True, slipped=True, proves=True)
    judge = pipeline(FakeModel(1e-6), clock, trust=trust)
    judgement = judge.judge(reading(clock()))
    assert judgement.decision is Decision.UNKNOWN
    assert judgement.reasons == (Reason.RISK_EXCEEDED,)
    assert not judgement.supervised
