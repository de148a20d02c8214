"""ZeroMQ sockets bound where nobody can miss what was there."""

from __future__ import annotations

from pathlib import Path
from typing import Self

import zmq

from daemon.socket_file import OccupiedError, SocketFile


class PublishError(Exception):
    """A socket cannot be had: fix the endpoint or stop whoever holds it."""


def socket_file(endpoint: str) -> SocketFile | None:
    """The file of an `ipc://` endpoint, taken; None for others. Raises `PublishError`."""
    if not endpoint.startswith("ipc://") or endpoint.startswith("ipc://@"):
        return None  # for TCP and abstract sockets the kernel refuses a second bind
    try:
        return SocketFile(Path(endpoint.removeprefix("ipc://")))
    except OccupiedError as error:
        raise PublishError(f"cannot publish on {endpoint}: {error}") from None
    except OSError as error:
        raise PublishError(f"cannot publish on {endpoint}: {error.strerror or error}") from error


def bind(socket: zmq.Socket[bytes], endpoint: str, file: SocketFile | None) -> None:
    """Bind to an endpoint and its file. Raises `zmq.ZMQError`."""
    socket.ipv6 = "[" in endpoint
    if file is None:
        socket.bind(endpoint)
        return
    # Left to itself libzmq would first remove whatever is at the path.
    socket.setsockopt(zmq.USE_FD, file.listener.fileno())
    socket.bind(endpoint)
    file.listener.detach()


class Bound:
    """A ZeroMQ context of its own for one bound socket, and the socket's file."""

    def __init__(self, endpoint: str) -> None:
        """Take the file of the endpoint. Raises `PublishError`."""
        self.endpoint = endpoint
        self._file = socket_file(endpoint)
        self._context = zmq.Context(io_threads=1)

    def close(self) -> None:
        """Close the socket and remove its file. May be called again."""
        self._context.destroy()
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()
