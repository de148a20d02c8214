"""The socket on which a grasp controller asks whether it may lift, and tells how lifts ended."""

from __future__ import annotations

import json
import re
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final, Literal

import zmq

from daemon.publish.binding import Binding, Bound
from daemon.publish.companion import Answer
from daemon.publish.messages import OBJECT_PATTERN

QUESTION = b"judge"
TELLING = b"outcome"
"""First word of `outcome <boot_id> <grasp> <stable|slip> [<object>]`."""
FRAMES_MAX = 3
"""Of a question: who asks, an empty frame from a REQ socket, the question."""
MESSAGE_MAX_BYTES = 128
"""The longest outcome; a peer that sends more asks nothing and is disconnected."""
WAITING_MAX = 16
"""Questions that wait for an answer; the oldest is given up for a newer one."""
QUEUE_MAX = 16
"""Messages queued per peer in either direction."""
_TOLD = re.compile(
    rb"outcome ([0-9a-f]{32}) ([0-9]{1,15}) (stable|slip)(?: (%b))?" % OBJECT_PATTERN.encode()
)
MALFORMED = "malformed: outcome <boot_id> <grasp> <stable|slip> [<object>]"
NOBODY = "nobody takes outcomes here"
TAKEN_MAX = 64
"""Messages, and at most so many frames, taken in one round: a flood must not hold up readings."""
LINGER_MS: Final = 100
"""How long the end waits for answers to be on their way."""

TakeOutcome = Callable[[str, int, Literal["stable", "slip"], str | None], str | None]
"""Takes a boot id, a grasp, how its lift ended, and the object if it was named; None, or why it
does not."""
Keep = Callable[[Answer], None]
"""Calls the answer once what was told is kept, or is known not to be."""


def at_once(answer: Answer) -> None:
    """Keep nothing: what was told is answered as it is told."""
    answer(None)


@dataclass(frozen=True, slots=True)
class _Question:
    envelope: tuple[bytes, ...]
    due_ns: int


class Questions(Bound):
    """Takes questions and answers them; never blocks.

    libzmq has no limit on the number of frames of a message, and holds them all before it hands the
    first one over. So only those who may make the daemon grow should be able to connect: keep the
    socket in a folder of yours.
    """

    def __init__(self, endpoint: str, patience_ns: int, binding: Binding | None = None) -> None:
        """Bind to `endpoint`; a question waits `patience_ns` at most. Raises `PublishError`."""
        super().__init__(endpoint, binding)
        self.counters: Counter[str] = Counter()
        """`asked`, `answered`, `given_up`, `malformed`; `outcomes` that were taken, and kept where
        that is wanted, and `outcomes_refused`."""
        self._patience_ns = patience_ns
        self._waiting: deque[_Question] = deque()
        self._frames: list[bytes] = []
        """Of the message at hand, as far as it has been read."""
        self.renew()

    def _open(self) -> zmq.Socket[bytes]:
        made = self._context.socket(zmq.ROUTER)
        made.linger = LINGER_MS
        made.sndhwm = made.rcvhwm = QUEUE_MAX
        made.maxmsgsize = MESSAGE_MAX_BYTES
        self._bind(made, "take questions")
        return made

    @property
    def waiting(self) -> int:
        """Questions without an answer."""
        return len(self._waiting)

    def fileno(self) -> int:
        """Becomes readable when something may have come; call `take` before waiting for it."""
        return int(self.socket.fileno())

    def due_ns(self) -> int | None:
        """When the oldest question must be answered, monotonic ns."""
        return self._waiting[0].due_ns if self._waiting else None

    def take(self, now_ns: int, outcome: TakeOutcome | None = None, keep: Keep = at_once) -> int:
        """Take in what has come; how many questions it was.

        Outcomes go to `outcome`; those that it takes are answered when `keep` says so.
        """
        taken = 0
        if not self.is_open:
            return taken
        for _ in range(TAKEN_MAX):
            if not int(self.socket.get(zmq.EVENTS)) & zmq.POLLIN:
                break
            frame = self.socket.recv(zmq.NOBLOCK)
            if len(self._frames) <= FRAMES_MAX:
                self._frames.append(frame)
            if not self.socket.get(zmq.RCVMORE):
                taken += self._take_message(now_ns, outcome, keep)
                self._frames.clear()
        self.counters["asked"] += taken
        return taken

    def _take_message(self, now_ns: int, outcome: TakeOutcome | None, keep: Keep) -> bool:
        *envelope, question = self._frames
        well = len(self._frames) <= FRAMES_MAX and envelope[1:] in ([], [b""])
        if well and question.partition(b" ")[0] == TELLING:
            why = _pass_on(question, outcome)
            answer = partial(self._answer_outcome, tuple(envelope))
            if why is None:
                keep(answer)
            else:
                answer(why)
            return False
        if question != QUESTION or not well:
            self.counters["malformed"] += 1
            return False
        if len(self._waiting) >= WAITING_MAX:
            self._waiting.popleft()
            self.counters["given_up"] += 1
        self._waiting.append(_Question(tuple(envelope), now_ns + self._patience_ns))
        return True

    def _answer_outcome(self, envelope: tuple[bytes, ...], why: str | None) -> None:
        """Say whether an outcome was of use. Whoever is gone misses it."""
        refused = "malformed" if why == MALFORMED else "outcomes_refused"
        self.counters["outcomes" if why is None else refused] += 1
        said = {"v": 1, "ok": True} if why is None else {"v": 1, "ok": False, "why": why}
        answer = json.dumps(said, separators=(",", ":")).encode()
        if self.is_open:
            self.socket.send_multipart((*envelope, answer), flags=zmq.NOBLOCK)

    def answer(self, payload: bytes, now_ns: int | None = None) -> None:
        """Answer all questions, or with `now_ns` those that can wait no longer.

        Whoever is gone misses it.
        """
        while (
            self.is_open and self._waiting and (now_ns is None or self._waiting[0].due_ns <= now_ns)
        ):
            question = self._waiting.popleft()
            self.socket.send_multipart((*question.envelope, payload), flags=zmq.NOBLOCK)
            self.counters["answered"] += 1


def _pass_on(text: bytes, take_outcome: TakeOutcome | None) -> str | None:
    """Pass on how a lift ended; None, or why that is of no use."""
    told = _TOLD.fullmatch(text)
    if told is None:
        return MALFORMED
    if take_outcome is None:
        return NOBODY
    outcome: Literal["stable", "slip"] = "slip" if told[3] == b"slip" else "stable"
    named = None if told[4] is None else told[4].decode()
    return take_outcome(told[1].decode(), int(told[2]), outcome, named)
