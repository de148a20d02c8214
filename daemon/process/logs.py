"""The log on stderr: plain on a terminal, with priorities in the journal."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping

LOGGER = "graspd"
"""Parent of all loggers of graspd."""
SYSLOG_LEVELS = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
"""Journal priority of each level (sd-daemon(3)); lower levels have 7."""
JOURNAL_ERROR = "<3>"
"""Journal prefix of an error."""
BURST = 10
"""Most messages of one kind in a window; a fault must not fill the journal."""
WINDOW_S = 60.0
KINDS_MAX = 200
"""Most kinds of messages that are counted; the code has fewer. Further kinds are not limited."""


def set_up(environment: Mapping[str, str]) -> None:
    """Log to stderr, with priorities if it is the journal's stream that `environment` names."""
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
    """Formatter that gives each line its priority, for `journalctl -p warning`."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the message; each line has a prefix such as `<4>`."""
        priority = next((n for level, n in SYSLOG_LEVELS if record.levelno >= level), 7)
        return "\n".join(f"<{priority}>{line}" for line in super().format(record).splitlines())


class RateLimit(logging.Filter):
    """Filter that passes a burst of each kind of message (logger and format), then one per window.

    After a window in which nothing was held back, a burst passes again.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._kinds: dict[str, tuple[float, int, int]] = {}
        """Start of the window, s, number of messages in it, and limit, by kind."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True to pass a message. To the first of its kind in a window, add the number held
        back in the window before."""
        now_s, kind = self._clock(), f"{record.name} {record.msg}"
        if kind not in self._kinds and len(self._kinds) >= KINDS_MAX:
            return True
        start_s, count, limit = self._kinds.get(kind, (now_s, 0, BURST))
        if now_s - start_s >= WINDOW_S:
            held_back = max(count - limit, 0)
            limit = 1 if held_back and now_s - start_s < 2 * WINDOW_S else BURST
            start_s, count = now_s, 0
            if held_back:
                record.msg = f"{record.getMessage()} (and {held_back} more like it before)"
                record.args = None
        self._kinds[kind] = (start_s, count + 1, limit)
        return count < limit
