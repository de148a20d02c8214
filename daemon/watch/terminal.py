"""One snapshot as text for a terminal, from 80 x 24 characters on."""

from __future__ import annotations

import math
import time

from rich.console import Group, RenderableType
from rich.style import Style
from rich.table import Table
from rich.text import Text

from daemon.process.text import printable
from daemon.watch.fingers import FingerImage
from daemon.watch.pixels import Canvas
from daemon.watch.snapshot import Snapshot, Tone
from daemon.watch.view import HISTORY

LARGE = (100, 34)
"""Columns and lines from which on the images are large."""
LINES, LINES_LARGE = 23, 30
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
GRASPS = 26
"""Columns of the list of the last grasps."""
DIM = Style(dim=True)
BOLD = Style(bold=True)


def draw(seen: Snapshot, width: int, height: int, canvas: Canvas) -> RenderableType:
    """The snapshot for a terminal of `width` x `height` characters, cut to what fits."""
    large = width >= LARGE[0] and height >= LARGE[1]
    rows: list[RenderableType] = [
        _header(seen),
        _verdict(seen, canvas, width),
        _line((seen.evidence, BOLD)),
        _why(seen, canvas),
        _hand(seen, canvas, large=large, width=width),
        _strip(seen, canvas, width),
        *_numbers(seen),
        _session(seen, width),
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
    lines[BANNER_LINES // 2] = seen.headline.upper().center(BANNER)
    last = seen.judged
    same = last is not None and last.verdict != "unknown" and last.grasp == seen.grasp
    if last is not None and same and seen.verdict == "unknown" and seen.tone is not Tone.SILENT:
        was = f"({'judged' if last.held else 'past:'} {last.verdict}{_share(last.p_slip)})"
        lines[BANNER_LINES // 2 + 1] = was.center(BANNER)
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
        ("   still ", DIM),
        (seen.still, BOLD),
        ("\nslip probability ", DIM),
        (f"{p_slip:6}", BOLD),
    )
    text.append_text(canvas.bar(seen.p_slip, max(min(width - 24, 30), 5), seen.tone))
    text.append("\nlast judged ", DIM)
    last = seen.judged
    if last is None:
        return text.append("-")
    text.append(f"{last.verdict}{_share(last.p_slip)}", BOLD)
    text.append(f", {last.ago_s:.0f} s ago{'' if last.held else ', past'}", DIM)
    text.append("\nits lift ", DIM).append(last.lift, BOLD)
    return text.append(", supervised" if last.supervised else "", DIM)


def _share(p_slip: float | None) -> str:
    return "" if p_slip is None else f" {100 * p_slip:.0f} %"


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
        return Text("no readings to see" + "\n" * (lines + (2 if large else 1)), DIM)
    grid = Table.grid(padding=(0, GAP, 0, 0))
    cells: list[RenderableType] = []
    for finger in seen.fingers:
        known = {True: "touches", False: "free", None: ""}[finger.touches]
        title = Text.assemble((f"{finger.name} ", BOLD), (known, canvas.style(seen.tone)))
        below = _depth_and_motion(finger, canvas, large=large)
        cells.append(Group(title, canvas.picture(finger, large=large), *below))
        grid.add_column(width=columns, no_wrap=True)
    left = max(width - len(cells) * (columns + GAP), 1)
    grid.add_column(width=left, no_wrap=True)
    grid.add_row(*cells, Group(_beside(seen, left, lines), _legend(seen, canvas, large)))
    return grid


def _depth(finger: FingerImage) -> str:
    return "fall" if finger.from_rest else "span"


def _depth_and_motion(finger: FingerImage, canvas: Canvas, *, large: bool) -> list[Text]:
    """Two lines where there is room for them, one where not."""
    motion = finger.motion
    depth = Text(f"{_depth(finger)} {finger.deepest}", DIM)
    if motion is None:
        return [depth, Text()] if large else [depth]
    if not large:
        return [Text(f"{finger.deepest:4} ", DIM).append_text(canvas.motion(motion, 6))]
    moves = _line(("moves ", DIM), (f"{'' if motion.now is None else f'{motion.now:.1f}':5}", ""))
    return [depth, moves.append_text(canvas.motion(motion, 11))]


def _beside(seen: Snapshot, width: int, lines: int) -> RenderableType:
    """A title and so many lines: joints, and the last grasps where there is room."""
    if not seen.grasps or width < GRASPS:
        return Group(*_joints(seen, width, lines))
    if width < GRASPS + JOINT - 1:
        half = lines // 2
        rows = (lines - half - 1, half) if seen.joints else (0, lines)
        joints = _joints(seen, width, rows[0]) if seen.joints else []
        return Group(*_grasps(seen, rows[1]), *joints)
    grid = Table.grid()
    grid.add_column(width=GRASPS + 1, no_wrap=True)
    grid.add_column(width=width - GRASPS - 1, no_wrap=True)
    joints = _joints(seen, width - GRASPS - 1, lines)
    grid.add_row(Group(*_grasps(seen, lines)), Group(*joints))
    return grid


def _grasps(seen: Snapshot, lines: int) -> list[Text]:
    """A title and so many lines, the newest grasp first."""
    rows = [
        f"{last.grasp:4} {last.verdict:7}{_share(last.p_slip):>5} {last.lift}"
        f"{'*' if last.supervised else ''}"
        for last in seen.grasps[:lines]
    ]
    rows += [""] * (lines - len(rows))
    return [Text("last grasps (* watched)", DIM), *[_line((row, "")) for row in rows]]


def _joints(seen: Snapshot, width: int, lines: int) -> list[Text]:
    """A title and so many lines."""
    named = sorted(seen.joints.items())
    columns = max(1, min(width // JOINT, math.ceil(len(named) / lines)))
    cells = [f"{_name(name, 5):5}{math.degrees(angle):6.1f}°".ljust(JOINT) for name, angle in named]
    rows = ["".join(cells[row : lines * columns : lines]).rstrip() for row in range(lines)]
    return [Text("joints" if named else "no joints", DIM), *[_line((row, "")) for row in rows]]


def _legend(seen: Snapshot, canvas: Canvas, large: bool) -> Text:
    first = seen.fingers[0]
    what, width = ", below rest" if first.from_rest else ", below the median", 12
    if first.motion is not None and not large:
        what, width = f"; {_depth(first)}, motion to {canvas.limit}", 8
    text = Text.assemble(("risen ", DIM), canvas.scale(width), (f" pressed{what}", DIM))
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
        ("  repaired ", DIM),
        (_name(", ".join(seen.repaired) or "nothing"), ""),
    )
    return [first, second]


def _session(seen: Snapshot, width: int) -> Text:
    session = seen.session
    if session is None:
        known = "this model needs none"
    else:
        known = f"{session.grasps} grasps, {'' if session.calibrated else 'not '}calibrated"
    text = _line(("session ", DIM), (known, ""))
    for line in seen.learning:
        more = _line((f"  {line.what} ", DIM), (line.advice, ""))
        if len(text) + len(more) > width:
            break
        text.append_text(more)
    return text


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
