"""The log on stderr: plain for a terminal, with priorities for the journal, limited in rate."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping

LOGGERS = ("graspd", "daemon", "drivers", "models")
"""Ours; libraries speak up only when something is wrong."""
SYSLOG_LEVELS = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
"""Level, and its number in a journal prefix (sd-daemon(3)); what is below is 7."""
JOURNAL_ERROR = "<3>"
"""What a line of an error begins with in the journal."""
BURST = 10
"""Messages of one kind in a window. A fault that repeats must not fill the journal of a robot."""
WINDOW_S = 60.0
"""Length of a window, s."""
KINDS_MAX = 200
"""Kinds of messages that are told apart; the code has fewer."""


def set_up(environment: Mapping[str, str]) -> None:
    """Log to stderr: with priorities if that is the journal, as `environment` says it is."""
    handler = logging.StreamHandler()
    handler.setFormatter(JournalFormatter() if is_journal(environment) else _PLAIN)
    handler.addFilter(RateLimit())
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    for ours in LOGGERS:
        logging.getLogger(ours).setLevel(logging.INFO)


def is_journal(environment: Mapping[str, str]) -> bool:
    """Return True if stderr is systemd's stream to the journal (systemd.exec(5))."""
    try:
        there = os.fstat(2)
    except OSError:
        return False
    return environment.get("JOURNAL_STREAM") == f"{there.st_dev}:{there.st_ino}"


class JournalFormatter(logging.Formatter):
    """Every line with its priority: `journalctl -p warning` then shows warnings."""

    def format(self, record: logging.LogRecord) -> str:
        """The message, each line with a prefix such as `<4>`."""
        number = next((n for level, n in SYSLOG_LEVELS if record.levelno >= level), 7)
        return "\n".join(f"<{number}>{line}" for line in super().format(record).splitlines())


class RateLimit(logging.Filter):
    """Lets a burst of each kind of message pass, then one a window with what was held back.

    A kind is a message before its arguments are filled in.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock` gives monotonic s."""
        super().__init__()
        self._clock = clock
        self._kinds: dict[str, tuple[float, int]] = {}
        """Start of the window, s, and how many came in it."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the message passes; the first of a window says how many did not."""
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


_PLAIN = logging.Formatter("graspd: %(levelname)s: %(message)s")
