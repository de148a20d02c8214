"""The terminal view: tables, drawn until `q`, Ctrl-C or SIGTERM."""

from __future__ import annotations

import contextlib
import math
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Iterator, Sequence

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.live import Live
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from graspd.daemon.judge.reasons import Need
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.process.text import printable
from graspd.daemon.watch.figures import likely
from graspd.daemon.watch.snapshot import (
    FingerImage,
    FingerMotion,
    JudgedGrasp,
    Line,
    Snapshot,
    Tone,
)
from graspd.daemon.watch.view import TICK_S, HandFeed, snapshots

STYLES = {
    Tone.STABLE: "bold #ffffff on #2da44e",
    Tone.LEANS: "#7fa98a",
    Tone.LEARNING: "bold #ffffff on #2f7de0",
    Tone.SLIP: "bold #ffffff on #e5484d",
    Tone.WAITING: "bold #ffffff on #57606a",
    Tone.TROUBLE: "bold #ffffff on #d98e00",
    Tone.SILENT: "bold #ffffff on #8250df",
}
"""Style of each tone. Lightness differs too, for people who cannot tell red from green."""
OLD = "dim italic"
HAND_COLUMNS = 80
"""Least width of each hand for hands to be shown side by side, columns."""
HALF_BAR = 10
"""Width of a motion bar up to its mark, which is the limit, columns."""
NAME_MAX = 40
"""Most characters shown of a received name."""
NAMES_MAX = 1000
"""Most characters shown of several received names: a hand's 120 electrodes have 840."""
LABEL_COLUMNS = 12
"""Width of the longest label, `last message`, columns."""
SIGNALS_MAX = 64
CHARACTERS = 6
"""Index of the control characters in the result of `termios.tcgetattr`."""

Row = tuple[str, str]
"""Label and text."""


def can_draw() -> bool:
    """Return True if standard output is a terminal with a movable cursor."""
    console = Console()
    return console.is_terminal and not console.is_dumb_terminal


def show(hands: Sequence[HandFeed]) -> None:
    """Draw on the terminal until `q`, Ctrl-C or SIGTERM."""
    console = Console(highlight=False)
    with StopSignal() as stop:
        keyboard = Keyboard(stop)
        with keyboard.unbuffered(), Live(console=console, screen=True, auto_refresh=False) as live:
            for seen in snapshots(hands, keyboard.wait):
                chosen = keyboard.tabs % len(hands)
                live.update(draw(seen, console.width, chosen, keyboard.spaces), refresh=True)


class Keyboard:
    """Typed keys: `q` ends, Tab shows the next hand, space the next page of what does not fit."""

    def __init__(self, stop: StopSignal) -> None:
        """`stop`: signal that also ends the wait."""
        self.tabs = 0
        """Number of times that Tab was typed."""
        self.spaces = 0
        """Number of times that space was typed since the last Tab."""
        self._stop = stop
        self._waited = select.poll()
        """Waits for signals and, while keys are read, for the keyboard."""
        self._waited.register(stop.fileno(), select.POLLIN)

    def wait(self) -> bool:
        """Wait for a tick; return True after a signal that ends, `q`, or the end of the input."""
        ready = [descriptor for descriptor, _ in self._waited.poll(TICK_S * 1000)]
        if self._stop.fileno() in ready:
            os.read(self._stop.fileno(), SIGNALS_MAX)  # also of other signals
        if self._stop.received is not None:
            return True
        for keyboard in ready:
            if keyboard != self._stop.fileno():
                typed = os.read(keyboard, 64)
                if b"\t" in typed:
                    self.tabs, self.spaces = self.tabs + typed.count(b"\t"), 0
                self.spaces += typed.count(b" ")
                # F2 sends ESC O Q.
                return not typed or (b"q" in typed.lower() and b"\x1b" not in typed)
        return False

    @contextlib.contextmanager
    def unbuffered(self) -> Iterator[None]:
        """Read keys at once and without echo, if there is a terminal.

        Ctrl-Z has no effect: the last verdict would stay on the screen.
        """
        if sys.stdin is None or sys.stdin.closed or not sys.stdin.isatty():
            yield
            return
        keyboard = sys.stdin.fileno()
        former = termios.tcgetattr(keyboard)
        self._waited.register(keyboard, select.POLLIN)
        try:
            tty.setcbreak(keyboard)
            settings = termios.tcgetattr(keyboard)
            settings[CHARACTERS][termios.VSUSP] = b"\0"  # _POSIX_VDISABLE
            termios.tcsetattr(keyboard, termios.TCSANOW, settings)
            yield
        finally:
            self._waited.unregister(keyboard)
            termios.tcsetattr(keyboard, termios.TCSADRAIN, former)


