"""When the Python client says that the hand may lift, by a clock that the tests move."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import zmq

from deploy.clients.python import graspd_client
from deploy.clients.python.graspd_client import Client, Decision, Outcome, Verdict
from tests.clients.false_daemon import TAKEN
from tests.clients.messages import MS, TEACHES, frames, verdict
from tests.clients.world import START_NS, World, client, coming
from tests.kit.waiting import wait_until


def stream(*outcomes: str) -> list[tuple[int, list[bytes]]]:
    return coming(*((outcome, {}) for outcome in outcomes))


@pytest.mark.parametrize(
    ("outcomes", "decision", "reasons", "waited_s"),
    [
        (["unknown"] * 5 + ["stable"], "stable", (), 0.05),
        (["unknown", "slip", "stable"], "slip", (), 0.01),
        ([], "unknown", ("no-message",), 0.3),
        (["unknown"] * 100, "unknown", ("moving",), 0.3),
        (["unknown"], "unknown", ("silent",), 0.3),
    ],
)
def test_may_i_lift_answers_by_its_deadline_at_the_latest(
    outcomes: list[str], decision: str, reasons: tuple[str, ...], waited_s: float
) -> None:
    with client(World(stream(*outcomes))) as graspd:
        answer = graspd.may_i_lift(0.3)
    assert bool(answer) is (decision == "stable")
    assert (answer.verdict.decision, answer.verdict.reasons) == (decision, reasons)
    assert answer.waited_s == pytest.approx(waited_s, abs=2e-3)


def test_stable_that_came_after_the_deadline_is_late() -> None:
    world = World([(START_NS + 50 * MS, frames(verdict(0, START_NS + 49 * MS)))])
    world.wait = lambda timeout_ms: setattr(world, "now_ns", START_NS + 60 * MS)  # type: ignore[method-assign]
    with client(world) as graspd:
        answer = graspd.may_i_lift(0.02)
    assert (bool(answer), answer.verdict.reasons) == (False, ("late",))


NO_TIMES = [-1.0, float("nan"), float("inf"), 1e300, 10**400, "half", None, True]


@pytest.mark.parametrize("seconds", [*NO_TIMES, 1.1e9])
def test_a_waiting_time_that_is_not_seconds_is_refused(seconds: Any) -> None:  # noqa: ANN401
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
def test_an_age_limit_that_is_not_milliseconds_is_refused(max_age_ms: Any) -> None:  # noqa: ANN401
    with pytest.raises(ValueError, match="max_age_ms"):
        Client("ipc:///nowhere", max_age_ms=max_age_ms)


def test_a_closed_client_says_no_without_waiting() -> None:
    world = World(stream("stable"))
    with client(world, ask=True) as graspd:
        graspd.close()
        began_ns = world.now_ns
        assert graspd.verdict(1.0).reasons == ("closed",)
        assert not graspd.may_i_lift(1.0)
        assert graspd.wait_for_grasp(1.0) is None
        answer = graspd.wait_for_slide(1.0)
        assert (bool(answer), answer.verdict.reasons) == (True, ("closed",))
    assert world.now_ns - began_ns < MS
    assert world.asking.said == []


def test_after_an_unknown_answer_the_client_asks_again() -> None:
    unknown, stable = (frames(verdict(0, START_NS, each))[1] for each in ("unknown", "stable"))
    world = World(stream(*["stable"] * 9), [(MS, unknown), (MS, stable)])
    with client(world, ask=True) as graspd:
        assert graspd.may_i_lift(0.1)
    assert len(world.asking.said) == 2


@pytest.mark.parametrize("not_true", [1, "yes", "false", object()])
def test_truthy_values_other_than_true_allow_no_supervised_lift(not_true: object) -> None:
    with client(World(coming(*[("unknown", TEACHES)] * 20))) as graspd:
        assert not graspd.may_i_lift(0.02, supervised=not_true)  # type: ignore[arg-type]


def grasps(number: int) -> World:
    """Make a world with this number of grasps, each stable for 10 ms, and answers to `lift` and to
    outcomes."""
    sent = coming(*(("stable", {"grasp": grasp}) for grasp in range(1, number + 1)))
    answers = [(0, message[1]) for _, message in sent for _ in range(2)]
    return World(sent, answers, [(MS, TAKEN)] * number)


def test_lifts_are_remembered_in_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graspd_client, "LIFTS_MAX", 4)
    world = grasps(20)
    with client(world) as graspd:
        for _ in range(20):
            assert graspd.may_i_lift(1.0)
            world.now_ns += 10 * MS
        assert graspd.unreported == 19
        assert len(graspd._lifts) == 4  # noqa: SLF001


def test_an_outcome_not_yet_acknowledged_blocks_no_lift() -> None:
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


@pytest.mark.parametrize(
    ("how", "told"),
    [("held", "stable"), ("stable", "stable"), (Outcome.HELD, "stable"), ("slipped", "slip"),
     ("slip", "slip"), (Outcome.SLIPPED, "slip")],
)  # fmt: skip
def test_an_outcome_may_be_given_by_name(how: str | Outcome, told: str) -> None:
    world = World(stream("stable"))
    with client(world, ask=True) as graspd:
        graspd.tell(Verdict(Decision.STABLE, grasp=1, boot_id="a"), how, wait_s=0.0)
    assert world.telling.said == [f"outcome a 1 {told}".encode()]


@pytest.mark.parametrize("nothing", [True, False, None, 0, "", "Slip", "unknown", "true"])
def test_a_value_that_is_not_an_outcome_is_refused(nothing: object) -> None:
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


def test_the_python_client_forgets_messages_after_the_computer_slept() -> None:
    world = World(stream("stable", "stable", "stable"))
    with client(world) as graspd:
        assert graspd.verdict()
        world.slept_ns += 3600 * 1000 * MS
        assert graspd.verdict().reasons == ("slept",)
        assert (world.renewed, graspd.may_i_lift(0.005).verdict.reasons) == (1, ("slept",))
        world.now_ns += 10 * MS
        assert graspd.verdict()  # the next message is of after it
    assert world.renewed == 1


def test_a_client_with_over_1000_waiting_messages_is_behind() -> None:
    world = World([(START_NS, [b"verdict.right"])] * 1500)
    with client(world) as graspd:
        assert graspd.verdict().reasons == ("behind",)
        assert graspd.verdict().reasons == ("malformed",)


TOLD = b'{"v":1,"t_mono_ns":77000000000}'


def heard() -> World:
    """Make a world in which a message of the daemon comes every 100 ms for 12 s."""
    times = [START_NS + step * 100 * MS for step in range(120)]
    return World([(at_ns, frames(verdict(seq, at_ns))) for seq, at_ns in enumerate(times)])


def asked_at_ms(world: World, *, same: bool = False) -> list[int]:
    """Call the client every 100 ms for 12 s; return when it asked for the daemon's clock, ms.

    `same`: the daemon is on the same computer.
    """
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


def test_an_unanswered_clock_question_is_repeated_after_ten_seconds() -> None:
    assert asked_at_ms(heard()) == [0, 10_000]


def test_a_client_on_the_daemons_computer_never_asks_its_clock() -> None:
    assert asked_at_ms(heard(), same=True) == []


@pytest.mark.parametrize(
    "answer",
    [b"", b"{}", b'{"v":2,"t_mono_ns":1}', b'{"v":1,"t_mono_ns":-1}', b'{"v":1,"ok":true}'],
)
def test_a_clock_answer_that_is_not_understood_counts_as_malformed(answer: bytes) -> None:
    world = World([])
    world.timing.answers.append((MS, answer))
    with client(world, ask=True, same=False) as graspd:
        graspd.verdict(0.01)
        assert graspd.counts.malformed == 1


def test_a_question_to_a_peer_that_refuses_raises_nothing(tmp_path: Path) -> None:
    out = f"ipc://{tmp_path}/out"
    with (
        zmq.Context() as context,
        context.socket(zmq.PUB) as refuses,
        Client(out, ask_endpoint=out) as graspd,
    ):
        refuses.bind(out)
        call = graspd._link.timing  # noqa: SLF001

        def is_turned_away() -> bool:
            call.ask(b"clock")
            return call.socket is None

        wait_until(is_turned_away, 0.01)
        call.ask(b"clock")
        assert call.socket is not None, "the next question has a new socket"


def test_a_call_whose_cleanup_fails_allows_the_next() -> None:
    def interrupted(timeout_ms: int) -> None:
        raise KeyboardInterrupt

    def fails(*, lifts: bool = True) -> None:
        raise zmq.ZMQError(zmq.ETERM, str(lifts))

    world = World([])
    world.wait, world.asking.hang_up = interrupted, fails  # type: ignore[method-assign]
    with client(world) as graspd:
        with pytest.raises(zmq.ZMQError):
            graspd.may_i_lift(0.3)
        assert graspd.verdict().reasons == ("no-message",)


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
