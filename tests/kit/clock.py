"""A clock that a test moves by hand."""

from __future__ import annotations


class Clock:
    """Clock, ns, that stands still until a test sets `now_ns`; call it for the time."""

    def __init__(self, now_ns: int = 10**12) -> None:
        self.now_ns = now_ns

    def __call__(self) -> int:
        return self.now_ns
