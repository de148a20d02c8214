"""May the hand lift? With a clock and sockets that the tests move."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest

from deploy.clients.python import graspd_client
from deploy.clients.python.graspd_client import Client, Decision, Outcome, Verdict
from tests.clients.messages import ADDED, MS, TEACHES, frames, supervised, verdict

START_NS = 1000 * MS
ASK = "ipc:///nowhere.ask"
WATCHED = ADDED | {"supervised": True}
TAKEN = b'{"v":1,"ok":true}'
LOOK_NS = 1000
"""What each look at the clock takes."""


@dataclass
class Call:
    """What is asked or told, and the answers to it."""

    world: World
    answers: list[tuple[int, bytes]]
    said: list[bytes] = field(default_factory=list)
    answered: list[bytes] = field(default_factory=list)
    due: tuple[int, bytes] | None = None

    def ask(self, question: bytes) -> None:
        assert self.due is None, "one question at a time"
        self.said.append(question)
        if self.answers:
            delay_ns, payload = self.answers.pop(0)
            self.due = self.world.now_ns + delay_ns, payload

    def answer(self) -> bytes | None:
        if self.due is None or self.due[0] > self.world.now_ns:
            return None
        self.answered.append(self.due[1])
        self.due = None
        return self.answered[-1]

    def hang_up(self, *, lifts: bool = True) -> None:
        self.due = None


@dataclass
class World:
    """A clock, and sockets where things come in time."""

    coming: list[tuple[int, list[bytes]]]
    """When what comes, ns."""
    answers: list[tuple[int, bytes]] = field(default_factory=list)
    """How long after its question each comes, ns; then none any more."""
    acknowledged: list[tuple[int, bytes]] = field(default_factory=list)
    """The same of outcomes."""
    now_ns: int = START_NS
    slept_ns: int = 0
    """What the computer has slept: the monotonic clock does not count it."""
    came: list[list[bytes]] = field(default_factory=list)
    renewed: int = 0

    def __post_init__(self) -> None:
        self.asking, self.telling = Call(self, self.answers), Call(self, self.acknowledged)
        self.timing = Call(self, [])

    def monotonic_ns(self) -> int:
        self.now_ns += LOOK_NS
        return self.now_ns

    def boot_ns(self, _clock: int) -> int:
        return self.monotonic_ns() + self.slept_ns

    def receive(self) -> list[bytes] | None:
        if not self.coming or self.coming[0][0] > self.now_ns:
            return None
        self.came.append(self.coming.pop(0)[1])
        return self.came[-1]

    def wait(self, timeout_ms: int) -> None:
        calls = (self.asking.due, self.telling.due)
        due_ns = [due for due, _ in self.coming[:1]] + [due[0] for due in calls if due]
        self.now_ns = max(self.now_ns, min([self.now_ns + timeout_ms * MS, *due_ns]))

    def renew(self) -> None:
        self.renewed += 1

    def close(self) -> None:
        pass


@contextmanager
def client(world: World, ask: bool = False, same: bool | None = None) -> Iterator[Client]:
    """A client in that world."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(graspd_client, "_Link", lambda *_: world)
        clocks = {"monotonic_ns": world.monotonic_ns, "clock_gettime_ns": world.boot_ns}
        patch.setattr(graspd_client, "time", SimpleNamespace(**clocks, CLOCK_BOOTTIME=7))
        asks = ASK if ask else None
        with Client("ipc:///nowhere", ask_endpoint=asks, same_computer=same) as made:
            yield made


def coming(*messages: tuple[str, Mapping[str, Any]]) -> list[tuple[int, list[bytes]]]:
    """One message every 10 ms from now on, each by its verdict and what else differs."""
    sent = []
    for seq, (outcome, more) in enumerate(messages):
        at_ns = START_NS + seq * 10 * MS
        read_ns = at_ns - round(more.get("age_ms", 1.0) * MS)
        sent.append((at_ns, frames(verdict(seq, read_ns, outcome, **more))))
    return sent


def stream(*outcomes: str) -> list[tuple[int, list[bytes]]]:
    return coming(*((outcome, {}) for outcome in outcomes))


def payload(seq: int, outcome: str = "stable", *, boot_id: str = "a", grasp: int = 1) -> bytes:
    """An answer."""
    message = verdict(seq, START_NS, outcome, boot_id=boot_id, grasp=grasp)
    return json.dumps(message).encode()


def test_it_waits_for_the_grasp_to_settle() -> None:
    with client(World(stream(*["unknown"] * 5, "stable"))) as graspd:
        answer = graspd.may_i_lift(0.5)
    assert answer
    assert answer.waited_s == pytest.approx(0.05, abs=0.002)


