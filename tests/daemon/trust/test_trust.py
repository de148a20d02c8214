"""Learner, risk and lift book together: outcomes late, twice, contradicting, after restarts."""

from __future__ import annotations

import hashlib
import math
import zlib

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd.daemon.trust.lift_book import LIFTS_MAX, OutcomeStatus
from graspd.daemon.trust.trust import MAX_BYTES, Trust, TrustState, decode, encode
from graspd.models.trust.learner import sigmoid
from graspd.models.trust.residual import GRASPS_MAX
from graspd.models.trust.risk import Permission, RiskLimits
from tests.daemon.trust.grasps import INPUTS, RULE, inputs, judge, named, trust


def p_slip(part: Trust, grasp: int = 0, margin: float = -1.0) -> float:
    found = part.judge(named(10**6), sigmoid(margin), margin, inputs(grasp)).p_slip
    assert found is not None
    return found


@pytest.mark.parametrize("limits", [RiskLimits(), RULE])
def test_without_outcomes_the_models_probability_is_unchanged(
    limits: RiskLimits,
) -> None:
    part = trust(limits)
    for grasp, p in enumerate((0.0, 1e-300, 0.1, 0.1 + 1e-17, 0.5, 1.0 - 2**-53, 1.0)):
        found = part.judge(named(grasp), p, 0.3, inputs(grasp))
        part.note(named(grasp), found, stable=False)
        assert found.p_slip == p


def test_an_outcome_changes_the_probability_towards_what_happened() -> None:
    before = p_slip(trust())
    for slipped in (True, False):
        part = trust()
        judge(part, 0, -1.0)
        assert part.outcome(named(0), slipped=slipped) is OutcomeStatus.TAKEN
        assert part.learner.outcomes == 1
        moderated = part.judge(named(1), 0.5, -1.0, inputs(0)).p_slip or 0.0
        assert (moderated > before) or not slipped
    assert part.learner.outcomes == 1


def test_with_learning_off_outcomes_move_the_risk_alone() -> None:
    part = trust(learns=False)
    assert judge(part, 0)
    assert part.outcome(named(0), slipped=True) is OutcomeStatus.TAKEN
    assert p_slip(part) == sigmoid(-1.0)
    assert (part.risk.lifts, part.risk.slips, part.risk.proven) == (1, 1, 1)


def test_a_repeated_outcome_counts_once_and_contradictions_are_refused() -> None:
    part = trust()
    judge(part, 0)
    assert part.outcome(named(0), slipped=False) is OutcomeStatus.TAKEN
    learned, risked = part.learner.state(), part.risk.state()
    assert part.outcome(named(0), slipped=False) is OutcomeStatus.REPEATED
    assert part.outcome(named(0), slipped=True) is OutcomeStatus.CONTRADICTS
    assert part.outcome(named(1), slipped=True) is OutcomeStatus.UNKNOWN
    assert part.outcome(named(0, "f" * 32), slipped=True) is OutcomeStatus.UNKNOWN
    assert (part.learner.state(), part.risk.state()) == (learned, risked)
    assert part.lifts.told == {
        OutcomeStatus.TAKEN: 1,
        OutcomeStatus.REPEATED: 1,
        OutcomeStatus.CONTRADICTS: 1,
        OutcomeStatus.UNKNOWN: 2,
    }


def test_late_outcomes_teach_what_was_judged_then() -> None:
    late, now = trust(RiskLimits()), trust(RiskLimits())
    for grasp in range(50):
        judge(late, grasp, 1.0)
    for grasp in reversed(range(50)):
        judge(now, grasp, 1.0)
        for part in (late, now):
            assert part.outcome(named(grasp), slipped=grasp % 3 == 0) is OutcomeStatus.TAKEN
    assert late.learner.state() == now.learner.state()


def test_a_forgotten_stable_grasp_counts_as_unreported() -> None:
    part = trust()
    first = judge(part, 0)
    said = [judge(part, grasp, -6.0 if grasp % 2 else 6.0) for grasp in range(1, LIFTS_MAX)]
    assert first
    assert part.lifts.outstanding == 1 + sum(said) > 50
    assert part.lifts.unreported == 0
    judge(part, LIFTS_MAX)
    judge(part, LIFTS_MAX + 1)
    assert part.lifts.unreported == 1 + said[0]
    assert part.outcome(named(0), slipped=True) is OutcomeStatus.UNKNOWN
    assert part.outcome(named(2), slipped=True) is OutcomeStatus.TAKEN
    assert part.risk.slips == said[1]


