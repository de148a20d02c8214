"""What outcomes have taught, and the risk that is set, in the judge's verdicts."""

from __future__ import annotations

from graspd.daemon.judge.pipeline import Judgement, Pipeline
from graspd.daemon.judge.reasons import Decision, Reason
from graspd.daemon.trust.lift_book import GraspId
from graspd.daemon.trust.trust import Trust
from graspd.drivers.base import ElectrodeFault
from graspd.models.trust.risk import RiskLimits
from tests.daemon.fakes import Clock, FakeModel, pipeline, reading

BOOT = "b" * 32


def trusting(
    model: FakeModel, clock: Clock, limits: RiskLimits | None = None, *, learns: bool = True
) -> Pipeline:
    judge = pipeline(model, clock, trust=Trust(model.sha256, 0, limits, learns=learns))
    judge.boot_id = BOOT
    return judge


def lift(judge: Pipeline, clock: Clock, seed: int, *, slipped: bool) -> Judgement:
    """Judge a grasp and tell its outcome."""
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


def test_a_warm_up_lifts_under_supervision() -> None:
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


def test_what_cannot_be_judged_is_never_supervised() -> None:
    clock = Clock()
    judge = trusting(FakeModel(0.3), clock, RiskLimits(0.05, warm_up=50))
    bad = reading(clock())
    bad.faults[0, 0] = ElectrodeFault.HELD
    assert not judge.judge(bad).supervised
    old = reading(clock() - 10**9)
    judgement = judge.judge(old)
    assert Reason.STALE in judgement.reasons
    assert not judgement.supervised


def test_a_slip_stays_a_slip_under_every_risk() -> None:
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
