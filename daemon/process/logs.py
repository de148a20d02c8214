"""The log on stderr: plain for a terminal, with priorities for the journal."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping

LOGGER = "graspd"
"""Parent of all loggers of graspd."""
SYSLOG_LEVELS = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
"""Numbers of levels in a journal prefix (sd-daemon(3)); 7 below."""
JOURNAL_ERROR = "<3>"
"""Prefix of an error in the journal."""
BURST = 10
"""Messages of one kind in a window: a fault must not fill a robot's journal."""
WINDOW_S = 60.0
KINDS_MAX = 200
"""Most kinds that are told apart; the code has fewer."""


def set_up(environment: Mapping[str, str]) -> None:
    """Log to stderr, with priorities if `environment` says that it is the journal."""
    handler = logging.StreamHandler()
    plain = logging.Formatter("graspd: %(levelname)s: %(message)s")
    handler.setFormatter(JournalFormatter() if is_journal(environment) else plain)
    handler.addFilter(RateLimit())
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    logging.getLogger(LOGGER).setLevel(logging.INFO)


def is_journal(environment: Mapping[str, str]) -> bool:
    """Return True if stderr is systemd's stream to the journal (systemd.exec(5))."""
    try:
        there = os.fstat(2)
    except OSError:
        return False
    return environment.get("JOURNAL_STREAM") == f"{there.st_dev}:{there.st_ino}"


class JournalFormatter(logging.Formatter):
    """Gives each line its priority, for `journalctl -p warning`."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the message, each line with a prefix such as `<4>`."""
        number = next((n for level, n in SYSLOG_LEVELS if record.levelno >= level), 7)
        return "\n".join(f"<{number}>{line}" for line in super().format(record).splitlines())


class RateLimit(logging.Filter):
    """Lets a burst of each kind of message pass, then one a window."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._kinds: dict[str, tuple[float, int]] = {}
        """Start of the window, s, and how many came in it."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True if the message passes; the first of a window counts those that did not."""
        now_s, kind = self._clock(), f"{record.name} {record.msg}"
        if kind not in self._kinds and len(self._kinds) >= KINDS_MAX:
            return True
        start_s, seen = self._kinds.get(kind, (now_s, 0))
        if now_s - start_s >= WINDOW_S:
            held_back, start_s, seen = max(seen - BURST, 0), now_s, 0
            if held_back:
                record.msg = f"{record.getMessage()} (and {held_back} more like it before)"
                record.args = None
        self._kinds[kind] = (start_s, seen + 1)
        return seen < BURST
