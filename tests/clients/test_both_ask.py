"""Both clients ask and tell a daemon that answers what it should not: only what fits counts."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zmq

from deploy.clients.python.graspd_client import (
    Client,
    LiftAnswer,
    Outcome,
)
from tests.clients.building import asked, cpp_lifts
from tests.clients.messages import TEACHES, TOPIC, verdict
from tests.kit.waiting import wait_until
from tests.threads import at_work

PERIOD_MS = 5
PATIENT_MS = 5000.0
"""Silence that this thread, on a busy machine, does not need."""
TAKEN_FRAMES = [b'{"v":1,"ok":true}']
DEADLINE_S = 0.3
Answer = Callable[[dict[str, Any]], list[bytes]]
"""What is answered, from the message that has just been published."""


def told(**change: object) -> Answer:
    """An answer that differs so from what has been published."""
    return lambda published: [json.dumps(published | change).encode()]


def of(outcome: str) -> Answer:
    """The answer of that verdict."""
    return lambda published: [
        json.dumps(verdict(published["seq"], published["t_mono_ns"], outcome)).encode()
    ]


@contextmanager
def false_daemon(
    folder: Path, answer: Answer, outcome: str = "stable", **more: object
) -> Iterator[list[bytes]]:
    """Publishes that verdict all the time, with what is `more`, and answers so.

    Gives what it is asked and told.
    """
    heard: list[bytes] = []
    with at_work(partial(_serve, folder, answer, outcome, more, heard)):
        yield heard


def _serve(
    folder: Path,
    answer: Answer,
    outcome: str,
    more: dict[str, Any],
    heard: list[bytes],
    stop: threading.Event,
) -> None:
    with (
        zmq.Context() as context,
        context.socket(zmq.PUB) as out,
        context.socket(zmq.ROUTER) as questions,
    ):
        out.linger = questions.linger = 0
        out.bind(f"ipc://{folder}/out")
        questions.bind(f"ipc://{folder}/ask")
        seq = 0
        while not stop.is_set():
            grasp = 1 + seq // more.get("messages_each", 10**6)
            fields = {"grasp": grasp, "silence_ms": PATIENT_MS, **more}
            message = verdict(seq, time.monotonic_ns(), outcome, **fields)
            out.send_multipart([TOPIC, json.dumps(message).encode()])
            seq += 1
            if questions.poll(PERIOD_MS):
                who, *question = questions.recv_multipart()
                heard.extend(question)
                told_of = question[0].startswith((b"outcome ", b"not-lifting"))
                assert told_of or question == [b"lift"]
                questions.send_multipart([who, *(TAKEN_FRAMES if told_of else answer(message))])


def says_no(ask: Callable[[], LiftAnswer], *reasons: str) -> None:
    """Ask until the reasons are these: on a busy machine a message may be old."""

    def is_so() -> bool:
        answer = ask()
        assert not answer
        return answer.verdict.reasons == reasons

    wait_until(is_so)


def cpp_reasons(lift_gate: Path, *words: object) -> list[str]:
    """Why the C++ example does not lift: what stands in its brackets."""
    result = asked(lift_gate, *words)
    assert result.returncode == 1
    return result.stdout.partition("[")[2].partition("]")[0].split()


ANSWERS: dict[str, tuple[Answer, str]] = {
    "the same": (told(), "stable"),
    "with a later field": (told(later="field"), "stable"),
    "slip": (of("slip"), "slip"),
    "unknown": (of("unknown"), "unknown"),
    "of another grasp": (told(grasp=2), "unknown"),
    "of another start": (told(boot_id="b"), "unknown"),
    "to come": (told(seq=10**6), "unknown"),
    "without sense": (told(p_slip=None), "unknown"),
    "not JSON": (lambda _: [b"stable"], "unknown"),
    "empty": (lambda _: [b""], "unknown"),
    "of two frames": (lambda published: told()(published) * 2, "unknown"),
}


@pytest.mark.parametrize(("answer", "expected"), ANSWERS.values(), ids=ANSWERS)
def test_only_an_answer_that_fits_allows_a_lift(
    lift_gate: Path, tmp_path: Path, answer: Answer, expected: str
) -> None:
    deadline_s = 100.0 if expected != "unknown" else DEADLINE_S
    places = [f"ipc://{tmp_path}/out", str(deadline_s), f"ipc://{tmp_path}/ask"]
    with false_daemon(tmp_path, answer), Client(places[0], ask_endpoint=places[2]) as graspd:
        said = graspd.may_i_lift(deadline_s)
        result = asked(lift_gate, *places)
    assert (bool(said), said.verdict.decision) == (expected == "stable", expected)
    assert result.stdout.split()[0] == expected
    assert (result.returncode == 0) == (expected == "stable")


SUPERVISED: dict[str, tuple[Answer, bool]] = {
    "the same": (told(), True),
    "not supervised": (told(supervised=False), False),
    "of another grasp": (told(grasp=2), False),
    "moving too": (told(reasons=["unproven", "moving"]), False),
    "of a later version": (told(v=2), False),
    "a number": (told(supervised=1), False),
    "without a risk's bound": (told(risk={"target": 0.05, "lifts": 1, "slips": 0}), False),
    "stable": (of("stable"), False),
    "early": (told(early=True), False),
}


@pytest.mark.parametrize(("answer", "may"), SUPERVISED.values(), ids=SUPERVISED)
def test_supervised_clients_lift_only_what_is_unproven(
    lift_gate: Path, tmp_path: Path, answer: Answer, may: bool
) -> None:
    places = [f"ipc://{tmp_path}/out", "30.0" if may else str(DEADLINE_S), f"ipc://{tmp_path}/ask"]
    with (
        false_daemon(tmp_path, answer, "unknown", **TEACHES),
        Client(places[0], ask_endpoint=places[2]) as graspd,
    ):
        said = graspd.may_i_lift(float(places[1]), supervised=True)
        assert (bool(said), said.supervised, bool(said.verdict)) == (may, may, False)
        result = asked(lift_gate, "--supervised", *places)
        assert (result.returncode, "\nlift supervised after" in result.stdout) == (not may, may)
        assert not cpp_lifts(lift_gate, places[0], DEADLINE_S, places[2])
        assert not graspd.may_i_lift(DEADLINE_S)


def test_a_supervised_lift_waits_while_messages_are_early(lift_gate: Path, tmp_path: Path) -> None:
    places = [f"ipc://{tmp_path}/out", str(DEADLINE_S)]
    with false_daemon(tmp_path, told(), "unknown", **TEACHES | {"early": True}):
        with Client(places[0]) as graspd:
            says_no(lambda: graspd.may_i_lift(DEADLINE_S, supervised=True), "not-still")
        assert not cpp_lifts(lift_gate, "--supervised", *places)


STILL: dict[str, tuple[dict[str, Any], bool, bool]] = {
    "for long": ({"still_ms": 1000}, True, True),
    "for just long enough": ({"still_ms": 240.0}, True, True),
    "for a moment less": ({"still_ms": 239.999999}, False, True),
    "early": ({"still_ms": 130.0, "early": True}, False, True),
    "moving": ({"still_ms": 0.0}, False, True),
    "not known": ({"still_ms": None}, False, True),
    "not told": ({}, False, True),
    "no number": ({"still_ms": float("nan")}, False, False),
    "true": ({"still_ms": True}, False, False),
}
"""What the daemon says, whether one may lift who wants 240 ms, and who does not ask for any."""


@pytest.mark.parametrize(("says", "may", "may_at_once"), STILL.values(), ids=STILL)
def test_a_lift_waits_for_the_stillness_that_is_asked_for(
    lift_gate: Path, tmp_path: Path, says: dict[str, Any], may: bool, may_at_once: bool
) -> None:
    out = f"ipc://{tmp_path}/out"
    with false_daemon(tmp_path, told(), **says), Client(out) as graspd:
        for still_ms, allowed in ((240.0, may), (None, may_at_once)):
            deadline_s = 100.0 if allowed else DEADLINE_S
            assert bool(graspd.may_i_lift(deadline_s, still_ms=still_ms)) is allowed
            if may_at_once and not allowed:
                says_no(partial(graspd.may_i_lift, DEADLINE_S, still_ms=240.0), "not-still")
            still = [] if still_ms is None else ["--still", still_ms]
            assert cpp_lifts(lift_gate, *still, out, deadline_s) is allowed


@pytest.mark.parametrize("newest_ms", [130.0, 250.0, None])
@pytest.mark.parametrize("answer_ms", [130.0, 250.0, None])
def test_both_answer_and_newest_message_must_have_been_still(
    lift_gate: Path, tmp_path: Path, newest_ms: float | None, answer_ms: float | None
) -> None:
    places = [f"ipc://{tmp_path}/out", f"ipc://{tmp_path}/ask"]
    may = newest_ms == answer_ms == 250.0
    deadline_s = 100.0 if may else DEADLINE_S
    with (
        false_daemon(tmp_path, told(still_ms=answer_ms), still_ms=newest_ms),
        Client(places[0], ask_endpoint=places[1]) as graspd,
    ):
        assert bool(graspd.may_i_lift(deadline_s, still_ms=240.0)) is may
        words = ["--still", "240", places[0], str(deadline_s), places[1]]
        assert cpp_lifts(lift_gate, *words) is may


@pytest.mark.parametrize("still_ms", [-1.0, float("nan"), float("inf"), True, "240"])
def test_a_stillness_that_is_not_a_time_is_refused(
    lift_gate: Path,
    tmp_path: Path,
    still_ms: Any,  # noqa: ANN401
) -> None:
    out = f"ipc://{tmp_path}/out"
    with Client(out) as graspd, pytest.raises((ValueError, TypeError)):
        graspd.may_i_lift(DEADLINE_S, still_ms=still_ms)
    if isinstance(still_ms, float):
        assert asked(lift_gate, "--still", still_ms, out, DEADLINE_S).returncode == 2


@pytest.mark.parametrize("outcome", ["unknown", "slip"])
def test_an_answer_alone_allows_no_lift(lift_gate: Path, tmp_path: Path, outcome: str) -> None:
    places = [f"ipc://{tmp_path}/out", str(DEADLINE_S), f"ipc://{tmp_path}/ask"]
    with (
        false_daemon(tmp_path, of("stable"), outcome),
        Client(places[0], ask_endpoint=places[2]) as graspd,
    ):
        assert not graspd.may_i_lift(DEADLINE_S)
        assert not cpp_lifts(lift_gate, *places)


@pytest.mark.parametrize("reasons", [["moving"], ["settling", "joints-late"]])
@pytest.mark.parametrize("answers", [True, False])
def test_a_missing_answer_is_told_beside_motion(
    lift_gate: Path, tmp_path: Path, reasons: list[str], answers: bool
) -> None:
    out, ask = f"ipc://{tmp_path}/out", f"ipc://{tmp_path}/{'ask' if answers else 'nobody'}"
    deadline_s = 1.0 if answers else DEADLINE_S
    expected = [*reasons, *([] if answers else ["no-answer"])]
    with (
        false_daemon(tmp_path, told(), "unknown", reasons=reasons),
        Client(out, ask_endpoint=ask) as graspd,
    ):
        says_no(lambda: graspd.may_i_lift(deadline_s), *expected)
        wait_until(lambda: cpp_reasons(lift_gate, out, deadline_s, ask) == expected)


@pytest.mark.parametrize(
    ("answer", "outcome", "may"),
    [(told(), "stable", True), (told(), "unknown", False), (told(grasp=2), "stable", False)],
    ids=["yes", "no", "of another grasp"],
)
def test_a_no_takes_the_lift_back(
    lift_gate: Path, tmp_path: Path, answer: Answer, outcome: str, may: bool
) -> None:
    """In C++ too: each client says so once for each connection that asked."""
    places = [f"ipc://{tmp_path}/out", "30.0" if may else str(DEADLINE_S), f"ipc://{tmp_path}/ask"]
    with false_daemon(tmp_path, answer, outcome) as heard:

        def is_over() -> bool:  # on a busy machine a client may not get to ask in time
            with Client(places[0], ask_endpoint=places[2]) as graspd:
                assert bool(graspd.may_i_lift(float(places[1]))) is may
            return may or b"not-lifting" in heard

        wait_until(is_over)
    with false_daemon(tmp_path, answer, outcome) as heard_of_cpp:

        def is_over_in_cpp() -> bool:
            assert cpp_lifts(lift_gate, *places) is may
            return may or b"not-lifting" in heard_of_cpp

        wait_until(is_over_in_cpp)
    for each in (heard, heard_of_cpp):
        assert (each[0], b"not-lifting" in each) == (b"lift", not may)


def test_a_yes_that_no_lift_follows_is_told(tmp_path: Path) -> None:
    places = [f"ipc://{tmp_path}/out", f"ipc://{tmp_path}/ask"]
    with (
        false_daemon(tmp_path, told()) as heard,
        Client(places[0], ask_endpoint=places[1]) as graspd,
    ):
        verdict = graspd.may_i_lift(30.0).verdict
        assert graspd.tell(verdict, Outcome.NOT_LIFTED, wait_s=30.0)
        assert heard[-1].endswith(b" 1 not-lifted")
        assert graspd.may_i_lift(30.0), "it is offered again"
        assert graspd.unreported == 0
