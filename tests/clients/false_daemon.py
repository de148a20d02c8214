"""A stand-in for the daemon that publishes and answers what a test gives it, right or wrong."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import zmq

from tests.clients.messages import TOPIC, verdict
from tests.threads import at_work

PERIOD_MS = 5
PATIENT_MS = 5000.0
"""`silence_ms` of the messages, ms: longer than this thread pauses on a busy machine."""
TAKEN = b'{"v":1,"ok":true}'
Answer = Callable[[dict[str, Any]], list[bytes]]
"""Makes the frames of the answer to `lift` from the message that was published last."""


def told(**change: object) -> Answer:
    """Answer with the message published last, with the fields `change` replaced."""
    return lambda published: [json.dumps(published | change).encode()]


def of(outcome: str) -> Answer:
    """Answer with a verdict of this outcome on the reading published last."""
    return lambda published: [
        json.dumps(verdict(published["seq"], published["t_mono_ns"], outcome)).encode()
    ]


@contextmanager
def false_daemon(
    folder: Path,
    answer: Answer | None = None,
    outcome: str = "stable",
    taken: Sequence[bytes] = (TAKEN,),
    endpoint: str | None = None,
    **more: object,
) -> Iterator[list[bytes]]:
    """Publish verdicts of `outcome`, with fields `more`, during the block, and answer `lift`.

    A field may be a function of what was received so far.
    `messages_each` in `more`: messages on each grasp, else all are on one. `answer` None: with what
    was published. Frames `taken` answer an outcome and `not-lifting`. Without frames no answer is
    sent. `endpoint`: where to publish; None: at `out` in `folder`. Yields the list of what was
    received so far: `lift`, `not-lifting` and outcomes.
    """
    heard: list[bytes] = []
    out = endpoint or f"ipc://{folder}/out"
    with at_work(partial(_serve, out, folder, answer or told(), outcome, taken, more, heard)):
        yield heard


def _serve(
    endpoint: str,
    folder: Path,
    answer: Answer,
    outcome: str,
    taken: Sequence[bytes],
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
        out.ipv6 = "[" in endpoint
        out.bind(endpoint)
        questions.bind(f"ipc://{folder}/ask")
        seq = 0
        while not stop.is_set():
            grasp = 1 + seq // more.get("messages_each", 10**6)
            said = {
                name: value(heard) if callable(value) else value for name, value in more.items()
            }
            fields = {"grasp": grasp, "silence_ms": PATIENT_MS, **said}
            message = verdict(seq, time.monotonic_ns(), outcome, **fields)
            out.send_multipart([TOPIC, json.dumps(message).encode()])
            seq += 1
            if questions.poll(PERIOD_MS):
                who, *question = questions.recv_multipart()
                heard.extend(question)
                told_of = question[0].startswith((b"outcome ", b"not-lifting"))
                assert told_of or question == [b"lift"]
                frames = taken if told_of else answer(message)
                if frames:
                    questions.send_multipart([who, *frames])
