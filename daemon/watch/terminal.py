"""Snapshots as text for a terminal: one hand from 60 columns on, several beside each other."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Sequence

from rich.console import Group
from rich.text import Text

from daemon.process.text import printable
from daemon.watch.blocks import (
    BOLD,
    DIM,
    GAP,
    JOINT,
    Items,
    aside,
    beside,
    columns,
    figures,
    flow,
    grasps_and_joints,
    images,
    images_end,
    line,
    percent,
)
from daemon.watch.lanes import AXIS_LINES, LANES, PLOT_LINES, lanes, plot, strip
from daemon.watch.pixels import Canvas
from daemon.watch.snapshot import Snapshot, Tone

LARGE = (96, 33)
"""Columns and lines of a hand from which on its images are large."""
WIDE = 150
"""Columns from which on the reasons stand beside the verdict, and the figures in tables."""
NARROW = 70
"""Columns below which the field of the verdict is narrow, and there are more lines for reasons."""
HIGH = 26
"""Lines from which on there are three for reasons."""
BANNER_LINES, BANNER, BANNER_NARROW = 5, 24, 20
"""Lines and columns of the coloured field that has the verdict in its middle."""
LIST_LINES = 6
"""Of the last grasps and the joints where they stand below the images."""
FACTS = 45
"""Columns beside the field of the verdict below which words are left out."""
HAND_COLUMNS, HAND_LINES = 80, 24
"""What a hand needs for a place of its own where several are shown."""
NAME_MAX = 40
"""Characters of a name that came in a message."""


def draw(
    hands: Sequence[Snapshot], width: int, height: int, canvas: Canvas, chosen: int = 0
) -> Group:
    """The snapshots for a terminal of `width` x `height` characters, cut to what fits.

    Hands have places beside or below each other; where there is no room, `chosen` is the index of
    the one that is shown, and of the others there is a line each.
    """
    number, several = len(hands), len(hands) > 1
    signs = canvas.legend() if height >= HAND_LINES else []
    footer = _footer(width, signs)
    left = height - len(footer)
    rows: list[Text] = []
    if several and width // number < HAND_COLUMNS and left // number < HAND_LINES:
        footer = _footer(width, signs, "  tab next hand")
        rows = [_one_line(seen, canvas) for seen in hands if seen is not hands[chosen]]
        rows += _hand(hands[chosen], width, height - len(rows) - len(footer), canvas)
    elif several and width // number < HAND_COLUMNS:
        share = left // number
        for seen in hands:
            rows += _padded(_hand(seen, width, share, canvas), share)
    else:
        share = (width + GAP) // number - GAP
        for at, seen in enumerate(hands):
            rows = beside(rows, at * (share + GAP), _hand(seen, share, left, canvas))
    return Group(*rows, *footer)


def _padded(rows: list[Text], number: int) -> list[Text]:
    return rows[:number] + [Text()] * (number - len(rows))


def _hand(seen: Snapshot, width: int, height: int, canvas: Canvas) -> list[Text]:
    """At most `height` lines; what matters less goes first where there is no room."""
    large = width >= LARGE[0] and height >= LARGE[1]
    verdict = _verdict(seen, width, height, canvas)
    pictures = images(seen, width, canvas, large=large)
    known = figures(seen, NAME_MAX)
    below = aside(known, width, dim=seen.tone is Tone.SILENT)
    first = "".join(f"{each.what}: {each.advice}" for each in seen.health[:1])
    health = 2 if len(first) > width else 1
    left = height - 1 - len(verdict) - len(pictures) - AXIS_LINES - health
    if left < 0:
        left += len(pictures)
        pictures = []
    below = below[: max(left, 0)]
    left -= len(below)
    if width - images_end(seen, width, large=large) < JOINT and left > LIST_LINES:
        pictures += grasps_and_joints(seen, width, LIST_LINES)
        left -= LIST_LINES + 1
    timeline = strip(seen, width, canvas)
    if left >= LANES - 1:
        timeline = lanes(seen, width, canvas)
        left -= LANES - 1
        if left >= PLOT_LINES:
            timeline = plot(seen, width, canvas) + timeline
            left -= PLOT_LINES
    if width >= WIDE:
        tables = columns(known, width, dim=seen.tone is Tone.SILENT)
        if left >= len(tables) - len(below):
            left -= len(tables) - len(below)
            below = tables
    rows = [_header(seen), *verdict, *pictures, *timeline, *below]
    return [*rows, *_health(seen, width, canvas, max(left, 0) + health)][: max(height, 0)]


def _header(seen: Snapshot) -> Text:
    return line(
        ("graspd ", BOLD),
        (name(seen.hand or "-"), BOLD),
        # Of the picture: an operator sees it stand still where nothing is drawn any more.
        (time.strftime("  %H:%M:%S", time.localtime(seen.t)), BOLD),
        (f"  {seen.state or '-'}", BOLD),
        (f"  {name(seen.model or 'no model yet')}", DIM),
    )


def _footer(width: int, signs: list[Text], keys: str = "") -> list[Text]:
    rows = [line(("q ", BOLD), (f"ends{keys}", DIM))]
    for sign in signs:
        if len(rows[-1]) + GAP + len(sign) > width:
            rows.append(line())
        rows[-1].append(" " * GAP if len(rows[-1]) else "").append_text(sign)
    return rows


def _one_line(seen: Snapshot, canvas: Canvas) -> Text:
    said = f" {seen.headline.upper()}{percent(seen.p_slip)} "
    why = f" {seen.why[0].what}" if seen.why else ""
    hand = name(seen.hand or "-")
    return line((f"{hand} ", BOLD), (said, canvas.banner(seen.tone)), (why, ""))


def _verdict(seen: Snapshot, width: int, height: int, canvas: Canvas) -> list[Text]:
    banner = BANNER if width >= NARROW else BANNER_NARROW
    room = width - banner - 2
    facts = _facts(seen, canvas, min(room, 60) if width >= WIDE else room)
    number = max(BANNER_LINES, len(facts))
    words = [""] * number
    words[BANNER_LINES // 2] = seen.headline.upper()
    words[BANNER_LINES // 2 + 1] = _former(seen)
    style = canvas.banner(seen.tone)
    rows = [line((word.center(banner)[:banner], style)) for word in words]
    rows = beside(rows, banner + 2, facts)
    if width >= WIDE:
        at = banner + 2 + 60
        said = [line((seen.evidence, BOLD)), *_why(seen, width - at, number - 1, canvas)]
        return beside(rows, at, said)
    evidence = [line((part, BOLD)) for part in textwrap.wrap(seen.evidence, width)[:2]]
    lines = 2 if height < HIGH else 3 if width >= NARROW else 4
    return [*rows, *(evidence or [Text()]), *_why(seen, width, lines, canvas)]


def _former(seen: Snapshot) -> str:
    """What the grasp was judged to be before, where that does not stand any more."""
    last = seen.judged
    if last is None or last.verdict == "unknown" or last.grasp != seen.grasp:
        return ""
    if seen.verdict != "unknown" or seen.tone is Tone.SILENT:
        return ""
    return f"({'judged' if last.held else 'past:'} {last.verdict}{percent(last.p_slip)})"


def _facts(seen: Snapshot, canvas: Canvas, width: int) -> list[Text]:
    dim = seen.tone is Tone.SILENT
    touches = "not known" if seen.contact is None else " ".join(seen.contact) or "nothing"
    rows: list[Items] = [
        [("grasp", "-" if seen.grasp is None else str(seen.grasp)), ("gate", seen.gate or "-")],
        [("touches", touches), ("still", seen.still)],
    ]
    found = [row for items in rows for row in flow(items, width, gap=3, bold=True, dim=dim)]
    share = "-" if seen.p_slip is None else f"{100 * seen.p_slip:.0f} %"
    bar = canvas.bar(seen.p_slip, max(min(width - 24, 30), 5), seen.tone)
    found.append(line(("slip probability ", DIM), (f"{share:6}", BOLD)).append_text(bar))
    last, judged = seen.judged, "last judged" if width >= FACTS else "judged"
    if last is None:
        return [*found, line((f"{judged} ", DIM), ("-", BOLD))]
    past = "" if last.held else ", past"
    said = f"{last.verdict}{percent(last.p_slip)}"
    style = DIM if dim else BOLD
    return [
        *found,
        line((f"{judged} ", DIM), (said, style), (f", {last.ago_s:.0f} s ago{past}", DIM)),
        line(
            *(("its lift ", DIM), (last.lift, style)),
            (", supervised" if last.supervised else "", DIM),
        ),
    ]


def _why(seen: Snapshot, width: int, number: int, canvas: Canvas) -> list[Text]:
    """Always as many lines, so that what is below does not jump."""
    pairs = [(each.what, each.advice) for each in seen.why]
    return _padded(_advice(pairs, width, number, canvas, seen.tone), number)


def _advice(
    pairs: list[tuple[str, str]], width: int, number: int, canvas: Canvas, tone: Tone
) -> list[Text]:
    """At most `number` lines: wrapped if that is enough for all, else each in a line."""
    style = canvas.style(tone)
    found = []
    for what, advice in pairs[:number]:
        wrapped = textwrap.wrap(f"{what}: {advice}", width) or [""]
        first = line((wrapped[0][: len(what)], style), (wrapped[0][len(what) :], ""))
        found += [first, *[line((f"{part}", "")) for part in wrapped[1:]]]
    if len(found) <= number:
        return found
    return [line((what, style), (f": {advice}", "")) for what, advice in pairs[:number]]


def _health(seen: Snapshot, width: int, canvas: Canvas, lines: int) -> list[Text]:
    if not seen.health:
        return [line(("health ", DIM), ("all is well" if seen.state else "not known", ""))]
    shown = seen.health[: lines if len(seen.health) <= lines else lines - 1]
    pairs = [(name(each.what), each.advice) for each in shown]
    found = _advice(pairs, width, lines - (len(shown) < len(seen.health)), canvas, Tone.TROUBLE)
    more = len(seen.health) - len(shown)
    return [*found, line((f"and {more} more that is not well", BOLD))] if more else found


def name(text: str, length: int = NAME_MAX) -> str:
    """A name that came in a message, harmless for a terminal."""
    return printable(text, length)
