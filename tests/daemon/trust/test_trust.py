"""Learner, risk and lift book together: what an outcome changes, and the state that is kept."""

from __future__ import annotations

import hashlib
import math
import zlib

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from graspd.daemon.trust.lift_book import LIFTS_MAX, OutcomeStatus
from graspd.daemon.trust.trust import DIGEST_BYTES, Trust, TrustState, decode, encode
from graspd.models.trust.assessment import Assessment
from graspd.models.trust.learner import Learner, sigmoid
from graspd.models.trust.residual import GRASPS_MAX
from graspd.models.trust.risk import Permission, RiskLimits
from tests.daemon.trust.grasps import INPUTS, RULE, inputs, judge, named, trust


def p_slip(part: Trust, grasp: int = 0, margin: float = -1.0) -> float:
    found = part.judge(named(10**6), sigmoid(margin), margin, inputs(grasp)).p_slip
    assert found is not None
    return found


@pytest.mark.parametrize("limits", [RiskLimits(), RULE])
def test_without_outcomes_the_models_probability_is_unchanged(limits: RiskLimits) -> None:
    part = trust(limits)
    for grasp, p in enumerate((0.0, 1e-300, 0.1, 0.1 + 1e-17, 0.5, 1.0 - 2**-53, 1.0)):
        found = part.judge(named(grasp), p, 0.3, inputs(grasp))
        part.note(named(grasp), found, stable=False)
        assert found.p_slip == p


def test_with_learning_off_outcomes_move_the_risk_alone() -> None:
    taught, part = full(), trust(learns=False)
    part.restore(taught.state())
    assert part.state() == taught.state()
    for number in (10, 11):
        assert p_slip(part) == sigmoid(-1.0) != p_slip(taught)
        assert part.review(named(99), None).outcomes == 0
        assert judge(part, number)
        assert part.outcome(named(number), slipped=True) is OutcomeStatus.TAKEN
    assert (part.risk.lifts, part.risk.slips) == (taught.risk.lifts + 2, taught.risk.slips + 2)
    assert part.learner.state() == taught.learner.state()


def test_noting_stable_for_a_grasp_not_allowed_raises() -> None:
    for limits, margin in ((RULE, 3.0), (RiskLimits(0.1, warm_up=5), -0.5)):
        part = trust(limits)
        assessment = part.judge(named(0), 0.1, margin, inputs(0))
        with pytest.raises(ValueError, match="called stable"):
            part.note(named(0), assessment, stable=True)


def test_reviewing_allowed_grasps_keeps_slips_within_the_bound() -> None:
    part, names = trust(RiskLimits(0.05)), list(map(named, range(30)))
    early = [part.judge(name, 1e-6, -13.8, inputs(0)) for name in names]
    assert {each.permission for each in early} == {Permission.ALLOWED}
    slips = 0
    for name, assessment in zip(names, early, strict=True):
        if part.review(name, assessment).permission is Permission.ALLOWED:
            part.note(name, assessment, stable=True)
            part.outcome(name, slipped=True)
            slips += 1
    assert 0 < slips <= 0.05 * slips + 5.0


@pytest.mark.parametrize("permission", Permission, ids=str)
def test_a_review_without_new_outcomes_keeps_the_permission(permission: Permission) -> None:
    part = trust()
    former = replace(part.judge(named(1), 1e-6, -13.8, inputs(1)), permission=permission)
    assert part.review(named(1), former).permission is permission


def test_an_announced_lift_is_not_counted_against_itself() -> None:
    part = trust(RiskLimits(0.1, outstanding_max=2))
    for number in (0, 1):
        assert judge(part, number)
        part.lifts.announce()
        assert judge(part, number)
    assert not judge(part, 2)
    part.outcome(named(1), slipped=False)
    assert judge(part, 2)
    former = part.judge(named(3), 1e-6, -13.8, inputs(3))
    assert part.review(named(3), former).permission is Permission.ALLOWED
    part.lifts.announce()
    assert part.review(named(3), former).permission is Permission.UNPROVEN


@pytest.mark.parametrize(
    ("steps", "taught"),
    [
        ("0 offer 1", 0),  # the second judgement is of the object in the air
        ("0 1 offer", 1),  # the hand pressed harder before
        ("0 1 offer 2", 1),
        ("0 offer 1 offer 2", 1),
        ("0 offer back 1 offer", 1),
        ("0 1 refresh offer", 1),
        ("0 1", 1),
        ("0 1 refresh", 1),
        ("0 stable 1", 2),  # who does not ask lifts on `stable`
        ("0 offer stable 1", 0),
        ("stable 1 offer", 1),
    ],
)
def test_an_outcome_teaches_the_judgement_that_the_lift_began_on(steps: str, taught: int) -> None:
    """Numbers are inputs that are judged after settling, `stable` number 2 with that verdict;
    `refresh` judges others in between."""
    part, features = trust(), dict[int, bytes]()
    for step in steps.split():
        if step == "offer":
            part.lifts.announce()
        elif step == "back":
            part.lifts.take_back(named(1))
        else:
            number = {"stable": 2, "refresh": 3}.get(step) or int(step)
            stable, settles = step == "stable", step != "refresh"
            margin = -9.0 if stable else 2.2
            found = part.judge(named(1), sigmoid(margin), margin, inputs(number))
            part.note(named(1), found, stable=stable, judged=settles)
            features[number] = found.features
    part.outcome(named(1), slipped=False)
    learner = Learner(INPUTS)
    learner.learn(np.frombuffer(features[taught], "<f8"), slipped=False)
    assert part.learner.state() == learner.state()
    assert (part.risk.lifts, part.lifts.announced) == ("stable" in steps, steps == "stable 1 offer")