def test_slip_is_a_no_at_once() -> None:
    with client(World(stream("unknown", "slip", "stable"))) as graspd:
        answer = graspd.may_i_lift(0.5)
    assert not answer
    assert (answer.verdict.decision, answer.verdict.seq) == ("slip", 1)


@pytest.mark.parametrize(
    ("outcomes", "reasons"),
    [([], ("no-message",)), (["unknown"] * 100, ("moving",)), (["unknown"], ("silent",))],
)
def test_at_the_deadline_the_answer_says_why(outcomes: list[str], reasons: tuple[str, ...]) -> None:
    with client(World(stream(*outcomes))) as graspd:
        answer = graspd.may_i_lift(0.3)
    assert (bool(answer), answer.verdict.reasons) == (False, reasons)
    assert answer.waited_s == pytest.approx(0.3, abs=1e-3)


def test_stable_that_came_after_the_deadline_is_late() -> None:
    world = World([(START_NS + 50 * MS, frames(verdict(0, START_NS + 49 * MS)))])
    world.wait = lambda timeout_ms: setattr(world, "now_ns", START_NS + 60 * MS)  # type: ignore[method-assign]
    with client(world) as graspd:
        answer = graspd.may_i_lift(0.02)
    assert (bool(answer), answer.verdict.reasons) == (False, ("late",))


NO_TIMES = [-1.0, float("nan"), float("inf"), 1e300, 10**400, "half", None, True]


@pytest.mark.parametrize("seconds", [*NO_TIMES, 1.1e9])
def test_a_time_that_is_none_is_refused(seconds: Any) -> None:  # noqa: ANN401
    with client(World([])) as graspd:
        for call, name in (
            (graspd.verdict, "wait_s"),
            (graspd.may_i_lift, "deadline_s"),
            (graspd.wait_for_grasp, "deadline_s"),
            (graspd.wait_for_slide, "timeout_s"),
        ):
            with pytest.raises(ValueError, match=name):
                call(seconds)


@pytest.mark.parametrize("max_age_ms", [*NO_TIMES, 0.0, 1.1e12])
def test_an_age_that_is_none_is_refused(max_age_ms: Any) -> None:  # noqa: ANN401
    with pytest.raises(ValueError, match="max_age_ms"):
        Client("ipc:///nowhere", max_age_ms=max_age_ms)


def test_a_closed_client_says_no_without_waiting() -> None:
    world = World(stream("stable"))
    with client(world, ask=True) as graspd:
        graspd.close()
        assert graspd.verdict().reasons == ("closed",)
        assert not graspd.may_i_lift(1.0)
    assert len(world.asking.said) == 0


def test_an_unknown_answer_is_asked_for_again() -> None:
    answers = [(MS, payload(0, "unknown")), (MS, payload(1))]
    world = World(stream(*["stable"] * 9), answers)
    with client(world, ask=True) as graspd:
        assert graspd.may_i_lift(0.1)
    assert len(world.asking.said) == 2


def watched(outcome: str = "unknown") -> list[tuple[int, list[bytes]]]:
    """A stream of the warm-up."""
    return coming(*[(outcome, TEACHES if outcome == "unknown" else WATCHED)] * 20)


@pytest.mark.parametrize("outcome", ["unknown", "slip", "stable"])
@pytest.mark.parametrize("ask", [False, True])
def test_a_supervised_lift_must_be_asked_for(outcome: str, ask: bool) -> None:
    answers = [(5 * MS, frames(supervised(0, START_NS))[1])] * 2 if ask else []
    with client(World(watched(outcome), list(answers)), ask) as graspd:
        answer = graspd.may_i_lift(0.1)
        assert (bool(answer), bool(answer.verdict), answer.supervised) == (False, False, False)
    with client(World(watched(outcome), list(answers)), ask) as graspd:
        answer = graspd.may_i_lift(0.1, supervised=True)
        assert (bool(answer), bool(answer.verdict), answer.supervised) == (True, False, True)
        assert answer.verdict.decision == outcome
        assert answer.waited_s < 0.02


@pytest.mark.parametrize("not_true", [1, "yes", "false", object()])
def test_only_true_asks_for_supervised_lifts(not_true: object) -> None:
    with client(World(watched())) as graspd:
        assert not graspd.may_i_lift(0.02, supervised=not_true)  # type: ignore[arg-type]


def grasps(number: int) -> World:
    """This number of grasps, each stable for 10 ms."""
    sent = coming(*(("stable", {"grasp": grasp}) for grasp in range(1, number + 1)))
    answers = [(0, message[1]) for _, message in sent for _ in range(2)]
    return World(sent, answers, [(MS, TAKEN)] * number)


