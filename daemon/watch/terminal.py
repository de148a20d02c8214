"""One snapshot as text for a terminal, from 80 x 24 characters on."""

from __future__ import annotations

import math
import time

from rich.console import Group, RenderableType
from rich.style import Style
from rich.table import Table
from rich.text import Text

from daemon.process.text import printable
from daemon.watch.pixels import Canvas
from daemon.watch.snapshot import Snapshot, Tone
from daemon.watch.view import HISTORY

LARGE = (100, 34)
"""Columns and lines from which on the images are large."""
LINES, LINES_LARGE = 23, 29
"""Lines of all but what is not well, with small and with large images."""
WHY_MAX = 3
"""Reasons that are shown; a reading seldom has more."""
BANNER_LINES, BANNER = 5, 24
"""Lines and columns of the coloured field that has the verdict in its middle."""
NAME_MAX = 40
"""Characters of a name that came in a message."""
GAP = 2
"""Columns between fingers."""
JOINT = 15
"""Columns of a joint."""
DIM = Style(dim=True)
BOLD = Style(bold=True)


def draw(seen: Snapshot, width: int, height: int, canvas: Canvas) -> RenderableType:
    """The snapshot for a terminal of `width` x `height` characters, cut to what fits."""
    large = width >= LARGE[0] and height >= LARGE[1]
    rows: list[RenderableType] = [
        _header(seen),
        _verdict(seen, canvas, width),
        Text(),
        _why(seen, canvas),
        _hand(seen, canvas, large=large, width=width),
        _strip(seen, canvas, width),
        *_numbers(seen),
        _session(seen),
    ]
    left = height - (LINES_LARGE if large else LINES)
    return Group(*rows, *_health(seen, canvas, max(left, 1)), _footer(seen))


def _line(*parts: tuple[str, str | Style]) -> Text:
    text = Text.assemble(*parts)
    text.no_wrap, text.overflow = True, "ellipsis"
    return text


def _header(seen: Snapshot) -> Text:
    return _line(
        ("graspd ", BOLD),
        (_name(seen.hand or "-"), BOLD),
        # Of the picture: an operator sees it stand still where nothing is drawn any more.
        (time.strftime("  %H:%M:%S", time.localtime(seen.t)), BOLD),
        (f"  {_name(seen.model or 'no model yet')}", DIM),
        (f"  {seen.state or '-'}", BOLD),
    )


def _footer(seen: Snapshot) -> Text:
    return _line(("q", BOLD), (f" ends   {_name(seen.endpoint, 2 * NAME_MAX)} {seen.link}", DIM))


