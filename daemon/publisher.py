"""The ZeroMQ socket that carries the messages, and nothing else."""

from __future__ import annotations

import fcntl
import math
import os
import time
from pathlib import Path
from types import TracebackType
from typing import Self

import zmq

SUBSCRIBED = 1
"""First byte of a subscription message on an XPUB socket."""
SUBSCRIPTION_MAX_BYTES = 1024
"""A peer that sends more is no subscriber and is disconnected: a subscription is a topic prefix."""
LINGER_MS = 500
"""How long closing waits for subscribers to take what is still queued, ms."""


class PublishError(Exception):
    """The socket cannot be had: fix the endpoint or stop whoever holds it."""


class Publisher:
    """Publishes two-frame messages `[topic, payload]`; never blocks the caller.

    A subscriber that falls behind by the high-water mark loses messages, and sees the gap in
    `seq`; it cannot delay anyone else.
    """

    def __init__(self, endpoint: str, high_water_mark: int = 1000) -> None:
        """Bind to `endpoint`. Raises `PublishError`."""
        self.endpoint = endpoint
        self.subscriptions = 0
        self._lock = _lock(endpoint)
        self._context = zmq.Context(io_threads=1)
        self._socket = self._context.socket(zmq.XPUB)
        self._socket.linger = LINGER_MS
        self._socket.sndhwm = high_water_mark
        self._socket.maxmsgsize = SUBSCRIPTION_MAX_BYTES
        try:
            self._socket.bind(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise PublishError(f"cannot publish on {endpoint}: {error.strerror}") from error

    def send(self, topic: bytes, payload: bytes) -> None:
        """Hand one message to ZeroMQ."""
        self._socket.send_multipart((topic, payload), flags=zmq.NOBLOCK, copy=True)

    def drain(self) -> None:
        """Take in what subscribers have sent: (un)subscriptions are counted, the rest dropped."""
        while self._socket.poll(0):
            message = self._socket.recv(zmq.NOBLOCK)
            if message[:1] in {b"\x00", b"\x01"}:
                self.subscriptions += 1 if message[0] == SUBSCRIBED else -1

    def wait_for_subscriber(self, timeout_s: float) -> bool:
        """Wait until somebody has subscribed; False if nobody has within `timeout_s` seconds."""
        deadline_s = time.monotonic() + timeout_s
        while self.subscriptions < 1:
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0 or not self._socket.poll(math.ceil(remaining_s * 1e3)):
                return False
            self.drain()
        return True

    def close(self) -> None:
        """Close the socket and remove its file. May be called again."""
        self._context.destroy()
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class _FileLock:
    """Holds `<socket>.lock`, because binding would silently take a living socket's place."""

    def __init__(self, socket_path: Path) -> None:
        self._socket_path = socket_path
        self._path = path = Path(f"{socket_path}.lock")
        while True:
            self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(self._descriptor)
                raise
            if self._is_still_there():
                return
            os.close(self._descriptor)  # its former holder removed it while we were opening it

    def _is_still_there(self) -> bool:
        try:
            return self._path.stat().st_ino == os.fstat(self._descriptor).st_ino
        except FileNotFoundError:
            return False

    def release(self) -> None:
        self._socket_path.unlink(missing_ok=True)  # libzmq leaves it
        self._path.unlink(missing_ok=True)
        os.close(self._descriptor)


def _lock(endpoint: str) -> _FileLock | None:
    if not endpoint.startswith("ipc://") or endpoint.startswith("ipc://@"):
        return None  # for TCP and abstract sockets the kernel refuses a second bind
    path = Path(endpoint.removeprefix("ipc://"))
    try:
        return _FileLock(path)
    except BlockingIOError:
        raise PublishError(
            f"cannot publish on {endpoint}: another graspd publishes there"
        ) from None
    except OSError as error:
        raise PublishError(f"cannot publish on {endpoint}: {error.strerror}") from error
