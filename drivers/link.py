"""State of a link: up or why not, and when it is tried again, by a backoff with a cap."""

from __future__ import annotations

import logging
from enum import StrEnum

from drivers.base import Fact, LinkCause

BACKOFF_FIRST_S = 0.05
BACKOFF_FACTOR = 1.8
BACKOFF_MAX_S = 1.0
"""A device that is plugged in again is found within this time plus its greeting, s."""
WARNINGS_MAX = 8
"""Different reasons that one outage may warn of."""

_log = logging.getLogger(__name__)


class LinkState(StrEnum):
    """What a link is doing."""

    CLOSED = "closed"
    """Not opened, or closed by its owner."""
    WAITING = "waiting"
    """Lost or not yet found; the next try comes at `Link.retry_ns`."""
    GREETING = "greeting"
    """Open, and waiting for the device to say what it is."""
    UP = "up"
    """Readings can come."""


CLOSED, WAITING, GREETING, UP = LinkState
"""By name: looking a member up in its enumeration takes longer, and is done at each reading."""


class Link:
    """State and retry schedule of one link. Does no I/O; times are monotonic ns.

    A failure is a warning when its reason is new in this outage and a debug line otherwise, so that
    a night without the device does not fill the journal, and a device of the wrong version that is
    plugged in at last is heard of.
    """

    def __init__(self, name: str) -> None:
        """`name` begins every line in the log."""
        self.name = name
        self.state = LinkState.CLOSED
        self.retry_ns: int | None = None
        """When to try again, while waiting."""
        self.losses = 0
        """Times that the link was up and was lost."""
        self.reason: str | None = None
        self.cause: LinkCause | None = None
        """Why it is not up, None while it is or has not been tried."""
        self._wait_s = BACKOFF_FIRST_S
        self._warned: set[str] = set()
        self._down_since_ns = 0

    def is_due(self, now_ns: int) -> bool:
        """True if the next try is due."""
        return self.retry_ns is None or now_ns >= self.retry_ns

    def start(self, now_ns: int) -> None:
        """Begin to try; the first try is due at once."""
        self.state = LinkState.WAITING
        self.reason = self.cause = None
        self._wait_s = BACKOFF_FIRST_S
        self._warned.clear()
        self._down_since_ns = self.retry_ns = now_ns

    def greeting(self) -> None:
        """The device was opened."""
        self.state = LinkState.GREETING
        self.retry_ns = None

    def up(self, what: str, now_ns: int) -> None:
        """The device has said what it is; `what` goes into the log."""
        down_s = (now_ns - self._down_since_ns) / 1e9
        _log.info("%s: up after %.2f s: %s", self.name, down_s, what)
        self.state = LinkState.UP
        self.retry_ns = None
        self.reason = self.cause = None
        self._wait_s = BACKOFF_FIRST_S
        self._warned.clear()

    def failed(self, cause: LinkCause, why: str, now_ns: int) -> None:
        """Note a failed try or a lost link, and wait, longer after each failure."""
        if self.state is LinkState.UP:
            self.losses += 1
            self._down_since_ns = now_ns
        self.cause, self.reason = cause, why
        level = logging.DEBUG
        if why not in self._warned and len(self._warned) < WARNINGS_MAX:
            self._warned.add(why)
            level = logging.WARNING
        _log.log(level, "%s: %s; trying again", self.name, why)
        self.retry_ns = now_ns + round(self._wait_s * 1e9)
        self._wait_s = min(BACKOFF_FACTOR * self._wait_s, BACKOFF_MAX_S)
        self.state = LinkState.WAITING

    def close(self) -> None:
        """Stop trying."""
        self.state = LinkState.CLOSED
        self.retry_ns = None

    def describe(self) -> dict[str, Fact]:
        """State, and why it is not up: part of what a driver describes."""
        cause = self.cause
        if cause is None and self.state is not UP:
            cause = LinkCause.SILENT if self.state is GREETING else LinkCause.UNKNOWN
        known = {"link": Fact(str(self.state), cause)}
        if self.reason is not None:
            known["why"] = Fact(self.reason)
        return known
