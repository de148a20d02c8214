"""Messages that a subscriber in the emulated machine receives, with arrival by its clock."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from tests.threads import at_work

RECEIVE_BYTES: Final = 65536
LOOK_S: Final = 0.2
"""Time between the listening thread's checks that it must end, s."""


@dataclass(frozen=True, slots=True)
class Message:
    """One message of a daemon."""

    t_s: float
    """Time of arrival, s, by the emulated machine's monotonic clock."""
    kind: str
    """Topic without the hand, such as `verdict`, `gate`, `status`."""
    hand: str
    body: dict[str, Any]

    @property
    def made_s(self) -> float:
        """Time of its reading, or of sending if it has none, s, by the same clock as `t_s`."""
        return float(self.body["t_mono_ns"]) / 1e9

    @property
    def told(self) -> bool:
        """True for a verdict on a reading; False for one that none came, and for other kinds."""
        return self.kind == "verdict" and self.body["still_ms"] is not None


Wanted = Callable[[Message], bool]


class Messages:
    """All messages so far, kept by a thread that listens."""

    def __init__(self) -> None:
        self._all: list[Message] = []
        self._changed = threading.Condition()

    @contextlib.contextmanager
    def listening(self, path: Path) -> Iterator[None]:
        """Collect messages during the block, from the Unix socket of the machine's port."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as port:
            port.connect(str(path))
            port.settimeout(LOOK_S)
            with at_work(partial(self._listen, port)):
                yield

    def wait(self, wanted: Wanted, timeout_s: float, after_s: float = 0.0) -> Message | None:
        """Return the first message after `after_s` for which `wanted` is True, None if none comes
        in `timeout_s`; searches earlier messages too."""
        deadline_s = time.monotonic() + timeout_s
        at = 0
        with self._changed:
            while True:
                for message in self._all[at:]:
                    if message.t_s > after_s and wanted(message):
                        return message
                at = len(self._all)
                if not self._changed.wait(max(deadline_s - time.monotonic(), 0.0)):
                    return None

    def between(self, hand: str, kind: str, from_s: float, to_s: float) -> list[Message]:
        """Return the messages of a hand and kind that came after `from_s`, up to `to_s`."""
        with self._changed:
            found = list(self._all)
        return [m for m in found if (m.hand, m.kind) == (hand, kind) and from_s < m.t_s <= to_s]

    def last(self, hand: str, kind: str) -> Message | None:
        """Return the newest message of a hand and kind; None if there is none."""
        return next(reversed(self.between(hand, kind, 0.0, float("inf"))), None)

    def _listen(self, port: socket.socket, stop: threading.Event) -> None:
        rest = b""
        while not stop.is_set():
            try:
                chunk = port.recv(RECEIVE_BYTES)
            except TimeoutError:
                continue
            if not chunk:
                return
            *lines, rest = (rest + chunk).split(b"\n")
            self._take(lines)

    def _take(self, lines: list[bytes]) -> None:
        taken = []
        for line in lines:
            told = json.loads(line)
            kind, hand = told["topic"].split(".", 1)
            taken.append(Message(told["t_s"], kind, hand, told["body"]))
        with self._changed:
            self._all += taken
            self._changed.notify_all()
