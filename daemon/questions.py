"""The socket on which a grasp controller asks: is the grasp stable, now?"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

import zmq

from daemon.binding import Binding, Bound

QUESTION = b"judge"
FRAMES_MAX = 3
"""Of a question: who asks, an empty frame from a REQ socket, the question."""
MESSAGE_MAX_BYTES = 64
"""A peer that sends more asks nothing and is disconnected."""
WAITING_MAX = 16
"""Questions that wait for an answer; the oldest is given up for a newer one."""
QUEUE_MAX = 16
"""Messages queued per peer in either direction."""
TAKEN_MAX = 64
"""Messages, and at most so many frames, taken in one round: a flood must not hold up readings."""


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
        """`asked`, `answered`, `given_up`, `malformed`."""
        self._patience_ns = patience_ns
        self._waiting: deque[_Question] = deque()
        self._frames: list[bytes] = []
        """Of the message at hand, as far as it has been read."""
        self.renew()

    def _open(self) -> zmq.Socket[bytes]:
        made = self._context.socket(zmq.ROUTER)
        made.linger = 0
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

    def take(self, now_ns: int) -> int:
        """Take in what has come; how many questions it was."""
        taken = 0
        for _ in range(TAKEN_MAX):
            if not int(self.socket.get(zmq.EVENTS)) & zmq.POLLIN:
                break
            frame = self.socket.recv(zmq.NOBLOCK)
            if len(self._frames) <= FRAMES_MAX:
                self._frames.append(frame)
            if not self.socket.get(zmq.RCVMORE):
                taken += self._take_message(now_ns)
                self._frames.clear()
        self.counters["asked"] += taken
        return taken

    def _take_message(self, now_ns: int) -> bool:
        *envelope, question = self._frames
        if (
            question != QUESTION
            or len(self._frames) > FRAMES_MAX
            or envelope[1:] not in ([], [b""])
        ):
            self.counters["malformed"] += 1
            return False
        if len(self._waiting) >= WAITING_MAX:
            self._waiting.popleft()
            self.counters["given_up"] += 1
        self._waiting.append(_Question(tuple(envelope), now_ns + self._patience_ns))
        return True

    def answer(self, payload: bytes, now_ns: int | None = None) -> None:
        """Answer all questions, or with `now_ns` those that can wait no longer.

        Whoever is gone misses it.
        """
        while self._waiting and (now_ns is None or self._waiting[0].due_ns <= now_ns):
            question = self._waiting.popleft()
            self.socket.send_multipart((*question.envelope, payload), flags=zmq.NOBLOCK)
            self.counters["answered"] += 1
