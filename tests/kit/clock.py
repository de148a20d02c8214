"""A clock of the test."""

from __future__ import annotations


class Clock:
    """A clock that moves only when told to."""

    def __init__(self, now_ns: int = 10**12) -> None:
        self.now_ns = now_ns

    def __call__(self) -> int:
        return self.now_ns
