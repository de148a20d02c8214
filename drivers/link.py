"""State of a link, its retries with a capped backoff, and the clock of its sender."""

from __future__ import annotations

import logging
import select
from enum import StrEnum
from typing import Final

from graspd.drivers.base import Fact, LinkCause

BACKOFF_FIRST_S = 0.05
"""Wait after the first failure, s. A board that resets is back soon."""
BACKOFF_FACTOR = 1.8
"""Factor of the wait from one failure to the next; the seventh wait is the longest."""
BACKOFF_MAX_S = 1.0
"""Longest wait, s: a device that is plugged in again is opened within this time."""
SILENCE_PERIODS, SILENCE_MIN_NS = 10, 100_000_000
"""Missing readings after which a link is lost, and the shortest timeout for them, ns.

Adapters and busy hosts delay bytes by less.
"""
OUTAGE_NS: Final = 2_000_000_000
"""Longest outage, ns, in which missed readings are counted; a longer one counts as one reading."""
WARNINGS_MAX = 8
"""Most warnings in one outage, each for another reason; the log cannot fill up."""

CLOCK_STEP_NS: Final = 1_000_000_000
"""Apparent delay of a message, ns, from which on a fall of its sender's time is a new zero."""
LEAP: Final = 10
"""Speed of a sender's time, as a multiple of ours, above which it was set or is not in seconds."""
LEAP_NS: Final = 200_000_000
"""Rise of a sender's time that is always allowed, ns, because a delayed message followed by
losses has such a rise."""
DRIFT: Final = 1000
"""Clocks of two computers drift apart by less than one part in this; NTP slews by half that."""
READABLE: Final = 1
"""POLLIN of poll(2), which Python lacks on some systems."""
BROKEN: Final = 0
"""No event of poll(2): only an error or a hang-up makes the descriptor ready."""

_log = logging.getLogger(__name__)


class LinkState(StrEnum):
    """State of a link."""

    CLOSED = "closed"
    """Not opened, or closed by its owner."""
    WAITING = "waiting"
    """Lost or not yet found; the next try is at `Link.retry_ns`."""
    GREETING = "greeting"
    """Open; the device has not identified itself yet."""
    UP = "up"
    """The device works; readings can arrive."""


def longest_silence_ns(period_ns: int | None) -> int:
    """Return how long a link may be silent, ns; `period_ns`: between readings, None: not known."""
    return max(SILENCE_PERIODS * (period_ns or 0), SILENCE_MIN_NS)


def is_ready(descriptor: int, event: int = READABLE) -> bool:
    """Return True if the descriptor has this event of `poll` now, or is broken."""
    poll = select.poll()
    poll.register(descriptor, event)
    return bool(poll.poll(0))


class Link:
    """State and retry schedule of one link. Does no I/O; times are monotonic ns.

    A failure is logged as a warning if its reason is new in this outage, else as a debug line.
    A night without the device does not fill the journal, and each new reason is still reported.
    """

    def __init__(self, name: str) -> None:
        """`name` begins every line in the log."""
        self.name = name
        self.state = LinkState.CLOSED
        self.retry_ns: int | None = None
        """Monotonic time of the next try, ns; None unless the state is `WAITING`."""
        self.losses = 0
        """Times that the link was lost after it had been up."""
        self.reason: str | None = None
        """Why the link is down, for people; None while it is up or untried."""
        self.cause: LinkCause | None = None
        """Why the link is down, for programs; None while it is up or untried."""
        self._wait_s = BACKOFF_FIRST_S
        self._warned: set[str] = set()
        self._down_since_ns = 0

    def is_due(self, now_ns: int) -> bool:
        return self.retry_ns is None or now_ns >= self.retry_ns

    def start(self, now_ns: int) -> None:
        """Start trying; the first try is due at once."""
        self.state = LinkState.WAITING
        self.reason = self.cause = None
        self._wait_s = BACKOFF_FIRST_S
        self._warned.clear()
        self._down_since_ns = self.retry_ns = now_ns

    def greeting(self) -> None:
        """Call when the device was opened and has not answered yet."""
        self.state = LinkState.GREETING
        self.retry_ns = None

    def up(self, what: str, now_ns: int) -> None:
        """Call when the device works; `what` names it in the log."""
        down_s = (now_ns - self._down_since_ns) / 1e9
        _log.info("%s: up after %.2f s: %s", self.name, down_s, what)
        self.state = LinkState.UP
        self.retry_ns = None
        self.reason = self.cause = None
        self._wait_s = BACKOFF_FIRST_S
        self._warned.clear()

    def failed(self, cause: LinkCause, why: str, now_ns: int) -> None:
        """Call after a failed try or a loss; schedule the next try, later each time."""
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
        self.state = LinkState.CLOSED
        self.retry_ns = None

    def describe(self) -> dict[str, Fact]:
        """Return the state, and why it is not up, as facts for `Driver.describe`."""
        cause = self.cause
        if cause is None and self.state is not LinkState.UP:
            cause = LinkCause.SILENT if self.state is LinkState.GREETING else LinkCause.UNKNOWN
        facts = {"link": Fact(str(self.state), cause)}
        if self.reason is not None:
            facts["why"] = Fact(self.reason)
        return facts


class SenderClock:
    """Bounds the age of messages by their sender's time, which may have any zero.

    The quickest message so far is assumed to have no delay. A delay of all messages, or one that
    grows by less than 1 ms a second, is not noticed. Time that falls, so that the delay seems to
    be a second or more, has another zero.
    """

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        """Smallest difference of reception and sender's time, ns; it grows with the drift."""
        self._sent_ns = self._received_ns = 0

    def leaps(self, t_s: float | None, received_ns: int) -> bool:
        """Return True if the sender's time, s, leapt ahead since that of the last `made_ns`.

        A leap is over ten times the time passed here and 200 ms more: it was set or is not in
        seconds, so it shows no delay. False for None, and before the first `made_ns`.
        """
        if t_s is None or self._offset_ns is None:
            return False
        passed_ns = received_ns - self._received_ns
        return round(t_s * 1e9) - self._sent_ns > LEAP * passed_ns + LEAP_NS

    def made_ns(self, t_s: float | None, received_ns: int) -> int:
        """Return the latest time at which a message can have been made, monotonic ns.

        `t_s`: the sender's time, s; None: not known, which gives `received_ns`.
        """
        if t_s is None:
            return received_ns
        sent_ns = round(t_s * 1e9)
        offset_ns = received_ns - sent_ns
        if self._offset_ns is not None:
            drift_ns = (received_ns - self._received_ns) // DRIFT
            known_ns = self._offset_ns + drift_ns
            if sent_ns > self._sent_ns or offset_ns - known_ns < CLOCK_STEP_NS:
                offset_ns = min(offset_ns, known_ns)
        self._offset_ns, self._sent_ns, self._received_ns = offset_ns, sent_ns, received_ns
        return sent_ns + offset_ns
