"""The terminal: draws ten times a second until `q`, Ctrl-C or SIGTERM."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import termios
import tty
from collections.abc import Iterator

from rich.console import Console
from rich.live import Live

from daemon.stop import StopSignal
from daemon.watch.feed import Feed
from daemon.watch.pixels import Canvas
from daemon.watch.terminal import draw
from daemon.watch.view import View
from daemon.watch.watching import TICK_S, snapshots


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
    with (
        StopSignal() as stop,
        _keyboard() as keyboard,
        Live(console=console, screen=True, auto_refresh=False) as live,
    ):
        for seen in snapshots(feed, view, lambda: _asked_to_stop(stop, keyboard)):
            live.update(draw(seen, console.width, console.height, canvas), refresh=True)


def _asked_to_stop(stop: StopSignal, keyboard: int | None) -> bool:
    """Wait for a tick; true for a signal and for `q`."""
    waited = [stop.fileno()] if keyboard is None else [stop.fileno(), keyboard]
    ready, _, _ = select.select(waited, [], [], TICK_S)
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