def test_a_lift_counts_its_first_stable_verdict_or_its_first() -> None:
    part = trust()
    assert not judge(part, 7, 2.0)
    unsure = part.judge(named(8), 0.9, 2.0, inputs(8))
    part.note(named(8), unsure, stable=False)
    sure = part.judge(named(8), 0.01, -6.0, inputs(9))
    part.note(named(8), sure, stable=True)
    again = part.judge(named(8), 0.01, -5.0, inputs(10))
    part.note(named(8), again, stable=True)
    part.note(named(8), unsure, stable=False)
    expected = trust()
    expected.note(named(8), sure, stable=True)
    for each in (part, expected):
        assert each.outcome(named(8), slipped=True) is OutcomeStatus.TAKEN
        each.note(named(8), again, stable=True)  # too late to be what it was lifted on
        assert (each.risk.lifts, each.risk.slips, each.lifts.outstanding) == (1, 1, 0)
    assert part.learner.state() == expected.learner.state()


def test_stable_cannot_be_noted_where_it_was_not_allowed() -> None:
    for limits, margin in ((RULE, 3.0), (RiskLimits(0.1, warm_up=5), -0.5)):
        part = trust(limits)
        assessment = part.judge(named(0), 0.1, margin, inputs(0))
        with pytest.raises(ValueError, match="called stable"):
            part.note(named(0), assessment, stable=True)


@pytest.mark.parametrize("p", [math.nan, -0.1, 1.1, math.inf])
def test_what_is_no_probability_is_refused(p: float) -> None:
    with pytest.raises(ValueError, match="no probability"):
        trust().judge(named(0), p, 0.0, inputs(0))
    with pytest.raises(ValueError, match="not finite"):
        trust().judge(named(0), 0.5, math.nan, inputs(0))


def test_former_lifts_after_an_exchange_are_slips_and_teach_nothing() -> None:
    part = trust(RiskLimits(0.1, warm_up=1))
    assert not judge(part, 0, 2.0)
    part.outcome(named(0), slipped=False)
    assert judge(part, 1)
    part.sensors_exchanged()
    assert part.outcome(named(1), slipped=True) is OutcomeStatus.TAKEN
    assert part.outcome(named(1), slipped=True) is OutcomeStatus.REPEATED
    assert (part.risk.lifts, part.risk.slips, part.risk.warm_up_left) == (1, 1, 1)
    assert p_slip(part) == sigmoid(-1.0)
    assert part.judge(named(2), 0.3, -1.0, inputs(2)).permission is Permission.UNPROVEN


Step = tuple[str, int, float, bool]
STEPS = st.lists(
    st.tuples(
        st.sampled_from(("lift", "lift", "lift", "grasp", "tell", "again", "exchange", "restart")),
        st.integers(0, 40),
        st.floats(-12.0, 4.0),
        st.booleans(),
    ),
    max_size=120,
)


@settings(max_examples=80)
@given(st.sampled_from((0.001, 0.02, 0.05, 0.2, 0.5)), st.booleans(), STEPS)
def test_no_adversary_breaks_the_bound(
    alpha: float, slips_if_stable: bool, steps: list[Step]
) -> None:
    """Late, lost, repeated, contradicting outcomes, exchanges and restarts, in any order."""
    part = trust(RiskLimits(alpha))
    said: dict[int, bool] = {}
    told: dict[int, bool] = {}
    for number, (what, back, margin, label) in enumerate(steps):
        if what in ("lift", "grasp"):
            said[number] = judge(part, number, margin)
        which = number if what == "lift" else number - back
        if what in ("lift", "tell", "again") and which in said:
            # An adversary lets slip exactly what was called stable.
            slipped = said[which] if slips_if_stable and which not in told else label
            expected = OutcomeStatus.TAKEN
            if which in told:
                expected = (
                    OutcomeStatus.REPEATED if told[which] == slipped else OutcomeStatus.CONTRADICTS
                )
            assert part.outcome(named(which), slipped=slipped) is expected
            told.setdefault(which, slipped)
        elif what == "exchange":
            part.sensors_exchanged()
        elif what == "restart":
            kept, part = encode(part.state()), trust(RiskLimits(alpha))
            part.restore(decode(kept))
            assert encode(part.state()) == kept
        lifts = [slipped for grasp, slipped in told.items() if said[grasp]]
        assert (part.risk.lifts, part.risk.slips) == (len(lifts), sum(lifts))
        assert part.lifts.outstanding == sum(said.values()) - len(lifts)
        assert part.risk.bound is not None
        assert part.risk.slips <= part.risk.bound + 1e-9