def test_an_allowed_lift_never_told_is_counted_and_warned_of(
    caplog: pytest.LogCaptureFixture,
) -> None:
    world = grasps(35)
    with client(world, ask=True) as graspd:
        for number in range(1, 35):
            answer = graspd.may_i_lift(1.0)
            assert answer.verdict.grasp == number
            assert graspd.may_i_lift(0.002).verdict.grasp == number
            told = sum(each % 3 == 0 for each in range(1, number))
            assert graspd.unreported == number - 1 - told
            if number % 3 == 0:
                assert graspd.tell(answer.verdict, "held")
            world.now_ns = START_NS + number * 10 * MS
        assert len(caplog.messages) == 3
    assert graspd.unreported == 23  # the last one is over too
    assert caplog.messages == [
        f"{number} lifts were allowed, and their outcome not told" for number in (1, 11, 21)
    ]


def test_lifts_are_remembered_in_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graspd_client, "LIFTS_MAX", 4)
    world = grasps(20)
    with client(world) as graspd:
        for _ in range(20):
            assert graspd.may_i_lift(1.0)
            world.now_ns += 10 * MS
        assert graspd.unreported == 19
        assert len(graspd._lifts) == 4  # noqa: SLF001


def test_an_outcome_not_kept_stays_unreported() -> None:
    not_kept = b'{"v":1,"ok":false,"why":"not kept: No space left on device"}'
    world = grasps(3)
    world.acknowledged[:] = [(50 * MS, not_kept), (50 * MS, TAKEN)]
    with client(world, ask=True) as graspd:
        first = graspd.may_i_lift(1.0).verdict
        world.now_ns += 10 * MS
        assert graspd.may_i_lift(1.0)
        told = graspd.tell(first, Outcome.SLIPPED)
        assert (bool(told), told.why) == (False, "not kept: No space left on device")
        assert graspd.unreported == 1
        assert graspd.tell(first, Outcome.SLIPPED)
        assert graspd.unreported == 0
    assert world.telling.said == [b"outcome a 1 slip"] * 2


def test_an_outcome_that_waits_for_the_disk_blocks_no_lift() -> None:
    world = grasps(9)
    world.acknowledged[:] = [(1000 * MS, TAKEN)]
    with client(world, ask=True) as graspd:
        first = graspd.may_i_lift(1.0).verdict
        assert graspd.tell(first, "slipped", wait_s=0.0).why == "no-answer"
        world.now_ns += 10 * MS
        assert graspd.may_i_lift(1.0).waited_s < 0.02
        assert graspd.unreported == 1
        world.now_ns += 1000 * MS
        graspd.verdict()
        assert graspd.unreported == 0


@pytest.mark.parametrize("word", ["held", "stable", Outcome.HELD])
@pytest.mark.parametrize("bad", ["slipped", "slip", Outcome.SLIPPED])
def test_an_outcome_has_a_name(word: str | Outcome, bad: str | Outcome) -> None:
    world = World(stream("stable"))
    lifted_on = Verdict(Decision.STABLE, grasp=1, boot_id="a")
    with client(world, ask=True) as graspd:
        graspd.tell(lifted_on, word, wait_s=0.0)
        graspd.tell(lifted_on, bad, "mug", wait_s=0.0)
    assert world.telling.said == [b"outcome a 1 stable", b"outcome a 1 slip mug"]


@pytest.mark.parametrize("nothing", [True, False, None, 0, "", "Slip", "unknown", "true"])
def test_other_values_than_outcomes_are_not_told(nothing: object) -> None:
    world = World(stream("stable"))
    with client(world, ask=True) as graspd, pytest.raises(ValueError, match="Outcome"):
        graspd.tell(Verdict(Decision.STABLE, grasp=1, boot_id="a"), nothing)  # type: ignore[arg-type]
    assert world.telling.said == []


def test_a_client_that_has_not_read_for_long_reconnects() -> None:
    world = World(stream("stable"))
    with client(world) as graspd:
        graspd.verdict()
        world.now_ns += 5001 * MS
        assert graspd.verdict().reasons == ("silent",)
    assert world.renewed == 1


def test_python_trusts_nothing_from_before_a_sleep() -> None:
    world = World(stream("stable", "stable", "stable"))
    with client(world) as graspd:
        assert graspd.verdict()
        world.slept_ns += 3600 * 1000 * MS
        assert graspd.verdict().reasons == ("slept",)
        assert (world.renewed, graspd.may_i_lift(0.005).verdict.reasons) == (1, ("slept",))
        world.now_ns += 10 * MS
        assert graspd.verdict()  # the next message is of after it
    assert world.renewed == 1


def test_a_flood_does_not_hold_it_up() -> None:
    world = World([(START_NS, [b"verdict.right"])] * 1500)
    with client(world) as graspd:
        assert graspd.verdict().reasons == ("behind",)
        assert graspd.verdict().reasons == ("malformed",)
