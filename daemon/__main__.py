"""The process `graspd`, also as `python -m daemon`: Ctrl-C never ends in a traceback."""

from __future__ import annotations

import gc
import os
import signal
import sys
from types import FrameType

INTERRUPTED = 130
"""Exit code after SIGINT: 128 and the signal's number."""


def main() -> int:
    """Run the command line; 130 without a word if SIGINT comes where no command waits for it."""
    heeded = signal.getsignal(signal.SIGINT) is not signal.SIG_IGN
    try:
        if heeded:
            signal.signal(signal.SIGINT, _leave_at_once)
        try:
            from daemon.process.streams import guarded

            return guarded(lambda: _run(heeded))
        finally:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # what is left is leaving
    except KeyboardInterrupt:
        return INTERRUPTED


def _run(heeded: bool) -> int:
    from daemon.process.start import prepare

    prepare()
    from daemon.cli import parse

    command = parse()
    gc.freeze()
    gc.enable()
    if heeded:
        signal.signal(signal.SIGINT, _interrupt_once)
    return command()


def _leave_at_once(_number: int, _frame: FrameType | None) -> None:
    """While modules load, some of which turn the exception into another. Nothing is open yet."""
    os._exit(INTERRUPTED)


def _interrupt_once(_number: int, _frame: FrameType | None) -> None:
    """Let the command clean up. Asked again, the process goes quietly, with 130 for a shell too."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