def draw(hands: Sequence[Snapshot], width: int, chosen: int, page: int) -> RenderableType:
    """Return tables of all hands side by side. If `width` (columns) is too small for that, only
    hand number `chosen` has a table, below the verdicts of all.

    `page`: number of pages to skip of the lines that do not fit.
    """
    if len(hands) > 1 and width // len(hands) >= HAND_COLUMNS:
        beside = Table.grid(expand=True, padding=(0, 2))
        for _ in hands:
            beside.add_column(ratio=1)
        beside.add_row(*[_hand([hand], 0, page) for hand in hands])
        return beside
    return _hand(hands, chosen, page)


class Fitted:
    """A fixed head, and below it one page of the rest; the last line counts the lines cut off."""

    def __init__(
        self, head: RenderableType, wrong: RenderableType, rest: RenderableType, page: int
    ) -> None:
        """`wrong`: lines on what is wrong, above `rest`, which are counted separately when cut off.
        `page`: number of the page to show, from 0; after the last one the first follows."""
        self._parts = head, wrong, rest
        self._page = page

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        free = options.update(height=None)
        head, wrong, rest = (console.render_lines(part, free, pad=False) for part in self._parts)
        height, body = console.height, wrong + rest
        if len(head) + len(body) > height:
            room = max(height - len(head) - 1, 1)
            pages = math.ceil(len(body) / room)
            first = min(self._page % pages * room, len(body) - room)
            hidden = [*range(first), *range(first + room, len(body))]
            troubles = sum(line < len(wrong) for line in hidden)
            body = body[first : first + room]
            body += console.render_lines(_cut(len(hidden), troubles), free, pad=False)
        for line in head + body:
            yield from line
            yield Segment.line()


def _cut(lines: int, troubles: int) -> Text:
    wrong = f", {troubles} of them on what is wrong" if troubles else ""
    return Text(f"{lines} more lines{wrong}: space shows them", style="reverse", no_wrap=True)


def _hand(hands: Sequence[Snapshot], chosen: int, page: int) -> RenderableType:
    """Return the verdicts of all hands, and the details of the chosen one."""
    seen = hands[chosen]
    wrong, figures = _table(), _table()
    for label, text in [*_labelled("why", seen.why), *_health(seen)]:
        wrong.add_row(label, Text(text))
    for label, text in _verdict_rows(seen):
        figures.add_row(label, Text(text))
    for label, text in _figures(seen):
        figures.add_row(label, Text(text), style=OLD if seen.tone is Tone.SILENT else None)
    # This clock stops when nothing is drawn any more, which an operator sees.
    clock = time.strftime("%H:%M:%S", time.localtime(seen.t))
    keys = "q ends" if len(hands) == 1 else "q ends, tab: next hand"
    name = printable(seen.hand or "-", NAME_MAX)
    header = Text(f"{clock} details of {name}: {seen.state or '-'} ({keys})")
    verdicts = [_verdict(hand, wraps=len(hands) > 1) for hand in hands]
    return Fitted(Group(*verdicts, header), wrong, figures, page)


def _table() -> Table:
    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(style="dim", no_wrap=True, min_width=LABEL_COLUMNS)
    return table


