"""What the terminal's picture of a hand is put together from: lines of text, side by side."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from rich.style import Style
from rich.text import Text

from daemon.process.text import printable
from daemon.watch.fingers import FingerImage
from daemon.watch.pixels import Canvas
from daemon.watch.snapshot import Snapshot, Tone

GAP = 2
"""Columns between fingers, and between figures."""
JOINT = 15
"""Columns of a joint."""
GRASPS, GRASPS_SHORT = 27, 18
"""Columns of the list of the last grasps, with and without how their lifts ended."""
NO_READINGS = "no readings to see"
DIM = Style(dim=True)
BOLD = Style(bold=True)
OLD = Style(dim=True, italic=True)
"""Of figures of a daemon that says nothing any more."""

Items = list[tuple[str, str]]
"""Labels and values."""


def line(*parts: tuple[str, str | Style]) -> Text:
    """A line that is cut, not wrapped."""
    text = Text.assemble(*parts)
    text.no_wrap, text.overflow = True, "ellipsis"
    return text


def percent(p_slip: float | None) -> str:
    """A probability behind a word; empty without one."""
    return "" if p_slip is None else f" {100 * p_slip:.0f} %"


def beside(left: Sequence[Text], at: int, right: Sequence[Text]) -> list[Text]:
    """The lines of `right` from column `at` on beside those of `left`."""
    rows = []
    for number in range(max(len(left), len(right))):
        row = left[number].copy() if number < len(left) else Text()
        if number < len(right):
            row.truncate(at, overflow="ellipsis", pad=True)
            row.append_text(right[number])
        row.no_wrap, row.overflow = True, "ellipsis"
        rows.append(row)
    return rows


def flow(
    items: Items, width: int, *, gap: int = GAP, bold: bool = False, dim: bool = False
) -> list[Text]:
    """Labels and values in as many lines as they need; none is cut that fits a line."""
    style = OLD if dim else BOLD if bold else Style()
    rows: list[Text] = []
    for label, value in items:
        item = line((f"{label} ", DIM), (value, style))
        if rows and len(rows[-1]) + gap + len(item) <= width:
            rows[-1].append(" " * gap).append_text(item)
        else:
            rows.append(item)
    return rows


def aside(known: Sequence[Items], width: int, *, dim: bool) -> list[Text]:
    """All figures, one after the other."""
    return flow([item for items in known for item in items], width, dim=dim)


def columns(known: Sequence[Items], width: int, *, dim: bool) -> list[Text]:
    """Figures in tables beside each other."""
    share = width // len(known)
    rows: list[Text] = []
    for number, items in enumerate(known):
        label_width = max((len(label) for label, _ in items), default=0) + GAP
        table = [
            line((label.ljust(label_width), DIM), (value, OLD if dim else Style()))
            for label, value in items
        ]
        for row in table:
            row.truncate(share - GAP, overflow="ellipsis")
        rows = beside(rows, number * share, table)
    return rows


def figures(seen: Snapshot, name_max: int) -> list[Items]:
    """All figures with their units, in groups; the first of a group matter most."""
    timing, session = seen.timing, seen.session
    counts = ", ".join(f"{count} {decision}" for decision, count in seen.counts.items())
    first: Items = [("since watch began", counts)]
    if seen.tone is Tone.SILENT and seen.last_t is not None:
        then = time.strftime("%H:%M:%S", time.localtime(seen.last_t))
        ago = f"{then}, {seen.t - seen.last_t:.0f} s ago; figures of then"
        first = [("last message", ago), *first]
    first += [
        ("readings", _number(timing.readings_hz, "/s")),
        ("verdicts", f"{timing.verdicts_hz:.0f}/s"),
        ("age", _number(timing.age_ms, " ms", 1)),
        ("latency", f"p50 {_number(timing.p50_us, ' us')}, p99 {_number(timing.p99_us, ' us')}"),
        ("lost here", f"{timing.lost} messages"),
    ]
    needed = "this model needs none"
    if session is not None:
        needed = f"{session.grasps} grasps, {'' if session.calibrated else 'not '}calibrated"
    second = [(each.what, each.advice) for each in seen.learning]
    third = [
        ("session", needed),
        ("repaired", printable(", ".join(seen.repaired) or "nothing", name_max)),
        ("late", _number(timing.late, " readings")),
        ("worst age", _number(timing.worst_age_ms, " ms")),
        ("longest latency", _number(timing.max_us, " us")),
        ("jitter p99", _number(timing.jitter_p99_us, " us")),
        ("not understood", f"{timing.not_understood} messages"),
        ("at", f"{printable(seen.endpoint, 2 * name_max)} {seen.link}"),
    ]
    return [first, second, third] if second else [first, third]


def _number(value: float | None, unit: str, digits: int = 0) -> str:
    return "-" if value is None else f"{value:.{digits}f}{unit}"


def images_end(seen: Snapshot, width: int, *, large: bool) -> int:
    """The column where what stands beside the images begins, which may be the last one."""
    number, across = len(seen.fingers), 22 if large else 11
    gap = GAP if number * (across + GAP) <= width else 1
    return number * (across + gap) or len(NO_READINGS) + GAP


def images(seen: Snapshot, width: int, canvas: Canvas, *, large: bool) -> list[Text]:
    """Tactile images with what stands beside them if there is room; always as many lines."""
    lines = 12 if large else 6
    number, at = len(seen.fingers), images_end(seen, width, large=large)
    rows = [] if number else [line((NO_READINGS, DIM))]
    for place, finger in enumerate(seen.fingers):
        known = {True: "touches", False: "free", None: ""}[finger.touches]
        title = line((f"{finger.name} ", BOLD), (known, canvas.style(seen.tone)))
        cell = [title, *canvas.picture(finger, large=large).split("\n")]
        cell += _depth_and_motion(finger, canvas, large=large)
        rows = beside(rows, place * at // number, cell)
    rows += [Text()] * (lines + (3 if large else 2) - len(rows))
    if width - at < JOINT:
        return rows
    right = grasps_and_joints(seen, width - at, lines)
    return beside(rows, at, [*right, *_scale(seen, width - at, canvas)])


def _depth_and_motion(finger: FingerImage, canvas: Canvas, *, large: bool) -> list[Text]:
    """Two lines where there is room for them, one where not."""
    motion, depth = finger.motion, "fall" if finger.from_rest else "span"
    if large:
        below = line((f"{depth} {finger.deepest} counts", DIM))
        if motion is None:
            return [below, Text()]
        now = "" if motion.now is None else f"{motion.now:.{motion.now < 10.0:d}f}{canvas.sigma}"
        moves = line(("moves ", DIM), (f"{now:5}", ""))
        return [below, moves.append_text(canvas.motion(motion, 11))]
    if motion is None:
        return [line((f"{depth} {finger.deepest}", DIM))]
    return [line((f"{finger.deepest:4} ", DIM)).append_text(canvas.motion(motion, 6))]


def _scale(seen: Snapshot, width: int, canvas: Canvas) -> list[Text]:
    """What the images and bars mean; in as many words as there is room for."""
    if not seen.fingers:
        return []
    first = seen.fingers[0]
    depth = "fall" if first.from_rest else "span"
    short = ["; counts", ""]
    if first.motion is None:
        said = [f", below {'rest' if first.from_rest else 'the median'}, counts", *short]
    else:
        limit = f"motion to {canvas.limit}"
        units = f"counts, {canvas.sigma.strip() or 'sigma'}"
        said = [f"; {depth}, {limit}: {units}", f"; {depth}, {limit}"]
        said += [f"; {limit}", *short]
    rows = [
        line(("risen ", DIM)).append_text(canvas.scale(6)).append(f" pressed{words}", DIM)
        for words in said
    ]
    return [next((row for row in rows if len(row) <= width), rows[-1])]


def grasps_and_joints(seen: Snapshot, width: int, lines: int) -> list[Text]:
    """A title and so many lines: joints, and the last grasps where there is room."""
    if not seen.grasps or width < GRASPS_SHORT:
        return _joints(seen, width, lines)
    if width >= GRASPS + JOINT - 1:
        at = GRASPS + 1
        return beside(_grasps(seen, at, lines), at, _joints(seen, width - at, lines))
    if not seen.joints:
        return _grasps(seen, width, lines)
    half = lines // 2
    return [*_grasps(seen, width, half), *_joints(seen, width, lines - half - 1)]


def _grasps(seen: Snapshot, width: int, lines: int) -> list[Text]:
    """A title and so many lines, the newest grasp first."""
    style = OLD if seen.tone is Tone.SILENT else Style()
    rows = []
    for last in seen.grasps[:lines]:
        lift = f" {last.lift}{'*' if last.supervised else ''}" if width >= GRASPS else ""
        rows.append(f"{last.grasp:4} {last.verdict:7}{percent(last.p_slip):>5}{lift}")
    rows += [""] * (lines - len(rows))
    title = "last grasps (* watched)" if width >= GRASPS else "last grasps"
    return [line((title, DIM)), *[line((row, style)) for row in rows]]


def _joints(seen: Snapshot, width: int, lines: int) -> list[Text]:
    """A title and so many lines."""
    named = sorted(seen.joints.items())
    across = max(1, min(width // JOINT, math.ceil(len(named) / lines)))
    cells = [
        f"{printable(name, 5):5}{math.degrees(angle):6.1f}°".ljust(JOINT) for name, angle in named
    ]
    rows = ["".join(cells[row : lines * across : lines]).rstrip() for row in range(lines)]
    return [line(("joints" if named else "no joints", DIM)), *[line((row, "")) for row in rows]]
