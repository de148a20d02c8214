"""Each fault in each state of the gate: what the judge says, as a table (`pytest -s` prints it).

No cell may be more certain than the same grasp without a fault; `EXPECTED` says what a cell means.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from functools import cache

import pytest

from graspd.daemon.judge.reasons import Decision, GateState, Reason
from tests.daemon.judge.fault_bench import UNDER_FAULT, Finding, grasp
from tests.daemon.judge.judge_faults import EARLIER, FAULTS, JOINTS_LOST_FOR

STATES = (
    GateState.IDLE,
    GateState.CLOSING,
    GateState.SETTLED,
    GateState.JUDGED,
    GateState.RELEASED,
)

EXPECTED = """
fault                 idle            closing         settled         judged          released
replay off            stale           stale           stale           stale           stale
replay stuck          frozen          frozen          frozen          frozen          frozen
replay stuck electrode=               =               =               =               =
replay garbage        not-a-count     not-a-count     not-a-count     not-a-count     not-a-count
replay wrong by +500  not-tared       not-tared       moving          moving          not-tared
replay wrong by -500  =               =               moving          ~moving         =
replay slow, 20th     stale           stale           stale           stale           stale
replay delayed, 0.2 s stale           stale           stale           stale           stale
replay intermittent   =               =               =               =               =
missing, one          =               =               =               =               =
missing, nine         sensor-missing  sensor-missing  sensor-missing  sensor-missing  sensor-missing
missing, finger       sensor-missing  sensor-missing  sensor-missing  sensor-missing  sensor-missing
not-a-count, one      =               =               =               =               =
not-a-count, nine     not-a-count     not-a-count     not-a-count     not-a-count     not-a-count
not-a-count, finger   not-a-count     not-a-count     not-a-count     not-a-count     not-a-count
parity, one           =               =               =               =               =
parity, nine          parity          parity          parity          parity          parity
parity, finger        parity          parity          parity          parity          parity
error-word, one       =               =               =               =               =
error-word, nine      error-word      error-word      error-word      error-word      error-word
error-word, finger    error-word      error-word      error-word      error-word      error-word
held, one             held            held            held            held            held
held, nine            held            held            held            held            held
held, finger          held            held            held            held            held
cut-off, one          cut-off         cut-off         cut-off         cut-off         cut-off
cut-off, nine         cut-off         cut-off         cut-off         cut-off         cut-off
cut-off, finger       cut-off         cut-off         cut-off         cut-off         cut-off
at 0, one             =               =               =               =               =
at 0, nine            saturated       saturated       saturated       saturated       saturated
at 4095, one          =               =               =               =               =
at 4095, nine         saturated       saturated       saturated       saturated       saturated
ring of 2             frozen          frozen          frozen          frozen          frozen
ring of 8             frozen          frozen          frozen          frozen          frozen
ring of 64            frozen          frozen          frozen          frozen          frozen
ring of 8, finger     frozen          frozen          frozen          frozen          frozen
ring of 64, one live  frozen          frozen          frozen          frozen          frozen
joints silent         =               joints-late     joints-late     ~joints-late    =
joints lost           =               =               =               =               =
joints not valid      =               joints-late     joints-late     ~joints-late    =
joints frozen         =               joints-frozen   joints-frozen   joints-frozen   =
joints move           =               =               moving          ~moving         =
time stands still     stale           stale           stale           ~stale          stale
time back by 50 ms    =               sequence-gap    settling        ~settling       =
time back by 1 s      stale           stale           stale           stale           stale
time ahead by 50 ms   stale           stale           stale           stale           stale
palm drops 5 %        sensor-missing  sensor-missing  sensor-missing  ~sensor-missing sensor-missing
palm drops half       sensor-missing  sensor-missing  sensor-missing  sensor-missing  sensor-missing
palm sends twice      =               =               =               =               =
palm reorders         =               =               =               =               =
palm flips bits       =               =               =               ~never-seen     =
palm sends in bursts  =               no-contact      =               =               =
palm disconnects      stale           stale           stale           ~stale          stale
palm, later version   stale           stale           stale           stale           stale
palm, dead electrode  =               =               =               =               =
palm, unplugged       sensor-missing  sensor-missing  sensor-missing  sensor-missing  sensor-missing
palm, ring of 8       frozen          frozen          frozen          frozen          frozen
palm's request stands stale           stale           stale           stale           stale
JSON, drops half      =               =               =               =               =
JSON, sent twice      =               =               =               =               =
JSON, reordered       =               =               =               =               =
JSON, disconnects     stale           stale           stale           ~stale          stale
JSON, unplugged       sensor-missing  sensor-missing  sensor-missing  sensor-missing  sensor-missing
JSON, topic repeats   stale           stale           stale           stale           stale
JSON, queue of 0.15 s stale           stale           stale           stale           stale
"""
"""`=`: as without the fault, reading by reading, for it is harmless there. A reason: always
`unknown`, and of the reasons that the sound grasp does not give at that reading this one comes most
often. `~` and a reason: now as without the fault, now `unknown`."""
HARMLESS = "="

UNUSABLE = {Reason.ELECTRODES_BROKEN, Reason.SEQUENCE_GAP, Reason.NO_CONTACT}
"""What a reading that cannot be used is said to lack as well, and one after a gap."""
ALSO: dict[Reason, set[Reason]] = {
    Reason.STALE: {Reason.SEQUENCE_GAP, Reason.JOINTS_LATE, Reason.NO_CONTACT, Reason.MOVING},
    Reason.SENSOR_MISSING: UNUSABLE,
    Reason.NOT_A_COUNT: UNUSABLE | {Reason.FROZEN, Reason.SATURATED},
    Reason.PARITY: UNUSABLE,
    Reason.ERROR_WORD: UNUSABLE,
    Reason.HELD: UNUSABLE,
    Reason.CUT_OFF: UNUSABLE,
    Reason.FROZEN: UNUSABLE,
    Reason.SATURATED: UNUSABLE,
    Reason.NEVER_SEEN: {Reason.MOVING, Reason.SETTLING},
    Reason.NO_CONTACT: set(),
    Reason.NOT_TARED: {Reason.NO_CONTACT},
    Reason.MOVING: {Reason.SETTLING, Reason.NEVER_SEEN},
    Reason.SETTLING: {Reason.SEQUENCE_GAP, Reason.MOVING},
    Reason.SEQUENCE_GAP: set(),
    Reason.JOINTS_LATE: set(),
    Reason.JOINTS_FROZEN: set(),
}
"""Reasons that may come along with the one in the cell. Garbage has counts among it."""

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
    hand = grasp(of_a_palm=name.startswith("palm"), on_request=state is GateState.SETTLED)
    return hand.under(FAULTS[name], state, earlier=EARLIER.get(name, 0))


def unsound(found: Sequence[Finding]) -> Counter[Reason]:
    """How often each reason is given that the sound grasp does not give at that reading."""
    return Counter(
        reason
        for finding in found
        for reason in finding.reasons
        if reason not in finding.sound.reasons
    )


def cell(found: Sequence[Finding]) -> str:
    """What the table says of findings."""
    reasons = unsound(found)
    if not reasons:
        return HARMLESS
    most = max(reasons.values())
    dominant = next(reason for reason in Reason if reasons[reason] == most)
    refused = all(finding.decision is Decision.UNKNOWN for finding in found)
    return dominant if refused else f"~{dominant}"


def line(name: str, cells: Sequence[str]) -> str:
    """A line of the table."""
    return f"{name:22}{''.join(f'{text:16}' for text in cells)}".rstrip()


def expected() -> dict[str, list[str]]:
    """Fault -> cells."""
    lines = EXPECTED.strip().splitlines()[1:]
    return {text[:22].strip(): text[22:].split() for text in lines}


def test_each_fault_has_an_expected_cell_in_each_state_and_the_table_is_printed() -> None:
    table = expected()
    assert list(table) == list(FAULTS)
    assert {len(cells) for cells in table.values()} == {len(STATES)}
    found = {name: [cell(findings(name, state)) for state in STATES] for name in FAULTS}
    rows = [line("fault", STATES), *(line(name, cells) for name, cells in found.items())]
    sys.stdout.write("\n" + "\n".join(rows) + "\n")


@pytest.mark.parametrize("of_a_palm", [False, True])
@pytest.mark.parametrize(
    ("state", "decision", "reasons"),
    [
        (GateState.IDLE, Decision.UNKNOWN, {Reason.NO_CONTACT}),
        (GateState.CLOSING, Decision.UNKNOWN, {Reason.NO_CONTACT, Reason.MOVING}),
        (GateState.SETTLED, Decision.UNKNOWN, {Reason.NOT_ASKED}),
        (GateState.JUDGED, Decision.STABLE, set()),
        (GateState.RELEASED, Decision.UNKNOWN, {Reason.NO_CONTACT}),
    ],
)
def test_the_sound_grasp_is_in_each_state_and_stable_only_when_judged(
    state: GateState, decision: Decision, reasons: set[Reason], *, of_a_palm: bool
) -> None:
    hand = grasp(of_a_palm=of_a_palm, on_request=state is GateState.SETTLED)
    said = hand.soundly(state)
    assert said[0].moment.state is state
    after = GateState.IDLE if state is GateState.RELEASED else state
    assert {judgement.moment.state for judgement in said} == {state, after}
    assert {judgement.decision for judgement in said} == {decision}
    assert {reason for judgement in said for reason in judgement.reasons} == reasons


@pytest.mark.parametrize("name", FAULTS)
def test_no_fault_makes_a_verdict_more_certain(name: str) -> None:
    for state in STATES:
        found = findings(name, state)
        assert found
        for finding in found:
            assert finding.decision in {Decision.UNKNOWN, finding.sound.decision}
            assert (finding.decision is Decision.UNKNOWN) is bool(finding.reasons)
            if state is not GateState.JUDGED:
                assert finding.decision is Decision.UNKNOWN


@pytest.mark.parametrize("name", FAULTS)
def test_each_cell_is_what_the_table_says(name: str) -> None:
    found = [findings(name, state) for state in STATES]
    assert [cell(one) for one in found] == expected()[name]
    for one, text in zip(found, expected()[name], strict=True):
        if text == HARMLESS:
            assert all(finding.decision is finding.sound.decision for finding in one)
        else:
            reason = Reason(text.removeprefix("~"))
            assert set(unsound(one)) <= {reason} | ALSO[reason]


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


def test_after_a_jump_of_time_a_grasp_settles_anew_for_the_long_window() -> None:
    decisions = [finding.decision for finding in findings("time back by 50 ms", GateState.JUDGED)]
    assert decisions[:24] == [Decision.UNKNOWN] * 24
    assert decisions[-3:] == [Decision.STABLE] * 3


@pytest.mark.parametrize("name", SINGLE)
def test_one_electrode_that_fails_before_the_grasp_is_repaired_and_changes_nothing(
    name: str,
) -> None:
    hand = grasp(of_a_palm=False, on_request=False)
    found = hand.under(FAULTS[name], GateState.JUDGED, earlier=JOINTS_LOST_FOR)
    assert [finding.decision for finding in found] == [Decision.STABLE] * UNDER_FAULT
