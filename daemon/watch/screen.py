"""The terminal view: draws until `q`, Ctrl-C or SIGTERM; Ctrl-Z stops it."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import termios
import time
import tty
from collections.abc import Iterator, Sequence
from types import FrameType
from typing import Self

from rich.console import Console
from rich.live import Live

from graspd.daemon.process.signals import StopSignal
from graspd.daemon.watch.terminal import Screen, draw
from graspd.daemon.watch.view import TICK_S, HandFeed, snapshots

SIGNALS_MAX = 64


def can_draw() -> bool:
    """Return True if standard output is a terminal with a movable cursor."""
    console = Console()
    return console.is_terminal and not console.is_dumb_terminal


def show(hands: Sequence[HandFeed]) -> None:
    """Draw on the terminal until told to stop."""
    console = Console(highlight=False)
    with StopSignal() as stop, Suspension() as suspension:
        keyboard = Keyboard(stop)
        while True:
            with (
                keyboard.unbuffered(),
                Live(console=console, screen=True, auto_refresh=False) as live,
            ):
                for seen in snapshots(hands, lambda: keyboard.wait() or suspension.asked):
                    screen = Screen(
                        console.width,
                        console.height,
                        chosen=keyboard.tabs % len(hands),
                        page=keyboard.spaces,
                    )
                    live.update(draw(seen, screen), refresh=True)
            if stop.received is not None or not suspension.asked:
                return
            now = time.strftime("%H:%M:%S")
            console.print(f"graspd watch stopped at {now}: unknown until it goes on (fg)")
            suspension.stop()


class Suspension:
    """Ctrl-Z: the last verdict must not stay on the screen while nothing is drawn."""

    def __init__(self) -> None:
        self.asked = False

    def __enter__(self) -> Self:
        """Take over SIGTSTP, unless it is ignored."""
        self._former = signal.getsignal(signal.SIGTSTP)
        if self._former is not signal.SIG_IGN:
            signal.signal(signal.SIGTSTP, self._ask)
        return self

    def __exit__(self, *_details: object) -> None:
        signal.signal(signal.SIGTSTP, self._former)

    def stop(self) -> None:
        """Stop the process; return when it is continued."""
        self.asked = False
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTSTP)
        signal.signal(signal.SIGTSTP, self._ask)

    def _ask(self, _number: int, _frame: FrameType | None) -> None:
        self.asked = True


class Keyboard:
    """Typed keys: `q` ends, Tab shows the next hand, space what does not fit."""

    def __init__(self, stop: StopSignal) -> None:
        """Wait for `stop` too."""
        self.tabs = 0
        """How often Tab was typed."""
        self.spaces = 0
        """How often space was typed since then."""
        self._stop = stop
        self._waited = [stop.fileno()]
        """Descriptors of signals and, while keys are read, of the keyboard."""

    def wait(self) -> bool:
        """Wait for a tick; return True after a signal that ends, or `q`."""
        ready, _, _ = select.select(self._waited, [], [], TICK_S)
        if self._stop.fileno() in ready:
            os.read(self._stop.fileno(), SIGNALS_MAX)  # also of signals that do not end it
        if self._stop.received is not None:
            return True
        for keyboard in ready:
            if keyboard != self._stop.fileno():
                typed = os.read(keyboard, 64)
                if b"\t" in typed:
                    self.tabs, self.spaces = self.tabs + typed.count(b"\t"), 0
                self.spaces += typed.count(b" ")
                return typed[:1] in {b"q", b"Q", b""}
        return False

    @contextlib.contextmanager
    def unbuffered(self) -> Iterator[None]:
        """Read keys at once and without echo, if there is a terminal."""
        if sys.stdin is None or sys.stdin.closed or not sys.stdin.isatty():
            yield
            return
        keyboard = sys.stdin.fileno()
        former = termios.tcgetattr(keyboard)
        self._waited.append(keyboard)
        try:
            tty.setcbreak(keyboard)
            yield
        finally:
            self._waited.remove(keyboard)
            termios.tcsetattr(keyboard, termios.TCSADRAIN, former)
