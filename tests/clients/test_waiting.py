"""Waiting: for the next grasp that is surely judged, over a lift, and for a silent daemon."""

from __future__ import annotations

import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from deploy.clients.python.graspd_client import Client, SlideAnswer
from tests.clients.building import Probe
from tests.clients.messages import MS, TEACHES, frames, verdict
from tests.clients.test_both_ask import false_daemon, told
from tests.clients.test_lift import START_NS, TAKEN, World, client, coming
from tests.kit.waiting import wait_until

Words = Mapping[str, str | None]

HELD: Words = {"ff": "touch", "th": "touch"}
TOLD = b'{"v":1,"t_mono_ns":77000000000}'


def world(*messages: tuple[str, dict[str, Any]]) -> World:
    return World(coming(*messages), acknowledged=[(MS, TAKEN)] * 9)


def test_a_grasp_is_returned_once_when_judged() -> None:
    first, second = {"grasp": 1}, {"grasp": 2}
    made = world(
        *[("unknown", first)] * 3,
        *[("stable", first)] * 3,
        *[("unknown", second)] * 3,
        *[("slip", second)] * 3,
    )
    with client(made) as graspd:
        stable, slip = graspd.wait_for_grasp(1.0), graspd.wait_for_grasp(1.0)
        assert stable is not None
        assert slip is not None
        assert (stable.decision, stable.grasp, stable.seq) == ("stable", 1, 3)
        assert (slip.decision, slip.grasp, slip.seq) == ("slip", 2, 9)
        assert graspd.wait_for_grasp(1.0) is None


def test_a_grasp_that_is_judged_already_is_returned_at_once() -> None:
    with client(world(("stable", {}))) as graspd:
        assert graspd.verdict()
        assert graspd.wait_for_grasp(0.0)
        assert graspd.wait_for_grasp(0.0) is None


@pytest.mark.parametrize(
    ("outcome", "more", "watch"),
    [("stable", {}, False), ("slip", {}, False), ("unknown", TEACHES, True)],
    ids=["stable", "slip", "supervised"],
)
def test_what_is_early_is_not_sure(outcome: str, more: dict[str, Any], watch: bool) -> None:
    early = (outcome, more | {"early": True})
    with client(world(*[early] * 3, (outcome, more | {"early": False}))) as graspd:
        found = graspd.wait_for_grasp(1.0, supervised=watch)
        assert found is not None
        assert found.seq == 3


@pytest.mark.parametrize("watch", [False, True])
def test_a_supervised_grasp_is_returned_under_supervision_alone(watch: bool) -> None:
    with client(world(("unknown", TEACHES))) as graspd:
        found = graspd.wait_for_grasp(0.05, supervised=watch)
        assert (found is not None and found.supervised) is watch


def test_a_grasp_that_was_told_is_not_returned() -> None:
    with client(world(*[("stable", {})] * 5), ask=True) as graspd:
        answered = graspd.verdict(0.1)
        assert graspd.tell(answered, "held")
        assert graspd.wait_for_grasp(0.1) is None


def test_a_closed_client_waits_for_nothing() -> None:
    made = world(("stable", {}))
    with client(made) as graspd:
        graspd.close()
        began_ns = made.now_ns
        assert graspd.wait_for_grasp(1.0) is None
        assert made.now_ns - began_ns < MS


def test_in_cpp_each_grasp_is_returned_once(probe: Probe, tmp_path: Path) -> None:
    with false_daemon(tmp_path, told(), messages_each=10):
        probe.tell("client", f"ipc://{tmp_path}/out")
        grasps = [int(probe.ask("wait 30 0")) for _ in range(5)]
    assert len(set(grasps)) == 5
    assert grasps == sorted(grasps)
    assert grasps[0] > 0


@pytest.mark.parametrize(
    ("more", "watch", "expected"),
    [
        ({"early": True}, 0, "-1"),
        ({"early": False}, 0, "1"),
        ({"supervised": True}, 0, "1"),
        ({"supervised": True, "early": True}, 1, "-1"),
    ],
)
def test_in_cpp_what_is_early_is_not_sure(
    probe: Probe, tmp_path: Path, more: dict[str, Any], watch: int, expected: str
) -> None:
    with false_daemon(tmp_path, told(), **more):
        probe.tell("client", f"ipc://{tmp_path}/out")
        assert probe.ask("wait", 0.3 if expected == "-1" else 30, watch) == expected


def lift(*words: Words | None, **more: object) -> list[tuple[int, list[bytes]]]:
    """Messages, one every 10 ms, in which the fingers feel this; None: not told."""
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


def test_a_lift_that_holds_runs_its_time() -> None:
    answer = watched(lift(*[HELD] * 40))
    assert (bool(answer), answer.sliding, answer.held) == (False, (), True)
    assert answer.waited_s == pytest.approx(0.3, abs=0.002)
    assert answer.verdict.reasons == ("moving",)


