"""No path turns bad, stale or missing data into `stable`: the rules of both clients."""

from __future__ import annotations

import ast
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deploy.clients.python import graspd_client
from deploy.clients.python.graspd_client import (
    Decision,
    FingerState,
    Newest,
    Risk,
    Verdict,
    is_same_computer,
)
from tests.clients.building import Probe
from tests.clients.messages import (
    ADDED,
    MAX_AGE_NS,
    MS,
    TOPIC,
    Event,
    events,
    frames,
    supervised,
    verdict,
)
from tests.clients.rules import START_NS, Rules

GOLDEN = Path(__file__).parents[1] / "daemon" / "publish" / "golden"
OFFSET_NS = 77_000 * MS
"""Time by which the other computer's clock is ahead, ns."""
many = settings(max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])


@many
@given(st.binary(max_size=200) | st.text(max_size=100).map(str.encode))
def test_random_bytes_are_malformed_and_never_stable(cpp: Probe | None, payload: bytes) -> None:
    rules = Rules(cpp)
    rules.take([TOPIC, payload])
    assert rules.at().reasons in [("malformed",), ("version",)]
    assert rules.counts.malformed == 1


@many
@given(events(), st.booleans(), st.sampled_from([0, 5, 77_000]))
def test_both_clients_judge_random_messages_alike(
    cpp: Probe | None, sequence: Sequence[Event], same_computer: bool, ahead_ms: int
) -> None:
    rules = Rules(cpp, same_computer)
    empty_ns = now_ns = START_NS - ahead_ms * MS * (not same_computer)
    for event in sequence:
        rules.take(event.frames, empty_ns, now_ns)
        rules.at(now_ns)
        empty_ns, now_ns = now_ns, now_ns + event.wait_ns
        rules.at(now_ns)


def said(cpp: Probe | None, message: dict[str, Any]) -> Verdict:
    """Return the verdict right after `message`, the only one. `cpp` None: only Python's rules."""
    rules = Rules(cpp)
    rules.take(frames(message))
    return rules.at()


def test_a_verdict_has_risk_motion_and_finger_states(cpp: Probe | None) -> None:
    found = said(cpp, verdict(0, START_NS, **ADDED))
    assert found
    assert (found.p_slip, found.p_slip_model, found.outcomes) == (0.125, 0.3, 57)
    assert found.risk == Risk(0.05, 41, 2, 1, 6.1, 0, 40, 1)
    assert (found.early, found.still_ms) == (False, 250.0)
    assert found.motion == {"ff": 0.9, "th": None}
    assert found.motion_limits == {"ff": 1.5, "th": 1.0}
    assert found.fingers == {"ff": FingerState.TOUCH, "th": None}
    assert hash(found) == hash(said(cpp, verdict(0, START_NS, **ADDED)))


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("verdict_*.json")), ids=lambda path: path.stem)
def test_golden_verdicts_are_understood_with_and_without_added_fields(
    cpp: Probe | None, path: Path
) -> None:
    golden = json.loads(path.read_text())
    assert set(ADDED) < set(golden)
    former = {name: value for name, value in golden.items() if name not in ADDED}
    for message in (golden, former, golden | ADDED if golden["valid"] else golden):
        rules = Rules(cpp)
        now_ns = message["t_mono_ns"] + round(message["age_ms"] * 1e6)
        rules.take(frames(message), now_ns, now_ns)
        seen = rules.at(now_ns)
        assert (seen.decision, seen.reasons) == (message["verdict"], tuple(message["reasons"]))


def test_a_supervised_verdict_counts_as_false_even_if_stable(cpp: Probe | None) -> None:
    found = said(cpp, supervised(0, START_NS))
    assert (bool(found), found.supervised, found.reasons) == (False, True, ("unproven",))
    assert not said(cpp, verdict(0, START_NS, supervised=True))
    assert said(cpp, verdict(0, START_NS, "slip", supervised=True)).supervised


@pytest.mark.parametrize(
    ("later_ms", "reasons"), [(99, ()), (100, ("stale",)), (101, ("silent",)), (-2, ("clock",))]
)
def test_a_message_too_old_or_in_the_future_says_why(
    cpp: Probe | None, later_ms: int, reasons: tuple[str, ...]
) -> None:
    rules = Rules(cpp)  # read at 1 s, published 1 ms later
    rules.take(frames(verdict(0, START_NS)))
    assert rules.at(START_NS + MS + later_ms * MS).reasons == reasons


