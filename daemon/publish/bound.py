"""A socket by its endpoint: read by graspd itself, or with keys by libzmq."""

from __future__ import annotations

from collections import Counter
from typing import Self

from daemon.publish.binding import Binding, Door
from daemon.publish.zmtp import Role


class Bound:
    """A socket with an endpoint; a derived class says what is done with its messages."""

    def __init__(
        self, endpoint: str, role: Role, high_water_mark: int, binding: Binding | None
    ) -> None:
        """Bind, queueing so many messages per peer, without a `binding` for whoever can reach the
        endpoint. Raises `PublishError`."""
        self.endpoint = endpoint
        binding = Binding() if binding is None else binding
        self.door: Door
        if binding.curve is not None and endpoint.startswith("tcp://"):
            from daemon.publish.curve import CurveDoor

            self.door = CurveDoor(endpoint, role, high_water_mark, binding.curve)
        else:
            from daemon.publish.peers import PlainDoor

            self.door = PlainDoor(endpoint, role, high_water_mark, binding)

    @property
    def is_open(self) -> bool:
        """False once it is closed, or could not be opened again."""
        return self.door.is_open

    def fileno(self) -> int:
        """Becomes readable when something may have come; call `take` before waiting for it."""
        return self.door.fileno()

    def _with_the_doors(self, counted: Counter[str]) -> Counter[str]:
        """What was counted here, and what the door has counted."""
        return Counter(dict(counted) | dict(self.door.counters))

    def close(self) -> None:
        """Close the socket and remove its file. May be called again."""
        self.door.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()
