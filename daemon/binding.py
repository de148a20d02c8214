"""ZeroMQ sockets bound where nobody can miss what was there."""

from __future__ import annotations

from pathlib import Path

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
