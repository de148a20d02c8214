"""A socket for those who want the newest verdict and nothing else (`ZMQ_CONFLATE`)."""

from __future__ import annotations

import zmq

from daemon.publish.binding import Binding, Bound
from daemon.publish.publisher import SUBSCRIPTION_MAX_BYTES, SUBSCRIPTIONS_WAITING_MAX

LINGER_MS = 0
"""What is late is not the newest."""
WAITING_MAX = 100
"""Messages that wait for a peer that does not read, a second's; it conflates at its own end."""


class Latest(Bound):
    """Publishes verdicts as messages of one frame, which a conflating subscriber needs."""

    def __init__(self, endpoint: str, binding: Binding | None = None) -> None:
        """Bind to `endpoint`. Raises `PublishError`."""
        super().__init__(endpoint, binding)
        self.renew()

    def _open(self) -> zmq.Socket[bytes]:
        made = self._context.socket(zmq.PUB)
        made.linger = LINGER_MS
        made.sndhwm = WAITING_MAX
        made.rcvhwm = SUBSCRIPTIONS_WAITING_MAX
        made.maxmsgsize = SUBSCRIPTION_MAX_BYTES
        self._bind(made, "publish")
        return made

    def send(self, payload: bytes) -> None:
        """Hand one payload to ZeroMQ; never blocks."""
        if self.is_open:
            self.socket.send(payload, flags=zmq.NOBLOCK)