def test_a_restart_in_the_middle_changes_nothing() -> None:
    whole, part = trust(), trust()
    for grasp in range(300):
        for each in (whole, part):
            judge(each, grasp, 3.0 * math.sin(grasp) - 3.0)
            if grasp >= 5:
                each.outcome(named(grasp - 5), slipped=grasp % 4 == 0)
        if grasp % 37 == 0:
            kept, part = encode(part.state()), trust()
            part.restore(decode(kept))
    assert part.state() == whole.state()
    assert part.learner.outcomes == 295


def test_a_state_is_not_changed_by_what_comes_later() -> None:
    part = trust()
    judge(part, 0)
    state = part.state()
    kept = encode(state)
    judge(part, 1)
    part.outcome(named(0), slipped=True)
    part.sensors_exchanged()
    assert encode(state) == kept


def test_the_largest_state_of_three_fingers_fits() -> None:
    part = Trust("f" * 64, 78, RULE)
    random = np.random.default_rng(0)
    for grasp in range(2 * LIFTS_MAX):
        x = random.normal(size=78).astype(np.float32)
        assessment = part.judge(named(grasp), 0.5, -9.0, x)
        part.note(named(grasp), assessment, stable=False)
        if grasp < GRASPS_MAX:
            part.outcome(named(grasp), slipped=False)
    data = encode(part.state())
    assert 600_000 < len(msgspec.msgpack.encode(part.state())) < 0.75 * MAX_BYTES
    other = Trust("f" * 64, 78, RULE)
    other.restore(decode(data))
    assert encode(other.state()) == data


def full() -> Trust:
    part = trust()
    for grasp in range(5):
        judge(part, grasp)
        part.outcome(named(grasp // 2), slipped=grasp == 0)
    return part


def test_no_damaged_byte_goes_unnoticed() -> None:
    data = encode(full().state())
    for place in range(0, len(data), 97):
        damaged = bytearray(data)
        damaged[place] ^= 0x10
        with pytest.raises(ValueError, match="damaged"):
            decode(bytes(damaged))
    long = bytes(MAX_BYTES)
    for bad in (b"", data[:-1], data[:20], data + b"\0", hashlib.sha256(long).digest() + long):
        with pytest.raises(ValueError, match="damaged"):
            decode(bad)


def test_what_is_whole_and_no_state_is_refused() -> None:
    for content in (b"\x80", b"\xc1", msgspec.msgpack.encode({"version": 2})):
        with pytest.raises(ValueError, match="nothing that was learned"):
            decode(hashlib.sha256(content).digest() + content)


def test_what_another_graspd_kept_is_refused_by_its_format() -> None:
    for version in (1, 4):
        state = msgspec.to_builtins(full().state(), builtin_types=(bytes,))
        state["version"] = version
        del state["learner"]["grasps"]
        content = zlib.compress(msgspec.msgpack.encode(state))
        with pytest.raises(
            ValueError, match=f"^is of format {version}; this graspd reads 2 and 3$"
        ):
            decode(hashlib.sha256(content).digest() + content)


def test_a_state_of_format_2_teaches_the_same() -> None:
    part, later = full(), trust()
    state = part.state()
    mean, covariance = (each.tobytes() for each in part.learner.at_told())
    learner = msgspec.structs.replace(state.learner, mean=mean, covariance=covariance)
    later.restore(decode(encode(msgspec.structs.replace(state, version=2, learner=learner))))
    assert p_slip(later) == pytest.approx(p_slip(part), abs=1e-9)


def test_a_state_of_something_else_is_refused_and_changes_nothing() -> None:
    part = full()
    before = encode(part.state())
    state = part.state()
    records = state.lifts.records
    unlearned = next(record for record in records if record.slipped is None)
    replace = msgspec.structs.replace

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


def test_too_many_records_are_no_state() -> None:
    state = full().state()
    many = tuple(
        msgspec.structs.replace(state.lifts.records[0], id=named(grasp))
        for grasp in range(LIFTS_MAX + 1)
    )
    lifts = msgspec.structs.replace(state.lifts, records=many)
    with pytest.raises(ValueError, match="nothing that was learned"):
        decode(encode(msgspec.structs.replace(state, lifts=lifts)))
