"""`wait_for_slide` stops a lift if a finger slides, lets go, or its state is not known."""

from __future__ import annotations

import signal
import time
from collections.abc import Mapping
from pathlib import Path

import pytest

from deploy.clients.python.graspd_client import Client, SlideAnswer
from tests.clients.building import Probe
from tests.clients.false_daemon import false_daemon
from tests.clients.world import World, client, coming
from tests.kit.waiting import wait_until

Words = Mapping[str, str | None]

HELD: Words = {"ff": "touch", "th": "touch"}


def lift(*words: Words | None, **more: object) -> list[tuple[int, list[bytes]]]:
    """Make messages, one every 10 ms. `words`: the fingers' states in each; None: without states.
    `more`: other fields of all."""
    told = ({} if felt is None else {"fingers": felt} for felt in words)
    return coming(*(("unknown", each | more) for each in told))


def watched(sent: list[tuple[int, list[bytes]]]) -> SlideAnswer:
    with client(World(sent)) as graspd:
        return graspd.wait_for_slide(0.3)


def test_a_slide_stops_the_lift_at_once() -> None:
    answer = watched(lift(*[HELD] * 5, {"ff": "touch", "th": "slide"}, *[HELD] * 30))
    assert answer
    assert (answer.sliding, answer.held) == (("th",), False)
    assert answer.waited_s == pytest.approx(0.05, abs=0.002)


def waiting(sent: list[tuple[int, list[bytes]]]) -> list[tuple[int, list[bytes]]]:
    """Return messages whose sixth to ninth arrive together, as if the client had not looked."""
    late_ns = sent[8][0]
    return sent[:5] + [(max(at_ns, late_ns), message) for at_ns, message in sent[5:]]


NOTHING: Words = {"ff": None, "th": None}
SLID: Words = {"ff": "touch", "th": "slide"}
LET_GO: Words = {"ff": "free", "th": "touch"}
ENDS: dict[str, tuple[list[tuple[int, list[bytes]]], int, tuple[str, ...]]] = {
    # By the last reading that said so, which was 1 ms old, and 100 ms of age.
    "silence": (lift(*[HELD] * 5), 40 + 99, ()),
    "not known": (lift(*[HELD] * 5, *[{"ff": "touch", "th": None}] * 40), 40 + 99, ()),
    "not told": (lift(*[HELD] * 5, *[None] * 40), 40 + 99, ()),
    "let go": (lift(*[HELD] * 5, *[LET_GO] * 40), 50, ()),
    "another start": (lift(*[HELD] * 5) + lift(*[HELD] * 40, boot_id="b")[5:], 50, ()),
    "never told": (lift(*[None] * 40), 100, ()),
    "open": (lift(*[{"ff": "free", "th": "free"}] * 40), 100, ()),
    "never known": (lift(*[NOTHING] * 40), 100, ()),
    "nothing comes": ([], 100, ()),
    "slid between two looks": (waiting(lift(*[HELD] * 5, SLID, *[HELD] * 30)), 80, ("th",)),
    "let go between two looks": (waiting(lift(*[HELD] * 5, LET_GO, *[HELD] * 30)), 80, ()),
    "held": (lift(*[HELD] * 40), 300, ()),
    "held, by readings of 60 ms": (lift(*[HELD] * 5, *[HELD] * 40, age_ms=60.0), 300, ()),
    "held, two readings not usable": (
        lift(*[HELD] * 5, NOTHING, *[HELD] * 5, NOTHING, *[HELD] * 30),
        300,
        (),
    ),
}
"""Messages in a lift of 300 ms, when the watch ends, ms, and the fingers that slide."""


@pytest.mark.parametrize(("sent", "after_ms", "sliding"), ENDS.values(), ids=ENDS)
def test_slide_release_or_unknown_finger_states_stop_a_lift(
    sent: list[tuple[int, list[bytes]]], after_ms: int, sliding: tuple[str, ...]
) -> None:
    answer = watched(sent)
    assert (answer.held, answer.sliding) == (after_ms == 300, sliding)
    assert bool(answer) is not answer.held
    assert answer.waited_s == pytest.approx(after_ms / 1e3, abs=0.012)


def test_an_old_readings_finger_states_are_unknown() -> None:
    with client(World(lift(HELD, age_ms=101.0))) as graspd:
        assert graspd.verdict().fingers == {"ff": None, "th": None}
    with client(World(lift(HELD, age_ms=90.0))) as graspd:
        assert graspd.verdict().fingers == HELD


@pytest.mark.parametrize(
    ("max_age_ms", "timeout_s", "later", "passes", "answer"),
    [
        (5000, 0.1, {}, False, "0 1"),
        (5000, 2.0, {"th": "slide"}, False, "1 0 th"),
        (5000, 2.0, {"th": "slide"}, True, "1 0 th"),
        (5000, 2.0, {"ff": "free"}, False, "1 0"),
        (5000, 2.0, {"ff": "free"}, True, "1 0"),
        (100, 2.0, {"ff": None}, False, "1 0"),
    ],
    ids=["held", "slide", "slid", "let go", "had let go", "not known"],
)
def test_in_cpp_a_lift_is_stopped_for_the_same_reasons(
    probe: Probe,
    tmp_path: Path,
    max_age_ms: int,
    timeout_s: float,
    later: Words,
    passes: bool,
    answer: str,
) -> None:
    """The fingers become `later` during a lift; `passes`: and hold again before the client looks.

    `answer`: the probe's, 1 if the lift must be stopped, 1 if it was held, and sliding fingers.
    """
    fingers = dict(HELD)
    with (
        false_daemon(tmp_path, outcome="unknown", fingers=fingers),
        Client(f"ipc://{tmp_path}/out", max_age_ms=5000) as other,
    ):

        def become(felt: Words) -> None:
            """Change the fingers' states to `felt`, and wait until a message has them."""
            fingers.update(felt)
            wait_until(lambda: other.verdict(0.1).fingers == fingers)

        def is_answered() -> bool:
            """True if the probe gave the answer; on a busy machine it may begin too late."""
            fingers.update(HELD)
            wait_until(lambda: probe.ask("slide", 0.01) == "0 1")  # it has received them
            probe.tell("slide", timeout_s)
            probe.flush()
            time.sleep(0.1)
            if passes:
                probe.send_signal(signal.SIGSTOP)
            become(later)
            if passes:
                become(HELD)
                probe.send_signal(signal.SIGCONT)
            return probe.line() == answer

        probe.tell("client", f"ipc://{tmp_path}/out", f"ipc://{tmp_path}/ask", max_age_ms)
        wait_until(is_answered)
