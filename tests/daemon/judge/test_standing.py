"""A verdict that stands says what the network says now, of one grasp, without flickering."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.daemon.judge.decision import Limits
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.judge.reasons import Decision, GateState, Reason
from graspd.daemon.trust.lift_book import GraspId
from graspd.daemon.trust.trust import Trust
from graspd.drivers.base import ElectrodeFault
from graspd.drivers.twins.grasps.whole_grasps import synthetic_grasps
from graspd.models import zoo
from graspd.models.judge.session import SessionCalibration
from graspd.models.runtime import TactileModel
from graspd.models.trust.risk import RiskLimits
from tests.daemon.fakes import MS, Clock, sound
from tests.daemon.judge.felt_hand import HELD, Feel, Flaw, Hand, limits, tared

BOOT = "b" * 32


def test_slip_becomes_stable_only_after_a_second_without() -> None:
    hand = tared(limits())
    assert hand.play(HELD)[-1].decision is Decision.STABLE
    slips = hand.play(Feel(times=10, answer=0.6))
    assert {each.decision for each in slips[5:]} == {Decision.SLIP}
    said = hand.play(Feel(times=200, answer=0.4))
    assert {each.p_slip for each in said[5:]} == {0.4}, "what is told is the newest"
    first = [each.decision for each in said].index(Decision.STABLE)
    assert 95 <= first <= 105
    assert {each.decision for each in said[first:]} == {Decision.STABLE}


def test_a_slip_says_nothing_of_the_next_grasp() -> None:
    hand = tared(limits())
    hand.play(Feel("faint", times=35, answer=0.9))
    hand.play(Feel("rest", times=15))
    said = hand.play(Feel("faint", times=35))
    decisions = [each.decision for each in said]
    assert decisions.index(Decision.STABLE) < 35
    assert Decision.SLIP not in decisions


def test_values_that_keep_missing_leave_the_newest_judged() -> None:
    hand = tared(limits())
    assert hand.play(HELD)[-1].decision is Decision.STABLE
    missing = (Flaw(0, 3, 2, int(ElectrodeFault.MISSING), 0),)
    runs, known = hand.model.runs, 0
    for _ in range(40):  # so no electrode of it ever has three fresh values
        known += hand.play(Feel(flaws=missing))[0].decision is Decision.STABLE
        known += hand.play(Feel())[0].decision is Decision.STABLE
    assert known > 40
    assert hand.model.runs - runs >= 80 * 10 // 110


def risky(limit: RiskLimits) -> tuple[Hand, Trust]:
    hand = tared(limits())
    trust = Trust(hand.model.sha256, 0, limit, learns=False)
    hand.pipeline.trust, hand.pipeline.boot_id = trust, BOOT
    return hand, trust


def test_a_grasp_judged_again_under_risk_is_one_lift() -> None:
    hand, trust = risky(RiskLimits(0.05))
    said = hand.play(Feel(times=300, answer=0.001))
    assert said[-1].decision is Decision.STABLE
    assert trust.report().outstanding == 1
    (record,) = trust.lifts.state().records
    first = record.features
    hand.play(Feel(times=300, answer=0.002))
    assert trust.lifts.state().records[0].features == first, "what it was called stable by"
    hand.play(Feel(times=50, answer=0.9))
    assert trust.lifts.is_stable(GraspId(BOOT, 1)), "it may have been lifted on that"
    hand.pipeline.outcome(GraspId(BOOT, 1), slipped=True)
    assert (trust.risk.lifts, trust.risk.slips) == (1, 1)


def test_under_a_risk_waiting_brings_no_lucky_draw() -> None:
    hand, trust = risky(RiskLimits(0.05))
    theta = 1.0 / (1.0 + math.exp(-trust.risk.threshold))
    said = [
        each
        for number in range(200)
        for each in hand.play(Feel(times=5, answer=theta * (0.9 if number % 3 else 1.1)))
    ]
    stable = [each.decision is Decision.STABLE for each in said]
    assert not any(stable[60:]), "of three judgings two are below the threshold"
    reasons = {reason for each in said[60:] for reason in each.reasons}
    assert Reason.LOW_CONFIDENCE in reasons
    assert trust.report().outstanding <= 1


def test_a_grasp_teaches_the_session_only_when_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taken: list[NDArray[np.generic]] = []
    monkeypatch.setattr(SessionCalibration, "observe", lambda _, counts, slip: taken.append(counts))
    model, clock = TactileModel(zoo.find("small-session")), Clock()
    judge = Pipeline(model, model.contract.fingers, Limits(), clock, hand=limits())
    held, judged = 0, []
    grasp = synthetic_grasps(1, seed=1)
    (timetable,) = grasp.timetables()
    for moment in grasp:
        clock.now_ns += 10 * MS
        said = judge.judge(sound(moment.counts, clock()))
        judge.learn()
        held += timetable.closed_s <= moment.t_s < timetable.lift_s
        judged += [said.judged_counts] if said.moment.judged else []
        if said.moment.state is GateState.JUDGED:
            assert not taken
    assert held
    assert len(taken) == 1
    np.testing.assert_array_equal(taken[0], judged[0])
