"""The socket that carries the messages, and nothing else."""

from __future__ import annotations

import select
import time
from collections import Counter
from collections.abc import Callable
from typing import Protocol

from daemon.publish.binding import Binding, Peer
from daemon.publish.bound import Bound
from daemon.publish.zmtp import SUBSCRIBE, Role

VERDICT = b"verdict."
"""What the topics of verdicts begin with."""
REPEATED = (VERDICT, b"status.")
"""Topics whose last message is for those who come later, too."""
VERDICT_REPEATED_NS = 100_000_000
"""An older verdict is not repeated: who gets it would take it for new."""
REPEAT_NS = 50_000_000
"""New subscribers get the last messages at once, but with keys everybody sees that: so often at
most."""
LOOK_MS = 100.0
"""So often a publisher that waits looks after its peers, ms."""


class Stop(Protocol):
    """What ends waiting: its descriptor becomes readable."""

    def fileno(self) -> int:
        """Descriptor to wait on."""


class Publisher(Bound):
    """Publishes two-frame messages `[topic, payload]`; never blocks the caller.

    Whoever subscribes gets the last status and, if it is fresh, the last verdict at once; with keys
    others may see such a message twice, with the same `seq`.

    A subscriber that falls behind by the high-water mark loses messages, which is counted, and sees
    the gap in `seq`; it cannot delay anyone else.
    """

    def __init__(
        self,
        endpoint: str,
        high_water_mark: int = 1000,
        binding: Binding | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Bind to `endpoint`, queueing so many messages per peer. Raises `PublishError`."""
        super().__init__(endpoint, Role.XPUB, high_water_mark, binding)
        self._counted = Counter(queues_full=0, repeated=0, subscriptions=0)
        self._clock = clock
        self._last: dict[bytes, tuple[bytes, int]] = {}
        """Last payload, and when it was sent, by topic; the daemon has two."""
        self._owed: dict[bytes, set[Peer]] = {}
        """Topics whose last message somebody waits for."""
        self._repeat_due_ns = 0

    @property
    def counters(self) -> Counter[str]:
        """How often a peer's queue was full (it misses the oldest message there, with keys the
        newest, as `seq` tells), messages repeated for new peers, subscriptions, and what the door
        counts."""
        return self._with_the_doors(self._counted)

    def send(self, topic: bytes, payload: bytes) -> None:
        """Send one message, and keep it for those who come later."""
        self._take()
        if topic.startswith(REPEATED):
            self._last[topic] = (payload, self._clock())
            self._owed.pop(topic, None)  # this one is newer
        if not self.door.publish(topic, payload):
            self._counted["queues_full"] += 1

    def take(self) -> None:
        """See who has subscribed, and repeat the last messages for them."""
        self._take()
        if self._owed:
            self._repeat()

    def wanted(self, topic: bytes) -> bool:
        """Whether somebody subscribes to a topic, as far as `take` has seen."""
        return self.door.wanted(topic)

    def _take(self) -> None:
        for peer, message in self.door.receive():
            if message[0][:1] == SUBSCRIBE:
                self._counted["subscriptions"] += 1
                for topic in self._last:
                    if topic.startswith(message[0][1:]):
                        self._owed.setdefault(topic, set()).add(peer)

    def _repeat(self) -> None:
        now_ns = self._clock()
        if now_ns < self._repeat_due_ns:
            return
        self._repeat_due_ns = now_ns + REPEAT_NS
        for topic, peers in self._owed.items():
            payload, sent_ns = self._last[topic]
            if not topic.startswith(VERDICT) or now_ns - sent_ns <= VERDICT_REPEATED_NS:
                self._counted["queues_full"] += not self.door.publish(topic, payload, peers)
                self._counted["repeated"] += 1
        self._owed.clear()

    def forget(self) -> None:
        """Repeat nothing of what was sent up to now."""
        self._last.clear()
        self._owed.clear()

    def wait_for_subscriber(self, timeout_s: float, stop: Stop | None = None) -> bool:
        """Wait until somebody subscribes.

        False if nobody has within `timeout_s` seconds or when `stop` becomes readable.
        """
        deadline_s = time.monotonic() + timeout_s
        poller = select.poll()
        poller.register(self.fileno(), select.POLLIN)
        if stop is not None:
            poller.register(stop.fileno(), select.POLLIN)
        while True:
            self._take()
            if self._counted["subscriptions"]:
                return True
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0.0:
                return False
            ready = poller.poll(min(remaining_s * 1e3, LOOK_MS))
            if stop is not None and stop.fileno() in dict(ready):
                return False