def test_gaps_repeats_and_restarts_are_counted(cpp: Probe | None) -> None:
    rules = Rules(cpp)
    for seq, boot_id in [(5, "a"), (6, "a"), (9, "a"), (9, "a"), (0, "b"), (10, "a"), (1, "b")]:
        rules.take(frames(verdict(seq, START_NS, boot_id=boot_id)))
    assert (rules.at().boot_id, rules.at().seq) == ("b", 1)
    assert dataclasses.asdict(rules.counts) == {
        "messages": 5,
        "lost": 2,
        "repeats": 1,
        "malformed": 0,
        "restarts": 1,
        "former": 1,
    }


DRIFTS = st.sampled_from([0.0, 5e-4, -5e-4])


@many
@given(st.lists(st.integers(0, 400), max_size=60), DRIFTS)
def test_another_computers_messages_delayed_too_long_are_never_stable(
    cpp: Probe | None, delays_ms: list[int], drift: float
) -> None:
    rules = Rules(cpp, False)
    empty_ns = arrived_ns = START_NS
    for seq, delay_ms in enumerate([1, 1, 1, *delays_ms]):  # at first the network is well
        sent_ns = START_NS + seq * 10 * MS
        arrived_ns = max(arrived_ns, sent_ns + delay_ms * MS)  # TCP keeps the order
        theirs_ns = OFFSET_NS + sent_ns + round((sent_ns - START_NS) * drift)
        rules.take(frames(verdict(seq, theirs_ns - MS)), empty_ns, arrived_ns)
        for now_ns in (arrived_ns, arrived_ns + 50 * MS):
            if rules.at(now_ns):
                assert now_ns - sent_ns <= MAX_AGE_NS + 2 * MS
        if delay_ms <= 1 and seq and arrived_ns == sent_ns + delay_ms * MS:
            assert rules.at(arrived_ns) or arrived_ns - empty_ns > MAX_AGE_NS - MS
        empty_ns = arrived_ns


def test_another_computers_first_message_is_unknown_with_reason_joining(cpp: Probe | None) -> None:
    rules = Rules(cpp, False)
    rules.take(frames(verdict(7, OFFSET_NS)))
    assert rules.at().reasons == ("joining",)
    rules.take(frames(verdict(8, OFFSET_NS + 10 * MS)), START_NS, START_NS + 10 * MS)
    assert rules.at(START_NS + 10 * MS)


def test_after_the_daemons_computer_reboots_its_second_message_counts(cpp: Probe | None) -> None:
    rules = Rules(cpp, False)
    for number, boot_id in enumerate("aabb"):
        now_ns = START_NS + number * 10 * MS
        theirs_ns = (OFFSET_NS if boot_id == "a" else 0) + number * 10 * MS
        rules.take(frames(verdict(number, theirs_ns, boot_id=boot_id)), now_ns - MS, now_ns)
        assert bool(rules.at(now_ns)) == (number in (1, 3))


@many
@given(st.lists(st.tuples(st.integers(0, 300), st.integers(0, 300)), max_size=40), DRIFTS)
def test_with_clock_comparisons_no_message_delayed_too_long_is_stable(
    cpp: Probe | None, delays_ms: list[tuple[int, int]], drift: float
) -> None:
    """`delays_ms`: of each message after the first, and of the clock's question before it."""
    rules = Rules(cpp, False)
    for seq, (delay_ms, asking_ms) in enumerate([(1, 1), *delays_ms]):
        sent_ns = START_NS + seq * 1000 * MS
        drifted_ns = OFFSET_NS + round((sent_ns - START_NS) * drift)
        if seq:
            rules.compare_clocks(sent_ns - asking_ms * MS, drifted_ns + sent_ns)
        now_ns = sent_ns + delay_ms * MS
        rules.take(frames(verdict(seq, drifted_ns + sent_ns - MS)), now_ns, now_ns)
        found = rules.at(now_ns)
        if found:
            assert now_ns - sent_ns <= MAX_AGE_NS + MS
        elif seq and delay_ms + min(asking_ms, delays_ms[0][1]) + 2 * seq < 90:
            pytest.fail(f"late by {delay_ms} ms, asked for {asking_ms} ms: {found}")


