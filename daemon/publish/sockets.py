"""The sockets of a scene, and the keys of peers that may connect."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Self

from graspd.daemon.judge.reasons import Reason
from graspd.daemon.publish.companion import Companion, PublishedVerdict, Requests
from graspd.daemon.publish.door import Door
from graspd.daemon.publish.listener import Listener, user_id
from graspd.daemon.scene import Scene
from graspd.daemon.scene.scene import Curve

if TYPE_CHECKING:
    from graspd.daemon.process.signals import StopSignal
    from graspd.daemon.publish.questions import Questions

log = logging.getLogger("graspd")

TACTILE = b"tactile."
HIGH_WATER_MARK = 10
"""Most messages that wait for a subscriber: a tenth of a second of verdicts at 100 Hz.

With more a slow subscriber would read of the past.
"""
NEVER_NS = 10**18
"""Longest period of readings, ns: one after thirty years."""


class Sockets(Companion):
    """The sockets, open until `close`."""

    def __init__(
        self,
        wanted: Scene,
        clock: Callable[[], int] = time.monotonic_ns,
        *,
        high_water_mark: int | None = None,
    ) -> None:
        """Raises `PublishError` or `KeysError`.

        `clock` gives monotonic ns. `high_water_mark`: most messages that wait for a subscriber;
        None: `HIGH_WATER_MARK`.
        """
        self.endpoint = wanted.endpoint
        self._clock = clock
        self._counters = Counter(dropped=0)
        tactile_hz = wanted.publish.tactile_hz
        self._tactile_period_ns = round(min(1e9 / tactile_hz, NEVER_NS)) if tactile_hz else None
        self._tactile_due_ns = 0
        keys = None if wanted.curve is None else _load_keys(wanted.curve)
        self._door: Door | None = None
        """None after `close`."""
        self.questions: Questions | None = None
        self._listeners: list[Listener] = []
        """Endpoint of the messages, then that of the questions, if peers may ask."""
        try:
            self._listen(wanted)
            self._door = Door(self._listeners, high_water_mark or HIGH_WATER_MARK, keys)
            if self.questions is not None:
                self.filenos = [self._door.fileno()]
        except BaseException:
            self.close()
            raise

    def _listen(self, wanted: Scene) -> None:
        publish = wanted.publish
        mode = None if publish.file_mode is None else int(publish.file_mode, 8)
        self._listeners.append(Listener(wanted.endpoint, mode, publish.group))
        if wanted.ask_endpoint is not None:
            ask = Listener(wanted.ask_endpoint, wanted.ask_file_mode, publish.group)
            self._listeners.append(ask)
            from graspd.daemon.publish.questions import Questions  # only where peers may ask

            tells = None if wanted.ask is None or wanted.ask.tell is None else self._tells(wanted)
            self.questions = Questions(self._answer, round(wanted.gate.request_ms * 1e6), tells)

    def _tells(self, wanted: Scene) -> Callable[[bytes], bool]:
        """Return whether the scene lets a credential lift and tell."""
        names = () if wanted.ask is None else wanted.ask.tell or ()
        if (wanted.ask_endpoint or "").startswith("ipc://"):
            return {b"user %d" % user_id(name) for name in names}.__contains__
        return {b"key " + name.encode() for name in names}.__contains__

    def send(self, topic: bytes, payload: bytes) -> None:
        """Publish one message; count it if it is dropped."""
        if self._door is None or not self._door.send(topic, payload):
            self._counters["dropped"] += 1

    def wanted(self, topic: bytes) -> bool:
        """Return True if a message of this topic is due; readings are sent at `tactile_hz`."""
        if not topic.startswith(TACTILE):
            return True
        if self._tactile_period_ns is None:
            return False
        now_ns = self._clock()
        # Half a period early is in time: readings at this very rate jitter.
        if now_ns < self._tactile_due_ns - self._tactile_period_ns // 2:
            return False
        self._tactile_due_ns = max(self._tactile_due_ns, now_ns) + self._tactile_period_ns
        return True

    def _answer(self, frames: Sequence[bytes]) -> bool:
        return self._door is not None and self._door.answer(frames)

    def before_wait(self, requests: Requests) -> int | None:
        """Take and answer questions; return when the next answer is due, monotonic ns."""
        if self._door is None:
            return None
        self._door.check()
        if self.questions is None:
            return None
        return self.questions.serve(self._door.receive(), self._clock(), requests)

    def on_verdict(self, published: PublishedVerdict) -> None:
        """Answer the questions with an answer; with another verdict only those that are due."""
        if self.questions is not None:
            self.questions.answer(published, None if published.is_answer else self._clock())

    @property
    def counters(self) -> dict[str, dict[str, int]]:
        counters = {"publish": dict(self._counters)}
        if self.questions is not None:
            counters["ask"] = dict(self.questions.counters)
        return counters

    @property
    def health(self) -> dict[str, Reason]:
        late = self._door is not None and self._door.is_late
        return {"publish": Reason.HEARD_LATE} if late else {}

    def wait_for_subscriber(self, timeout_s: float, stop: StopSignal | None = None) -> bool:
        return self._door is not None and self._door.wait_for_subscriber(timeout_s, stop)

    def close(self) -> None:
        if self._door is not None and not self._door.close():
            log.warning("%s: libzmq's process did not end and was killed", self.endpoint)
        self._door = None
        for listener in self._listeners:
            listener.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()


def _load_keys(curve: Curve) -> tuple[str, str, str]:
    from graspd.daemon.publish import keys  # only where there are any

    public, secret = keys.load_own(curve.secret_key)
    keys.load_clients(curve.clients)  # raises `KeysError` where it can be mended
    return public.decode(), secret.decode(), str(curve.clients)