def _verdict(seen: Snapshot, *, wraps: bool = False) -> Text:
    """Return a line: hand, verdict, probability, first reason, parts to act on."""
    name = printable(seen.hand or "-", NAME_MAX)
    why = seen.why[0].what if seen.why else ""
    if seen.not_well:
        why += f"; {printable(seen.not_well, 2 * NAME_MAX)}"
    word = f" {seen.headline.upper()} "
    probability = "" if seen.p_slip is None else f" slip probability {likely(seen.p_slip)},"
    return Text.assemble(
        (f"{name} ", "bold"), (word, STYLES[seen.tone]), f"{probability} {why}", no_wrap=not wraps
    )


def _verdict_rows(seen: Snapshot) -> Iterator[Row]:
    if seen.evidence:
        yield "evidence", seen.evidence
    touches = "not known" if seen.contact is None else " ".join(seen.contact) or "nothing"
    number = "-" if seen.grasp is None else seen.grasp
    yield "grasp", f"{number}, gate {seen.gate or '-'}, touches {touches}, still {seen.still}"
    for finger in seen.fingers:
        yield finger.name, _finger(finger)


def _health(seen: Snapshot) -> list[Row]:
    if not seen.health:
        return [("health", "all is well" if seen.state else "not known")]
    needs = [[line for line in seen.health if line.need is need] for need in reversed(Need)]
    return [row for lines in needs if lines for row in _labelled(lines[0].need.value, lines)]


def _labelled(label: str, lines: Sequence[Line]) -> list[Row]:
    """Return a row for each line; the first one has the label."""
    texts = [f"{printable(line.what, NAMES_MAX)}: {line.advice}" for line in lines]
    labels = [label] + [""] * len(texts)
    return list(zip(labels, texts, strict=False))


def _finger(finger: FingerImage) -> str:
    depth = f", fall {finger.deepest} counts" if finger.from_rest else ""
    state = "" if finger.state is None else f", {finger.state}"
    broken = finger.broken and f", {finger.broken}"
    return ("-" if finger.motion is None else _motion(finger.motion)) + state + depth + broken


def _motion(motion: FingerMotion) -> str:
    """Return a bar of a finger's motion, with a mark at the limit below which it is still."""
    if motion.now is None:
        return "motion not known"
    share = min(motion.now / motion.limit, 2.0)
    still = min(round(share * HALF_BAR), HALF_BAR)
    moving = math.ceil(max(share - 1.0, 0.0) * HALF_BAR)
    bar = f"{'#' * still:-<{HALF_BAR}}|{'#' * moving:-<{HALF_BAR}}"
    return f"{bar} motion {motion.now:.3g} of {motion.limit:.3g}"


def _figures(seen: Snapshot) -> Iterator[Row]:
    if seen.tone is Tone.SILENT and seen.last_t is not None:
        then = time.strftime("%H:%M:%S", time.localtime(seen.last_t))
        ago_s = seen.t - seen.last_t
        yield "last message", f"{then}, {ago_s:.0f} s ago; figures of then"
    yield "last grasps", "; ".join(map(_past, seen.grasps)) or "-"
    yield "learning", _flow(seen.learning)
    yield "timing", _flow(seen.timing)
    angles = sorted(seen.joints.items())
    joints = [f"{printable(name, 5)} {math.degrees(rad):.1f}°" for name, rad in angles]
    yield "joints", ", ".join(joints) or "no angles come"
    yield "endpoint", f"{printable(seen.endpoint, 2 * NAME_MAX)} {seen.link}"
    yield "model", printable(seen.model or "not known yet", NAME_MAX)


def _past(grasp: JudgedGrasp) -> str:
    probability = "" if grasp.p_slip is None else f" {likely(grasp.p_slip)}"
    supervised = ", supervised" if grasp.supervised else ""
    lift = "" if grasp.lift == "-" else f", {grasp.lift}"
    return f"{grasp.grasp} {grasp.verdict}{probability}{lift}{supervised}"


def _flow(lines: Sequence[Line]) -> str:
    texts = [f"{line.what} {printable(line.advice, NAMES_MAX)}" for line in lines]
    return "; ".join(texts) or "-"