def test_judging_again_keeps_features_and_restores_none_after_an_exchange() -> None:
    part = trust()
    found = part.judge(named(1), 0.9, 2.2, inputs(0))
    for worth in (found, Assessment(0)):
        part.note(named(1), worth, stable=False, judged=True)
        assert [lift.features for lift in part.state().lifts.records] == [found.features]
    part.sensors_exchanged()
    part.note(named(1), found, stable=False, judged=True)
    assert [lift.features for lift in part.state().lifts.records] == [None]


@pytest.mark.parametrize(
    ("p", "margin", "says"),
    [
        *((p, 0.0, "not a probability") for p in (math.nan, -0.1, 1.1, math.inf)),
        (0.5, math.nan, "not finite"),
    ],
)
def test_p_slip_or_margin_that_no_network_gives_is_refused(
    p: float, margin: float, says: str
) -> None:
    with pytest.raises(ValueError, match=says):
        trust().judge(named(0), p, margin, inputs(0))


def test_a_saved_state_is_not_changed_by_later_outcomes() -> None:
    part = trust()
    judge(part, 0)
    state = part.state()
    kept = encode(state)
    judge(part, 1)
    part.outcome(named(0), slipped=True)
    part.sensors_exchanged()
    assert encode(state) == kept


def test_the_largest_state_of_three_fingers_can_be_restored() -> None:
    part = Trust("f" * 64, 78, RULE)
    random = np.random.default_rng(0)
    for grasp in range(2 * LIFTS_MAX):
        x = random.normal(size=78).astype(np.float32)
        assessment = part.judge(named(grasp), 0.5, -9.0, x)
        part.note(named(grasp), assessment, stable=False)
        if grasp < GRASPS_MAX:
            part.outcome(named(grasp), slipped=False)
    data = encode(part.state())
    assert 600_000 < len(msgspec.msgpack.encode(part.state())) < 0.75 * (1 << 20)
    other = Trust("f" * 64, 78, RULE)
    other.restore(decode(data))
    assert encode(other.state()) == data


def full() -> Trust:
    part = trust()
    for grasp in range(5):
        judge(part, grasp)
        part.outcome(named(grasp // 2), slipped=grasp == 0)
    return part


def test_a_damaged_cut_or_too_large_state_is_refused() -> None:
    data = encode(full().state())
    for place in range(0, len(data), 97):
        damaged = bytearray(data)
        damaged[place] ^= 0x10
        with pytest.raises(ValueError, match="damaged"):
            decode(bytes(damaged))
    long = bytes(1 << 20)
    for bad in (b"", data[:-1], data[:20], data + b"\0", hashlib.sha256(long).digest() + long):
        with pytest.raises(ValueError, match="damaged"):
            decode(bad)


def too_many() -> bytes:
    """Compressed bytes of a state with one grasp more than the book may have."""
    state = full().state()
    many = tuple(replace(state.lifts.records[0], id=named(n)) for n in range(LIFTS_MAX + 1))
    return encode(replace(state, lifts=replace(state.lifts, records=many)))[DIGEST_BYTES:]


@pytest.mark.parametrize(
    "content",
    [b"\x80", b"\xc1", msgspec.msgpack.encode({"version": 2}), too_many()],
    ids=["empty", "no message", "not compressed", "too many records"],
)
def test_other_content_with_a_right_digest_is_refused(content: bytes) -> None:
    with pytest.raises(ValueError, match="nothing that was learned"):
        decode(hashlib.sha256(content).digest() + content)


def test_a_state_of_format_1_or_4_is_refused() -> None:
    for version in (1, 4):
        state = msgspec.to_builtins(full().state(), builtin_types=(bytes,))
        state["version"] = version
        del state["learner"]["grasps"]
        content = zlib.compress(msgspec.msgpack.encode(state))
        with pytest.raises(
            ValueError, match=f"^is of format {version}; this graspd reads 2 and 3$"
        ):
            decode(hashlib.sha256(content).digest() + content)


def test_a_state_of_format_2_gives_equal_probabilities() -> None:
    part, later = full(), trust()
    state = part.state()
    mean, covariance = (each.tobytes() for each in part.learner.at_told())
    learner = replace(state.learner, mean=mean, covariance=covariance)
    later.restore(decode(encode(replace(state, version=2, learner=learner))))
    assert p_slip(later) == pytest.approx(p_slip(part), abs=1e-9)


def test_a_state_that_does_not_fit_is_refused_changing_nothing() -> None:
    part = full()
    before = encode(part.state())
    state = part.state()
    records = state.lifts.records
    unlearned = next(record for record in records if record.slipped is None)

    def with_records(*chosen: object) -> TrustState:
        return replace(state, lifts=replace(state.lifts, records=chosen))

    for why, other in (
        ("another model", replace(state, model="other")),
        ("of .* values", Trust("model", 78, RULE).state()),
        ("twice", with_records(records[0], records[0])),
        ("twice", with_records(replace(unlearned, slipped=True))),
        ("of .* values", with_records(replace(unlearned, features=b"12345678"))),
        ("not finite", with_records(replace(unlearned, features=b"\xff" * 8 * (INPUTS + 2)))),
        ("more slips", replace(state, risk=replace(state.risk, slips=1000))),
        # The learner's and the risk's parts are sound, and of other outcomes.
        ("twice", replace(trust().state(), lifts=with_records(records[0], records[0]).lifts)),
    ):
        with pytest.raises(ValueError, match=why):
            part.restore(other)
        assert encode(part.state()) == before
