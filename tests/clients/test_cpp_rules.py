"""The C++ client's rules say what the Python client's say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deploy.clients.python.graspd_client import Newest
from tests.clients.building import Probe
from tests.clients.messages import MAX_AGE_NS, MS, TOPIC, Event, events, frames, verdict

START_NS = 1000 * MS


def said(newest: Newest, now_ns: int) -> str:
    """What the Python client says, in the words of the probe."""
    verdict = newest.at(now_ns)
    place = [-1 if number is None else number for number in (verdict.grasp, verdict.seq)]
    age_ns = round((-1.0 if verdict.age_ms is None else verdict.age_ms) * 1e6)
    words = [verdict.decision, len(verdict.reasons), *verdict.reasons, *place]
    words += [verdict.boot_id or "-", age_ns, fixed(verdict.p_slip), fixed(verdict.p_slip_model)]
    words += [verdict.outcomes, int(verdict.supervised), int(bool(verdict))]
    if risk := verdict.risk:
        words += [fixed(risk.target), risk.lifts, risk.slips, risk.outstanding]
        words += [-1 if risk.bound is None else round(risk.bound), risk.warm_up_left]
        words += [risk.announced, risk.awaited]
    words += [f"{verdict.early:d}{verdict.owner or ''}"]
    words += [-1000000 if verdict.still_ms is None else round(verdict.still_ms * 1e6)]
    for finger, moves in sorted((verdict.motion or {}).items()):
        words.append(f"{finger}={-1000 if moves is None else round(moves * 1e3)}")
    words += [
        f"{name}<{round(most * 1e3)}"
        for name, most in sorted((verdict.motion_limits or {}).items())
    ]
    felt = sorted((verdict.fingers or {}).items())
    words += [f"{finger}-{'unknown' if state is None else state}" for finger, state in felt]
    return " ".join(map(str, [*words, *astuple(newest.counts)]))


def fixed(share: float | None) -> int:
    """In the ninth place, as the probe writes it."""
    return round((-1.0 if share is None else share) * 1e9)


def as_hex(frame: bytes) -> str:
    """A frame for the probe."""
    return frame.hex() or "-"


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(events(), st.booleans(), st.sampled_from([0, 5, 77_000]))
def test_both_clients_say_the_same(
    probe: Probe, sequence: Sequence[Event], same_computer: bool, ahead_ms: int
) -> None:
    newest = Newest(TOPIC, MAX_AGE_NS, same_computer)
    probe.tell("new", MAX_AGE_NS, int(same_computer))
    empty_ns = now_ns = START_NS - ahead_ms * MS * (not same_computer)
    for event in sequence:
        newest.take(event.frames, empty_ns, now_ns)
        probe.tell("take", empty_ns, now_ns, *map(as_hex, event.frames))
        assert probe.ask("at", now_ns) == said(newest, now_ns)
        empty_ns, now_ns = now_ns, now_ns + event.wait_ns
        assert probe.ask("at", now_ns) == said(newest, now_ns)


def test_both_clients_limit_the_drift_of_two_clocks(probe: Probe) -> None:
    newest = Newest(TOPIC, MAX_AGE_NS, False)
    probe.tell("new", MAX_AGE_NS, 0)
    unknown = []
    for seq, delay_us in enumerate([0, *range(0, 30_000, 900), 19_000]):
        sent_ns = START_NS + seq * 1000 * MS
        now_ns = sent_ns + delay_us * 1000
        message = frames(verdict(seq, sent_ns))
        newest.take(message, sent_ns, now_ns)
        probe.tell("take", sent_ns, now_ns, *map(as_hex, message))
        assert probe.ask("at", now_ns) == said(newest, now_ns)
        unknown.append(newest.at(now_ns).reasons == ("clock",))
    assert unknown == [False] * 24 + [True] * 11 + [False]


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.integers(0, 200), st.integers(0, 200), st.booleans()), max_size=20))
def test_both_clients_count_age_by_a_clock_that_was_told(
    probe: Probe, steps: Sequence[tuple[int, int, bool]]
) -> None:
    newest = Newest(TOPIC, MAX_AGE_NS, False)
    probe.tell("new", MAX_AGE_NS, 0)
    now_ns = START_NS
    for seq, (delay_ms, asking_ms, compares) in enumerate(steps):
        sent_ns = START_NS + seq * 300 * MS
        empty_ns, now_ns = now_ns, sent_ns + delay_ms * MS
        if compares:
            newest.compare_clocks(sent_ns - asking_ms * MS, sent_ns + 77_000 * MS)
            probe.tell("clock", sent_ns - asking_ms * MS, sent_ns + 77_000 * MS)
        message = frames(verdict(seq, sent_ns + 77_000 * MS))
        newest.take(message, empty_ns, now_ns)
        probe.tell("take", empty_ns, now_ns, *map(as_hex, message))
        assert probe.ask("at", now_ns) == said(newest, now_ns)