def _verdict(seen: Snapshot, canvas: Canvas, width: int) -> Table:
    lines = [" " * BANNER] * BANNER_LINES
    lines[BANNER_LINES // 2] = seen.verdict.upper().center(BANNER)
    banner = Text("\n".join(lines), canvas.banner(seen.tone))
    grid = Table.grid(padding=(0, 2))
    grid.add_column(width=BANNER, no_wrap=True)
    grid.add_column(no_wrap=True, overflow="ellipsis")
    grid.add_row(banner, _facts(seen, canvas, max(width - BANNER - 2, 10)))
    return grid


def _facts(seen: Snapshot, canvas: Canvas, width: int) -> Text:
    p_slip = "-" if seen.p_slip is None else f"{100 * seen.p_slip:.0f} %"
    text = Text.assemble(
        ("grasp ", DIM),
        ("-" if seen.grasp is None else str(seen.grasp), BOLD),
        ("   gate ", DIM),
        (seen.gate or "-", BOLD),
        ("\ntouches ", DIM),
        ("not known" if seen.contact is None else " ".join(seen.contact) or "nothing", BOLD),
        ("\nslip probability ", DIM),
        (f"{p_slip:6}", BOLD),
    )
    text.append_text(canvas.bar(seen.p_slip, max(min(width - 24, 30), 5), seen.tone))
    text.append("\nlast judged ", DIM)
    last = seen.judged
    if last is None:
        return text.append("-")
    share = "" if last.p_slip is None else f" {100 * last.p_slip:.0f} %"
    text.append(f"{last.verdict}{share}", BOLD)
    text.append(f", {last.ago_s:.0f} s ago", DIM)
    if last.ended is not None:
        text.append(f"\nlift ended: {last.ended}", BOLD)
    return text


def _why(seen: Snapshot, canvas: Canvas) -> Group:
    """Always as many lines, so that what is below does not jump."""
    shown = [
        _line((line.what, canvas.style(seen.tone)), (f": {line.advice}", ""))
        for line in seen.why[:WHY_MAX]
    ]
    return Group(*shown, *[Text() for _ in range(WHY_MAX - len(shown))])


def _hand(seen: Snapshot, canvas: Canvas, *, large: bool, width: int) -> RenderableType:
    lines, columns = (12, 22) if large else (6, 11)
    if not seen.fingers:
        return Text("no readings to see" + "\n" * (lines + 1), DIM)
    grid = Table.grid(padding=(0, GAP, 0, 0))
    cells: list[RenderableType] = []
    for finger in seen.fingers:
        known = {True: "touches", False: "free", None: ""}[finger.touches]
        title = Text.assemble((f"{finger.name} ", BOLD), (known, canvas.style(seen.tone)))
        depth = Text(f"{'fall' if finger.from_rest else 'span'} {finger.deepest}", DIM)
        cells.append(Group(title, canvas.picture(finger, large=large), depth))
        grid.add_column(width=columns, no_wrap=True)
    left = max(width - len(cells) * (columns + GAP), 1)
    grid.add_column(width=left, no_wrap=True)
    grid.add_row(*cells, Group(*_joints(seen, left, lines), _legend(seen, canvas)))
    return grid


def _joints(seen: Snapshot, width: int, lines: int) -> list[Text]:
    """A title and so many lines."""
    named = sorted(seen.joints.items())
    columns = max(1, min(width // JOINT, math.ceil(len(named) / lines)))
    cells = [f"{_name(name, 5):5}{math.degrees(angle):6.1f}°".ljust(JOINT) for name, angle in named]
    rows = ["".join(cells[row : lines * columns : lines]) for row in range(lines)]
    return [Text("joints" if named else "no joints", DIM), *[_line((row, "")) for row in rows]]


def _legend(seen: Snapshot, canvas: Canvas) -> Text:
    what = "below rest" if seen.fingers[0].from_rest else "below the median"
    text = Text.assemble(("risen ", DIM), canvas.scale(12), (f" pressed, {what}", DIM))
    text.no_wrap, text.overflow = True, "ellipsis"
    return text


def _strip(seen: Snapshot, canvas: Canvas, width: int) -> Text:
    text = Text.assemble(("30 s ", DIM), canvas.strip(seen.history, HISTORY, max(width - 9, 10)))
    return text.append(" now", DIM)


def _numbers(seen: Snapshot) -> list[Text]:
    timing = seen.timing
    first = _line(
        ("readings ", DIM),
        (f"{_number(timing.readings_hz)}/s", ""),
        ("  verdicts ", DIM),
        (f"{timing.verdicts_hz:.0f}/s", ""),
        ("  age ", DIM),
        (f"{_number(timing.age_ms, 1)} ms", ""),
        ("  latency p50 p99 ", DIM),
        (f"{_number(timing.p50_us)} {_number(timing.p99_us)} us", ""),
    )
    lost = Style(bold=True) if timing.lost or timing.not_understood else Style()
    second = _line(
        ("late ", DIM),
        (f"{_number(timing.late)}", ""),
        ("  worst age ", DIM),
        (f"{_number(timing.worst_age_ms)} ms", ""),
        ("  lost here ", DIM),
        (f"{timing.lost}", lost),
        ("  not understood ", DIM),
        (f"{timing.not_understood}", lost),
    )
    return [first, second]


def _session(seen: Snapshot) -> Text:
    session = seen.session
    if session is None:
        known = "this model needs none"
    else:
        known = f"{session.grasps} grasps, {'' if session.calibrated else 'not '}calibrated"
    repaired = _name(", ".join(seen.repaired) or "nothing", 2 * NAME_MAX)
    return _line(("session ", DIM), (known, ""), ("  repaired ", DIM), (repaired, ""))


def _health(seen: Snapshot, canvas: Canvas, lines: int) -> list[Text]:
    if not seen.health:
        return [_line(("health ", DIM), ("all is well" if seen.state else "not known", ""))]
    shown = seen.health[: lines if len(seen.health) <= lines else lines - 1]
    found = [
        _line((_name(line.what), canvas.style(Tone.TROUBLE)), (f": {line.advice}", ""))
        for line in shown
    ]
    more = len(seen.health) - len(shown)
    return [*found, _line((f"and {more} more that is not well", BOLD))] if more else found


def _number(value: float | None, digits: int = 0) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _name(text: str, length: int = NAME_MAX) -> str:
    return printable(text, length)