def test_clock_comparisons_correct_a_drift_of_100_ms(cpp: Probe | None) -> None:
    rules = Rules(cpp, False)
    for seq in range(200):  # to 100 ms
        now_ns = START_NS + seq * 1000 * MS
        theirs_ns = OFFSET_NS + now_ns - round(seq * 0.5 * MS)
        rules.compare_clocks(now_ns - MS, theirs_ns)
        rules.take(frames(verdict(seq, theirs_ns)), now_ns, now_ns)
        assert seq < 1 or rules.at(now_ns)


def test_a_drift_over_20_ms_without_clock_comparison_is_unknown(cpp: Probe | None) -> None:
    rules, unknown = Rules(cpp, False), []
    for seq, delay_us in enumerate([0, *range(0, 30_000, 900), 19_000]):
        sent_ns = START_NS + seq * 1000 * MS
        now_ns = sent_ns + delay_us * 1000
        rules.take(frames(verdict(seq, sent_ns)), sent_ns, now_ns)
        unknown.append(rules.at(now_ns).reasons == ("clock",))
    assert unknown == [False] * 24 + [True] * 11 + [False]


@pytest.mark.parametrize("first", ["clock", "message"])
@pytest.mark.parametrize("between_ms", [50, 150, 700])
def test_with_compared_clocks_reading_seldom_makes_no_message_too_old(
    cpp: Probe | None, first: str, between_ms: int
) -> None:
    """Each message may have waited since the look before, when the queue was empty."""
    rules = Rules(cpp, False)
    now_ns, ahead_ns = START_NS, START_NS - OFFSET_NS
    if first == "message":
        rules.take(frames(verdict(0, now_ns - ahead_ns - MS)), now_ns, now_ns)
    rules.compare_clocks(now_ns - MS, now_ns - MS - ahead_ns)
    for seq in range(1, 20):
        empty_ns, now_ns = now_ns, now_ns + between_ms * MS
        sent = verdict(seq, now_ns - ahead_ns - 2 * MS, silence_ms=100.0)
        rules.take(frames(sent), empty_ns, now_ns)
        found = rules.at(now_ns)
        assert found
        assert found.age_ms == pytest.approx(2.0 + 1e-3 * between_ms * seq, abs=0.1)


def test_after_forgetting_only_a_newer_message_counts() -> None:
    newest = Newest(TOPIC, MAX_AGE_NS, False)
    for seq in range(3):
        newest.take(frames(verdict(seq, OFFSET_NS)), START_NS, START_NS)
    newest.forget("slept")
    assert (newest.at(START_NS).reasons, newest.silence_ns) == (("slept",), 0)
    newest.take(frames(verdict(2, OFFSET_NS)), START_NS, START_NS)
    assert newest.at(START_NS).reasons == ("slept",)
    newest.take(frames(verdict(3, OFFSET_NS)), START_NS, START_NS)
    assert newest.at(START_NS).reasons == ("joining",)  # how the clocks differ is not known now


def test_messages_that_waited_unread_too_long_count_as_silence(cpp: Probe | None) -> None:
    rules = Rules(cpp, False)
    now_ns = START_NS + 3000 * MS
    for seq in range(50):  # came in the first half second, read after three
        rules.take(frames(verdict(seq, OFFSET_NS + seq * 10 * MS)), START_NS, now_ns)
    assert rules.at(now_ns).reasons == ("silent",)


@pytest.mark.parametrize(
    ("endpoint", "same"),
    [
        ("ipc:///run/graspd/right.ipc", True),
        ("tcp://127.0.0.1:5555", True),
        ("tcp://[::1]:5555", True),
        ("tcp://localhost:5555", True),
        ("tcp://localhost.example:5555", False),
        ("tcp://192.0.2.7:5555", False),
    ],
)
def test_only_endpoints_of_this_computer_share_its_clock(endpoint: str, same: bool) -> None:
    assert is_same_computer(endpoint) is same


@pytest.mark.parametrize("word", ["stable", "slip", "unknown"])
def test_a_decision_prints_as_its_word_on_the_wire(word: str) -> None:
    assert [str(Decision(word)), f"{Decision(word)}", json.loads(json.dumps(Decision(word)))] == [
        word
    ] * 3


def test_the_client_file_parses_as_python_3_9() -> None:
    source = Path(graspd_client.__file__).read_text()
    ast.parse(source, feature_version=(3, 9))
    assert "from __future__ import annotations" in source
