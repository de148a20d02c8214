"""The process `graspd`, also `python -m graspd`. Ctrl-C never ends in a traceback."""

from __future__ import annotations

import gc
import os
import signal
import sys
from types import FrameType

INTERRUPTED = 130
"""Exit code after SIGINT: 128 plus the number of the signal."""


def main() -> int:
    """Run the command line; return its exit code, 130 after a SIGINT that no command handles."""
    heeded = signal.getsignal(signal.SIGINT) is not signal.SIG_IGN
    try:
        if heeded:
            signal.signal(signal.SIGINT, _leave_at_once)
        try:
            from graspd.daemon.process.streams import guarded

            return guarded(lambda: _run(heeded))
        finally:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # from here the process only leaves
    except KeyboardInterrupt:
        return INTERRUPTED


def _run(heeded: bool) -> int:
    from graspd.daemon.process import set_up_libraries

    set_up_libraries()
    from graspd.daemon.cli import parse

    command = parse()
    gc.freeze()  # a search of all modules would stop the loop for 30 ms
    if heeded:
        signal.signal(signal.SIGINT, _interrupt_once)
    return command()


def _leave_at_once(_number: int, _frame: FrameType | None) -> None:
    """End the process at once: an exception could be lost in a module that is loading."""
    os._exit(INTERRUPTED)


def _interrupt_once(_number: int, _frame: FrameType | None) -> None:
    """Let the command clean up; the next SIGINT ends the process at once."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
