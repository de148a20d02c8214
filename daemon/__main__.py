"""The process `graspd`, also as `python -m daemon`: Ctrl-C never ends in a traceback."""

from __future__ import annotations

import gc
import os
import signal
import sys
from types import FrameType, ModuleType

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


def prepare() -> None:
    """Let libraries take no more than a daemon needs; before the first of them is imported.

    Whoever calls it turns the garbage collector on again.
    """
    # Modules leave next to no garbage: to look for it takes a tenth of a start, and to look through
    # what is loaded, ever again, 30 ms in which no reading is judged.
    gc.disable()
    # Matrices are small here. numpy's threads for large ones, one for each further processor, would
    # spin through the start; and with memory locked each of them takes its whole stack.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # pydantic looks through all that is installed for plugins, which takes a tenth of a start and
    # 3 MiB; and what others have installed has no business in a daemon.
    plugins = ModuleType("pydantic.plugin._loader")
    vars(plugins)["get_plugins"] = tuple
    sys.modules.setdefault(plugins.__name__, plugins)


def _run(heeded: bool) -> int:
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
