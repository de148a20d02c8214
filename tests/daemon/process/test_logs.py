"""The log: priorities for the journal, and no flood."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path

from graspd.daemon.process.logs import (
    BURST,
    KINDS_MAX,
    WINDOW_S,
    JournalFormatter,
    RateLimit,
    is_journal,
)


def record(level: int, text: str, *values: object) -> logging.LogRecord:
    return logging.LogRecord("graspd", level, __file__, 1, text, values, None)


def test_each_line_in_the_journal_has_a_syslog_priority() -> None:
    """Priorities are those of syslog(3): LOG_ERR 3, LOG_WARNING 4, LOG_INFO 6, LOG_DEBUG 7."""
    levels = {"CRITICAL": 3, "ERROR": 3, "WARNING": 4, "INFO": 6, "DEBUG": 7}
    for name, number in levels.items():
        line = JournalFormatter().format(record(logging.getLevelNamesMapping()[name], "a\nb"))
        assert line == f"<{number}>a\n<{number}>b"


def test_stderr_is_the_journal_only_if_the_environment_names_it() -> None:
    there = os.fstat(2)
    assert is_journal({"JOURNAL_STREAM": f"{there.st_dev}:{there.st_ino}"})
    assert not is_journal({"JOURNAL_STREAM": f"{there.st_dev}:{there.st_ino + 1}"})
    assert not is_journal({})


def test_an_error_message_in_the_journal_has_error_priority(tmp_path: Path) -> None:
    """Standard error is a file that is named as the journal's stream."""
    log = tmp_path / "journal"
    with log.open("wb") as stream:
        there = os.fstat(stream.fileno())
        code = subprocess.run(
            [sys.executable, "-m", "graspd", "run", str(tmp_path / "missing.toml")],
            stderr=stream,
            env={**os.environ, "JOURNAL_STREAM": f"{there.st_dev}:{there.st_ino}"},
            check=False,
            timeout=200,
        ).returncode
    assert code == 2
    assert log.read_text().startswith("<3>")
    assert "missing.toml" in log.read_text()


def test_a_burst_of_messages_passes_and_the_rest_is_counted() -> None:
    now_s = 100.0
    limit = RateLimit(lambda: now_s)
    passed = [limit.filter(record(logging.WARNING, "lost %d %%", n)) for n in range(BURST + 7)]
    assert passed == [True] * BURST + [False] * 7
    now_s += WINDOW_S
    late = record(logging.WARNING, "lost %d %%", 99)
    assert limit.filter(late)
    assert late.getMessage() == "lost 99 % (and 7 more like it before)"
    assert not limit.filter(record(logging.WARNING, "lost %d %%", 100))


def test_a_lasting_fault_logs_once_a_window() -> None:
    now_s = 0.0
    limit = RateLimit(lambda: now_s)

    def passed(number: int) -> int:
        return sum(limit.filter(record(logging.WARNING, "lost")) for _ in range(number))

    windows = []
    for number in (100, 100, 100, 1, BURST, 100):
        windows.append(passed(number))
        now_s += WINDOW_S
    assert windows == [BURST, 1, 1, 1, BURST, BURST]
    now_s += WINDOW_S
    assert passed(100) == BURST  # after a silence it is another fault


def test_only_200_kinds_of_messages_are_remembered_all_others_pass() -> None:
    limit = RateLimit(lambda: 0.0)
    for _ in range(BURST):
        for number in range(3 * KINDS_MAX):
            assert limit.filter(record(logging.WARNING, f"kind {number}"))
    passed = [
        limit.filter(record(logging.WARNING, f"kind {number}")) for number in range(3 * KINDS_MAX)
    ]
    assert passed == [False] * KINDS_MAX + [True] * 2 * KINDS_MAX, "only those are remembered"