@pytest.mark.parametrize(
    ("sent", "after_ms"),
    [
        # By the last reading that said so, which was 1 ms old, and 100 ms of age.
        (lift(*[HELD] * 5), 40 + 99),
        (lift(*[HELD] * 5, *[{"ff": "touch", "th": None}] * 40), 40 + 99),
        (lift(*[HELD] * 5, *[None] * 40), 40 + 99),
        (lift(*[HELD] * 5, *[HELD] * 40, age_ms=60.0), 300),
        (lift(*[HELD] * 5, *[{"ff": "free", "th": "touch"}] * 40), 50),
        (lift(*[HELD] * 5) + lift(*[HELD] * 40, boot_id="b")[5:], 50),
        (lift(*[None] * 40), 100),
        (lift(*[{"ff": "free", "th": "free"}] * 40), 100),
        (lift(*[{"ff": None, "th": None}] * 40), 100),
        ([], 100),
    ],
    ids=[
        *("silence", "not known", "not told", "60 ms old", "let go", "another start"),
        *("never told", "open", "never known", "nothing comes"),
    ],
)
def test_what_is_not_known_stops_the_lift_within_the_age(
    sent: list[tuple[int, list[bytes]]], after_ms: int
) -> None:
    answer = watched(sent)
    assert answer.held is (after_ms == 300)
    assert bool(answer) is not answer.held
    assert answer.sliding == ()
    assert answer.waited_s == pytest.approx(after_ms / 1e3, abs=0.012)


def test_one_reading_that_cannot_be_used_stops_no_lift() -> None:
    nothing: Words = {"ff": None, "th": None}
    assert not watched(lift(*[HELD] * 5, nothing, *[HELD] * 5, nothing, *[HELD] * 30))


@pytest.mark.parametrize(("passing", "sliding"), [("slide", ("th",)), ("free", ())])
def test_what_passed_between_two_looks_stops_the_lift(
    passing: str, sliding: tuple[str, ...]
) -> None:
    sent = lift(*[HELD] * 5, {"ff": "touch", "th": passing}, *[HELD] * 30)
    late_ns = sent[8][0]  # four messages wait for one look
    answer = watched(
        [
            (max(at_ns, late_ns) if seq >= 5 else at_ns, message)
            for seq, (at_ns, message) in enumerate(sent)
        ]
    )
    assert (bool(answer), answer.held, answer.sliding) == (True, False, sliding)
    assert answer.waited_s == pytest.approx(0.08, abs=0.012)


def test_words_of_an_old_reading_are_not_told() -> None:
    with client(World(lift(HELD, age_ms=101.0))) as graspd:
        assert graspd.verdict().fingers == {"ff": None, "th": None}
    with client(World(lift(HELD, age_ms=90.0))) as graspd:
        assert graspd.verdict().fingers == HELD


def test_a_closed_client_stops_the_lift() -> None:
    with client(World(lift(*[HELD] * 40))) as graspd:
        graspd.close()
        answer = graspd.wait_for_slide(1.0)
    assert (bool(answer), answer.verdict.reasons) == (True, ("closed",))
    assert answer.waited_s < 0.01


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
    """`passes`: it is over when the client looks again."""
    fingers = dict(HELD)
    with (
        false_daemon(tmp_path, told(), "unknown", fingers=fingers),
        Client(f"ipc://{tmp_path}/out", max_age_ms=5000) as other,
    ):

        def become(felt: Words) -> None:
            """Returns once a message has said so."""
            fingers.update(felt)
            wait_until(lambda: other.verdict(0.1).fingers == fingers)

        def is_answered() -> bool:
            """On a machine that stands still the probe may begin to look too late for it."""
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


def heard() -> World:
    """A daemon of which a message comes every 100 ms."""
    times = [START_NS + step * 100 * MS for step in range(120)]
    return World([(at_ns, frames(verdict(seq, at_ns))) for seq, at_ns in enumerate(times)])


def asked_at_ms(world: World, *, same: bool = False) -> list[int]:
    """Times of the questions, by looking every 100 ms for 12 s."""
    times: list[int] = []
    with client(world, ask=True, same=same) as graspd:
        for step in range(120):
            world.now_ns = START_NS + step * 100 * MS
            graspd.verdict()
            if len(world.timing.said) > len(times):
                times.append(step * 100)
    assert set(world.timing.said) <= {b"clock"}
    return times


def test_an_answered_client_asks_the_clock_once_a_second() -> None:
    world = heard()
    world.timing.answers.extend([(5 * MS, TOLD)] * 20)
    assert asked_at_ms(world) == pytest.approx(list(range(0, 12_000, 1000)), abs=200)


def test_an_unanswered_client_asks_again_after_ten_seconds() -> None:
    assert asked_at_ms(heard()) == [0, 10_000]


def test_a_client_beside_the_daemon_asks_no_clock() -> None:
    assert asked_at_ms(heard(), same=True) == []


@pytest.mark.parametrize(
    "answer",
    [b"", b"{}", b'{"v":2,"t_mono_ns":1}', b'{"v":1,"t_mono_ns":-1}', b'{"v":1,"ok":true}'],
)
def test_a_clock_that_is_not_understood_is_malformed(answer: bytes) -> None:
    world = World([])
    world.timing.answers.append((MS, answer))
    with client(world, ask=True, same=False) as graspd:
        graspd.verdict(0.01)
        assert graspd.counts.malformed == 1


def test_a_client_without_messages_reconnects_ever_more_seldom() -> None:
    world = World([])
    times_s = []
    with client(world) as graspd:
        for _ in range(400):
            before = world.renewed
            graspd.verdict(0.1)
            if world.renewed > before:
                times_s.append((world.now_ns - START_NS) / 1e9)
    gaps = [after - before for before, after in zip([0.0, *times_s], times_s, strict=False)]
    assert gaps == pytest.approx([1.0, 2.0, 4.0, 8.0, 10.0, 10.0], abs=0.15)
