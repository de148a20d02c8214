"""The terminal: draws ten times a second until `q`, Ctrl-C or SIGTERM; Ctrl-Z stops it."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import termios
import time
import tty
from collections.abc import Iterator
from types import FrameType
from typing import Self

from rich.console import Console
from rich.live import Live

from daemon.process.signals import StopSignal
from daemon.watch.feed import Feed
from daemon.watch.pixels import Canvas
from daemon.watch.terminal import draw
from daemon.watch.view import View
from daemon.watch.watching import TICK_S, snapshots

SIGNALS_MAX = 64
"""Bytes that a look takes out of the pipe of signals."""


def can_draw() -> bool:
    """Whether standard output is a terminal with a cursor that can be moved."""
    console = Console()
    return console.is_terminal and not console.is_dumb_terminal


def show(feed: Feed, view: View) -> None:
    """Draw on standard output until told to stop; needs a terminal there."""
    console = Console()
    canvas = Canvas(
        colour=console.color_system is not None and not console.no_color,
        ascii_only=console.options.ascii_only,
    )
    with StopSignal() as stop, Pause() as pause:
        while True:
            with (
                _keyboard() as keyboard,
                Live(console=console, screen=True, auto_refresh=False) as live,
            ):
                for seen in snapshots(
                    feed, view, lambda: _asked_to_stop(stop, keyboard) or pause.asked
                ):
                    live.update(draw(seen, console.width, console.height, canvas), refresh=True)
            if stop.received is not None or not pause.asked:
                return
            now = time.strftime("%H:%M:%S")
            console.out(
                f"graspd watch stopped at {now}: unknown until it goes on (fg)", highlight=False
            )
            pause.stop()


class Pause:
    """Ctrl-Z: the picture must not stay where nobody draws it any more."""

    def __init__(self) -> None:
        """Not asked yet."""
        self.asked = False

    def __enter__(self) -> Self:
        """Take over SIGTSTP, unless it is ignored; only the main thread can."""
        self._former = signal.getsignal(signal.SIGTSTP)
        self._take_over()
        return self

    def __exit__(self, *_details: object) -> None:
        signal.signal(signal.SIGTSTP, self._former)

    def stop(self) -> None:
        """Stop as asked; comes back when the process is continued."""
        self.asked = False
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTSTP)
        self._take_over()

    def _take_over(self) -> None:
        if self._former is not signal.SIG_IGN:
            signal.signal(signal.SIGTSTP, self._handle)

    def _handle(self, _number: int, _frame: FrameType | None) -> None:
        self.asked = True


def _asked_to_stop(stop: StopSignal, keyboard: int | None) -> bool:
    """Wait for a tick; true for a signal and for `q`."""
    waited = [stop.fileno()] if keyboard is None else [stop.fileno(), keyboard]
    ready, _, _ = select.select(waited, [], [], TICK_S)
    if stop.fileno() in ready:
        os.read(stop.fileno(), SIGNALS_MAX)  # also of signals that do not end it
    if stop.received is not None:
        return True
    if keyboard is None or keyboard not in ready:
        return False
    return os.read(keyboard, 64)[:1] in {b"q", b"Q", b""}


@contextlib.contextmanager
def _keyboard() -> Iterator[int | None]:
    """Descriptor whose keys come at once and unseen; None where standard input is no terminal."""
    if sys.stdin is None or sys.stdin.closed or not sys.stdin.isatty():
        yield None
        return
    descriptor = sys.stdin.fileno()
    former = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        yield descriptor
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, former)
