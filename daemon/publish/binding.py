"""Binds ZeroMQ sockets: never over another program's socket file, and on TCP for known keys."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import zmq

from daemon.publish.socket_file import OccupiedError, SocketFile

REBIND_S, REBIND_STEP_S = 0.5, 0.002
"""How long a closed socket may hold its port, s."""
CURVE_MESSAGE_MAX_BYTES = 1024
"""The longest message of the handshake, INITIATE, has 257 bytes and metadata (RFC 26)."""
HANDSHAKE_MS = 5000
"""Who connects and says nothing is disconnected after so long: libzmq's 30 s let a few strangers
hold more connections than the process may have."""
ZAP_DOMAIN = b"graspd"
"""Named in requests to whoever admits peers (RFC 27); libzmq asks nobody for an empty one."""


class PublishError(Exception):
    """A socket cannot be had: fix the endpoint or stop whoever holds it."""


@dataclass(frozen=True, slots=True, eq=False)
class Binding:
    """What the sockets of a scene share: context, rights of their files, keys."""

    context: zmq.Context[zmq.Socket[bytes]]
    """Has libzmq's own threads."""
    file_mode: int | None = None
    """Of the file of an `ipc://` socket; as the process's umask has it if None."""
    group: str | None = None
    """Of that file; the process's if None."""
    curve: tuple[bytes, bytes] | None = None
    """Public and secret key, Z85, for `tcp://`: only peers with keys that are admitted."""


def socket_file(endpoint: str, binding: Binding | None = None) -> SocketFile | None:
    """The file of an `ipc://` endpoint, taken; None for others. Raises `PublishError`."""
    if not endpoint.startswith("ipc://") or endpoint.startswith("ipc://@"):
        return None  # for TCP and abstract sockets the kernel refuses a second bind
    mode, group = (None, None) if binding is None else (binding.file_mode, binding.group)
    try:
        return SocketFile(Path(endpoint.removeprefix("ipc://")), mode, group)
    except (OccupiedError, LookupError) as error:
        raise PublishError(f"cannot publish on {endpoint}: {error}") from None
    except OSError as error:
        raise PublishError(f"cannot publish on {endpoint}: {error.strerror or error}") from error


class Bound(ABC):
    """One bound socket and, for `ipc://`, its file. A derived class opens it with `renew`."""

    def __init__(self, endpoint: str, binding: Binding | None = None) -> None:
        """Without a `binding`, in a context of its own, for whoever can reach the endpoint."""
        self.endpoint = endpoint
        self._binding = binding
        self._context = zmq.Context(io_threads=1) if binding is None else binding.context
        self._file: SocketFile | None = None
        self._made: zmq.Socket[bytes] | None = None

    @property
    def socket(self) -> zmq.Socket[bytes]:
        """The socket. Raises `PublishError` if it could not be opened again."""
        if self._made is None:
            raise PublishError(f"{self.endpoint} is closed")
        return self._made

    @property
    def is_open(self) -> bool:
        """False if the endpoint could not be had again."""
        return self._made is not None

    @abstractmethod
    def _open(self) -> zmq.Socket[bytes]:
        """A new socket, bound. Raises `PublishError`."""

    def renew(self) -> None:
        """Open the socket, or close all connections and open it again.

        Peers connect again by themselves, as far as they are still admitted. Raises `PublishError`
        if the endpoint cannot be had.
        """
        again = self._made is not None
        if self._made is not None:
            self._made.close(linger=0)
            self._made = None
        deadline_s = time.monotonic() + REBIND_S
        while True:
            try:
                self._made = self._open()
            except zmq.ZMQError as error:  # no more descriptors
                self.close()
                raise PublishError(f"{self.endpoint}: {error.strerror}") from error
            except PublishError:
                # A socket of ours that has just been closed may hold its port for a moment.
                if not again or time.monotonic() >= deadline_s:
                    self.close()
                    raise
                time.sleep(REBIND_STEP_S)
            else:
                return

    def _bind(self, made: zmq.Socket[bytes], what: str) -> None:
        """Bind a socket, or close it. Raises `PublishError`; `what` is what cannot be done."""
        self._remove_file()
        try:
            self._file = socket_file(self.endpoint, self._binding)
            self._admit_only_known(made)
            made.ipv6 = "[" in self.endpoint
            made.handshake_ivl = HANDSHAKE_MS
            if self._file is not None:
                # Left to itself libzmq would first remove whatever is at the path.
                made.setsockopt(zmq.USE_FD, self._file.listener.fileno())
            made.bind(self.endpoint)
        except PublishError:
            made.close(linger=0)
            raise
        except zmq.ZMQError as error:
            made.close(linger=0)
            raise PublishError(f"cannot {what} on {self.endpoint}: {error.strerror}") from error
        if self._file is not None:
            self._file.listener.detach()

    def _admit_only_known(self, made: zmq.Socket[bytes]) -> None:
        curve = None if self._binding is None else self._binding.curve
        if curve is None or not self.endpoint.startswith("tcp://"):
            return
        made.curve_publickey, made.curve_secretkey = curve
        made.curve_server = True
        made.zap_domain = ZAP_DOMAIN
        made.maxmsgsize = CURVE_MESSAGE_MAX_BYTES

    def _remove_file(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def close(self) -> None:
        """Close the socket and remove its file. May be called again."""
        if self._made is not None:
            self._made.close()
            self._made = None
        if self._binding is None:
            self._context.term()
        self._remove_file()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()
