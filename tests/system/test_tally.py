"""The tally of the step `can_overload`, from messages as a subscriber has them that came late."""

from __future__ import annotations

import contextlib
import json
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.lab import StepError
from tests.system.messages import Message, Messages
from tests.system.steps_verdicts import Tally

SILENCES = 4
READINGS = 10


@contextlib.contextmanager
def heard(folder: Path, first_seq: int) -> Iterator[Messages]:
    """Messages of a hand that is silent at first and is then read, from `first_seq` on."""
    messages, path = Messages(), folder / "messages"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as server:
        server.bind(str(path))
        server.listen()
        with messages.listening(path):
            machine, _ = server.accept()
            with machine:
                for seq in range(first_seq, SILENCES + READINGS):
                    still_ms = None if seq < SILENCES else 0.0
                    body = {"boot_id": "b", "seq": seq, "still_ms": still_ms, "t_mono_ns": 0}
                    told = {"t_s": seq + 1.0, "topic": "verdict.can", "body": body}
                    machine.sendall(json.dumps(told).encode() + b"\n")
                assert messages.wait(lambda m: last_of(m, SILENCES + READINGS - 1), 10.0)
            yield messages


def last_of(message: Message, seq: int) -> bool:
    return bool(message.body["seq"] == seq)


@pytest.mark.parametrize("first_seq", range(SILENCES + 1))
def test_silences_before_the_subscriber_came_are_no_readings(
    first_seq: int, tmp_path: Path
) -> None:
    with heard(tmp_path, first_seq) as messages:
        assert messages.readings("can") == READINGS


def test_what_is_not_accounted_for_is_told() -> None:
    former = Tally("b", sent=30, taken=30, dropped=0, readings=10, judged=12, skipped=0)
    later = Tally("b", sent=60, taken=57, dropped=3, readings=19, judged=18, skipped=3)
    assert later.since(former) == Tally("b", 30, 27, 3, 9, 6, 3)
    for wrong in (
        Tally("b", sent=60, taken=57, dropped=2, readings=19, judged=18, skipped=3),
        Tally("b", sent=60, taken=57, dropped=3, readings=19, judged=20, skipped=3),
        Tally("c", sent=60, taken=57, dropped=3, readings=19, judged=18, skipped=3),
    ):
        with pytest.raises(StepError):
            wrong.since(former)
