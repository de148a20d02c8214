"""What a listening socket must do, and where it may listen: never over another program's file."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from daemon.publish.socket_file import OccupiedError, SocketFile
from daemon.publish.zmtp import Message

if TYPE_CHECKING:
    import zmq


class PublishError(Exception):
    """A socket cannot be had: fix the endpoint or stop whoever holds it."""


@dataclass(frozen=True, slots=True, eq=False)
class OwnKeys:
    """For `tcp://`: only peers with keys that are admitted."""

    context: zmq.Context[zmq.Socket[bytes]]
    """Has libzmq's own threads, and the socket that admits peers."""
    public: bytes
    """Z85."""
    secret: bytes
    """Z85."""


@dataclass(frozen=True, slots=True, eq=False)
class Binding:
    """What the sockets of a scene share: rights of their files, keys."""

    file_mode: int | None = None
    """Of the file of an `ipc://` socket; as the process's umask has it if None."""
    group: str | None = None
    """Of that file; the process's if None."""
    curve: OwnKeys | None = None


def socket_file(endpoint: str, binding: Binding) -> SocketFile | None:
    """The file of an `ipc://` endpoint, taken; None for others. Raises `PublishError`."""
    if not endpoint.startswith("ipc://"):
        return None  # for TCP the kernel refuses a second bind
    path = Path(endpoint.removeprefix("ipc://"))
    try:
        return SocketFile(path, binding.file_mode, binding.group)
    except (OccupiedError, LookupError) as error:
        raise PublishError(f"cannot publish on {endpoint}: {error}") from None
    except OSError as error:
        why = error.strerror or str(error)
        if isinstance(error, FileNotFoundError) and not path.parent.exists():
            why = f"there is no folder {path.parent}; `graspd doctor SCENE` says who makes it"
        raise PublishError(f"cannot publish on {endpoint}: {why}") from error


class Peer(Protocol):
    """Who is connected, or was."""

    @property
    def is_open(self) -> bool:
        """Whether it may still be connected."""

    def stands_for(self, former: object) -> bool:
        """Whether it may speak for another peer of the same door: it is the same, or has taken its
        place."""

    def may_follow(self, former: object) -> bool:
        """Whether it is about to take the other's place, which may be about to go."""


class Door(ABC):
    """A listening socket and its connections."""

    counters: Counter[str]
    """What peers did that concerns no message."""

    @property
    @abstractmethod
    def is_open(self) -> bool:
        """False once it is closed, or could not be opened again."""

    @abstractmethod
    def fileno(self) -> int:
        """Becomes readable when somebody may want something; `receive` before waiting for it."""

    @abstractmethod
    def receive(self) -> Sequence[tuple[Peer, Message]]:
        """What peers have sent: some of it, so that a flood does not hold up readings."""

    @abstractmethod
    def send(self, peer: Peer, frames: Sequence[bytes]) -> None:
        """Send to one peer. Whoever is gone, or reads too slowly, misses it."""

    @abstractmethod
    def publish(self, topic: bytes, payload: bytes, to: Collection[Peer] | None = None) -> bool:
        """Send to all that want the topic, or to those of them named in `to` at least.

        False if some read too slowly and miss it.
        """

    @abstractmethod
    def wanted(self, topic: bytes) -> bool:
        """Whether somebody subscribes to a topic, as far as `receive` has seen."""

    @abstractmethod
    def close(self) -> None:
        """Close all connections once what waits is sent, for half a second at most."""
