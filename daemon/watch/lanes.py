"""The last five minutes in a terminal: a strip, or a lane for each kind of verdict and a plot."""

from __future__ import annotations

import itertools

from rich.text import Text

from daemon.watch.pixels import WORDS, Canvas
from daemon.watch.snapshot import MOMENTS, TONE_CODE, WORST_FIRST, Snapshot

LANES = len(WORDS)
LABEL = 8
"""Columns left of the time axis."""
LEVELS = (100, 75, 50, 25, 0)
"""Probabilities of slip that have a line in the plot, %."""
PLOT_LINES = len(LEVELS) + 1
AXIS_LINES = 2
"""Lines of the strip with its axis."""
MINUTES = 5


def strip(seen: Snapshot, width: int, canvas: Canvas) -> list[Text]:
    """The worst kind of each moment in one line, and the time axis."""
    text = Text().append(f"{'verdict':{LABEL}}", "dim")
    parts = _parts(seen.history, width - LABEL)
    worst = [next((t for t in WORST_FIRST if TONE_CODE[t] in part), None) for part in parts]
    text.append_text(canvas.moments(worst))
    return [text, _axis(width, canvas)]


def lanes(seen: Snapshot, width: int, canvas: Canvas) -> list[Text]:
    """A line for each kind of verdict, and the time axis."""
    parts = _parts(seen.history, width - LABEL)
    rows = []
    for tone, name in WORDS.items():
        row = Text().append(f"{name:{LABEL}}", canvas.style(tone))
        at = [tone if TONE_CODE[tone] in part else None for part in parts]
        rows.append(row.append_text(canvas.moments(at)))
    return [*rows, _axis(width, canvas)]


def plot(seen: Snapshot, width: int, canvas: Canvas) -> list[Text]:
    """The highest probability of slip of each moment, under a title."""
    room = max(width - LABEL, 1)
    padded = [-1] * (MOMENTS - len(seen.history_p)) + seen.history_p
    highest = [
        max(padded[at * MOMENTS // room : (at + 1) * MOMENTS // room], default=-1)
        for at in range(room)
    ]
    step = LEVELS[0] // (len(LEVELS) - 1)
    rows = [Text().append("slip probability, %, and verdicts by time", "dim")]
    for level in LEVELS:
        row = Text().append(f"{level:3} %".ljust(LABEL), "dim")
        at = [share >= 0 and round(share / step) * step == level for share in highest]
        for is_here, run in itertools.groupby(at):
            number = sum(1 for _ in run)
            row.append(
                (canvas.point if is_here else canvas.rule) * number, "" if is_here else "dim"
            )
        rows.append(row)
    return rows


def _parts(history: list[str], width: int) -> list[str]:
    """What there was in each column."""
    room = max(width, 1)
    padded = [""] * (MOMENTS - len(history)) + history
    firsts = [at * MOMENTS // room for at in range(room + 1)]
    return ["".join(padded[a : max(b, a + 1)]) for a, b in itertools.pairwise(firsts)]


def _axis(width: int, canvas: Canvas) -> Text:
    """A tick at every minute; the right end is now."""
    room = max(width - LABEL, 1)
    row = [" "] * room
    unit = " min" if room // MINUTES >= LABEL + len("-1 min") else ""
    for minute in range(MINUTES):
        label = f"{canvas.limit}-{MINUTES - minute}{unit if minute else ' min'}"
        at = minute * room // MINUTES
        row[at : at + len(label)] = label
    now = f"now{canvas.limit}"
    row[room - len(now) :] = now
    return Text().append(" " * LABEL + "".join(row)[:room], "dim")
