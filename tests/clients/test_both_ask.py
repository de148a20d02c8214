"""Both clients ask a daemon that answers what it should not: only what fits allows a lift."""

from __future__ import annotations

import json
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zmq

from deploy.clients.python.graspd_client import Graspd
from tests.clients.messages import TOPIC, verdict

PERIOD_MS = 5
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
def false_daemon(folder: Path, answer: Answer, outcome: str = "stable") -> Iterator[None]:
    """Publishes that verdict all the time, and answers so."""
    stop = threading.Event()
    thread = threading.Thread(target=_serve, args=(folder, answer, outcome, stop))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def _serve(folder: Path, answer: Answer, outcome: str, stop: threading.Event) -> None:
    with (
        zmq.Context() as context,
        context.socket(zmq.PUB) as out,
        context.socket(zmq.ROUTER) as asked,
    ):
        out.linger = asked.linger = 0
        out.bind(f"ipc://{folder}/out")
        asked.bind(f"ipc://{folder}/ask")
        seq = 0
        while not stop.is_set():
            message = verdict(seq, time.monotonic_ns(), outcome)
            out.send_multipart([TOPIC, json.dumps(message).encode()])
            seq += 1
            if asked.poll(PERIOD_MS):
                who, *question = asked.recv_multipart()
                assert question == [b"judge"]
                asked.send_multipart([who, *answer(message)])


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
    tmp_path: Path, answer: Answer, expected: str
) -> None:
    with (
        false_daemon(tmp_path, answer),
        Graspd(f"ipc://{tmp_path}/out", ask_endpoint=f"ipc://{tmp_path}/ask") as graspd,
    ):
        said = graspd.may_i_lift(30.0 if expected != "unknown" else DEADLINE_S)
    assert (bool(said), said.verdict.verdict) == (expected == "stable", expected)


@pytest.mark.parametrize(("answer", "expected"), ANSWERS.values(), ids=ANSWERS)
def test_in_cpp_only_an_answer_that_fits_allows_a_lift(
    lift_gate: Path, tmp_path: Path, answer: Answer, expected: str
) -> None:
    deadline_s = 30.0 if expected != "unknown" else DEADLINE_S
    places = [f"ipc://{tmp_path}/out", str(deadline_s), f"ipc://{tmp_path}/ask"]
    with false_daemon(tmp_path, answer):
        result = subprocess.run(
            [lift_gate, *places], capture_output=True, text=True, timeout=40, check=False
        )
    assert result.stdout.split()[0] == expected
    assert (result.returncode == 0) == (expected == "stable")


@pytest.mark.parametrize("outcome", ["unknown", "slip"])
def test_an_answer_alone_allows_no_lift(lift_gate: Path, tmp_path: Path, outcome: str) -> None:
    places = [f"ipc://{tmp_path}/out", str(DEADLINE_S), f"ipc://{tmp_path}/ask"]
    with (
        false_daemon(tmp_path, of("stable"), outcome),
        Graspd(places[0], ask_endpoint=places[2]) as graspd,
    ):
        assert not graspd.may_i_lift(DEADLINE_S)
        assert (
            subprocess.run([lift_gate, *places], capture_output=True, check=False).returncode == 1
        )
