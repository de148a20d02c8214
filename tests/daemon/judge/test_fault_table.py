"""Each fault in states of the gate: nothing gets more certain, and a judged grasp says why not."""

from __future__ import annotations

from functools import cache

import pytest

from graspd.daemon.judge.reasons import Decision, GateState, Reason
from tests.daemon.judge.fault_bench import UNDER_FAULT, Finding, grasp
from tests.daemon.judge.judge_faults import EARLIER, FAULTS, JOINTS_LOST_FOR

STATES = (GateState.IDLE, GateState.CLOSING, GateState.JUDGED)

WHEN_JUDGED = """
replay off             stale
replay stuck           frozen
replay stuck electrode =
replay garbage         not-a-count
replay wrong by +500   moving
replay wrong by -500   ~moving
replay slow, 20th      stale
replay delayed, 0.2 s  stale
replay intermittent    =
missing, one           =
missing, nine          sensor-missing
missing, finger        sensor-missing
not-a-count, one       =
not-a-count, nine      not-a-count
not-a-count, finger    not-a-count
parity, one            =
parity, nine           parity
parity, finger         parity
error-word, one        =
error-word, nine       error-word
error-word, finger     error-word
held, one              held
held, nine             held
held, finger           held
cut-off, one           cut-off
cut-off, nine          cut-off
cut-off, finger        cut-off
at 0, one              =
at 0, nine             saturated
at 4095, one           =
at 4095, nine          saturated
ring of 2              frozen
ring of 8              frozen
ring of 64             frozen
ring of 8, finger      frozen
ring of 64, one live   frozen
joints silent          ~joints-late
joints lost            =
joints not valid       ~joints-late
joints frozen          joints-frozen
joints move            ~moving
time stands still      ~stale
time back by 50 ms     ~settling
time back by 1 s       stale
time ahead by 50 ms    stale
palm drops 5 %         ~sensor-missing
palm drops half        sensor-missing
palm sends twice       =
palm reorders          =
palm flips bits        ~never-seen
palm sends in bursts   =
palm disconnects       ~stale
palm, later version    stale
palm, dead electrode   =
palm, unplugged        sensor-missing
palm, ring of 8        frozen
palm's request stands  stale
JSON, drops half       =
JSON, sent twice       =
JSON, reordered        =
JSON, disconnects      ~stale
JSON, unplugged        sensor-missing
JSON, topic repeats    stale
JSON, queue of 0.15 s  stale
"""
"""Of a judged grasp. `=`: as without the fault, for it is harmless. A reason: always `unknown`, and
this among why. `~` and a reason: now as without the fault, now `unknown`."""
EXPECTED = {line[:22].strip(): line[22:].strip() for line in WHEN_JUDGED.strip().splitlines()}

SINGLE = (
    "replay stuck electrode",
    "missing, one",
    "not-a-count, one",
    "parity, one",
    "error-word, one",
    "at 0, one",
    "at 4095, one",
)


@cache
def findings(name: str, state: GateState) -> list[Finding]:
    """What is said under a fault in a state."""
    hand = grasp(of_a_palm=name.startswith("palm"), on_request=False)
    return hand.under(FAULTS[name], state, earlier=EARLIER.get(name, 0))


@pytest.mark.parametrize("name", FAULTS)
def test_no_fault_makes_a_verdict_more_certain(name: str) -> None:
    for state in STATES:
        found = findings(name, state)
        assert found
        for finding in found:
            assert finding.decision in {Decision.UNKNOWN, finding.sound.decision}
            assert (finding.decision is Decision.UNKNOWN) is bool(finding.reasons)
            assert state is GateState.JUDGED or finding.decision is Decision.UNKNOWN
    expected = EXPECTED[name]
    refused = [finding for finding in found if finding.decision is Decision.UNKNOWN]
    if expected == "=":
        assert [each.decision for each in found] == [each.sound.decision for each in found]
    else:
        assert refused
        assert any(Reason(expected.removeprefix("~")) in each.reasons for each in refused)
        assert (refused == found) is not expected.startswith("~")


@pytest.mark.parametrize("of_a_palm", [False, True])
def test_the_sound_grasp_is_stable_only_when_judged(of_a_palm: bool) -> None:
    hand = grasp(of_a_palm=of_a_palm, on_request=False)
    for state in STATES:
        stands = Decision.STABLE if state is GateState.JUDGED else Decision.UNKNOWN
        assert {judgement.decision for judgement in hand.soundly(state)} == {stands}


@pytest.mark.parametrize(
    ("name", "readings"),
    [
        ("replay off", 0),
        ("replay stuck", 0),
        ("replay garbage", 0),
        ("held, one", 0),
        ("missing, nine", 0),
        ("time stands still", 10),  # max_age_ms 100
        ("joints silent", 15),  # late after 150 ms
        ("joints move", 1),  # 8 mrad in the window of 80 ms are 0.1 rad/s
        ("palm disconnects", 4),  # the 70th packet is the last of the fifth round
    ],
)
def test_a_verdict_stands_under_a_fault_for_so_many_readings(name: str, readings: int) -> None:
    decisions = [finding.decision for finding in findings(name, GateState.JUDGED)]
    assert decisions == [Decision.STABLE] * readings + [Decision.UNKNOWN] * (
        len(decisions) - readings
    )


def test_a_grasp_settles_again_after_a_jump_of_time() -> None:
    decisions = [finding.decision for finding in findings("time back by 50 ms", GateState.JUDGED)]
    assert decisions[:24] == [Decision.UNKNOWN] * 24
    assert decisions[-3:] == [Decision.STABLE] * 3


@pytest.mark.parametrize("name", SINGLE)
def test_one_electrode_that_fails_early_changes_nothing(
    name: str,
) -> None:
    hand = grasp(of_a_palm=False, on_request=False)
    found = hand.under(FAULTS[name], GateState.JUDGED, earlier=JOINTS_LOST_FOR)
    assert [finding.decision for finding in found] == [Decision.STABLE] * UNDER_FAULT
