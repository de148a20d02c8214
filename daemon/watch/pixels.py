"""Tactile images, bars and strips as coloured characters, or as shades where there is no colour."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

from rich.color import Color
from rich.style import Style
from rich.text import Text

from daemon.watch.fingers import FULL, HEIGHT, WIDTH, FingerImage, FingerMotion
from daemon.watch.snapshot import Tone

COLOURS = {
    Tone.STABLE: "#2da44e",
    Tone.LEANS: "#7fa98a",
    Tone.LEARNING: "#2f7de0",
    Tone.SLIP: "#e5484d",
    Tone.WAITING: "#57606a",
    Tone.TROUBLE: "#d98e00",
    Tone.SILENT: "#8250df",
}
"""Told apart by people who mix up red and green too: they differ in lightness, and are named."""
PLAIN = {
    Tone.STABLE: "=",
    Tone.LEANS: "-",
    Tone.LEARNING: "!",
    Tone.SLIP: "X",
    Tone.WAITING: ".",
    Tone.TROUBLE: "?",
    Tone.SILENT: "~",
}
"""Signs of the same in a timeline."""
WORDS = {
    Tone.SLIP: "slip",
    Tone.STABLE: "stable",
    Tone.LEANS: "leans",
    Tone.LEARNING: "watched",
    Tone.TROUBLE: "wrong",
    Tone.WAITING: "waiting",
    Tone.SILENT: "silent",
}
"""Words for the same."""
_RISEN, _REST = (59, 125, 216), (38, 44, 54)
_PRESSED = ((11, (92, 44, 104)), (30, (158, 47, 98)), (55, (229, 92, 48)), (80, (251, 180, 26)))
_DEEPEST = (252, 255, 190)
_SHADES = " ░▒▓█"
_ASCII_SHADES = " .:+#"
_SHADE_FROM = (8, 25, 45, 70)
"""Levels from which on a pixel has the next shade."""


@dataclass(frozen=True, slots=True)
class Canvas:
    """What a terminal can show."""

    colour: bool = True
    ascii_only: bool = False

    def picture(self, image: FingerImage, *, large: bool) -> Text:
        """One finger: 22 x 12 characters, or 11 x 6 with two pixels in each."""
        marked = set(image.marked)
        text = Text()
        for row in range(0, HEIGHT, 1 if large else 2):
            if row:
                text.append("\n")
            for column in range(WIDTH):
                upper = row * WIDTH + column
                lower = upper if large else upper + WIDTH
                wrong = bool({upper, lower} & marked)
                self._pixel(text, image.levels[upper], image.levels[lower], wrong, large)
        return text

    def _pixel(self, text: Text, upper: int, lower: int, wrong: bool, large: bool) -> None:
        times = 2 if large else 1
        if wrong:
            cross = "x" if self.ascii_only else "\u00d7"
            style = Style(color="white", bgcolor=_colour(upper), bold=True)
            text.append(cross * times, style if self.colour else Style(bold=True))
        elif not self.colour or self.ascii_only:
            shades = _ASCII_SHADES if self.ascii_only else _SHADES
            shade = sum(max(upper, lower) >= limit for limit in _SHADE_FROM)
            text.append(shades[shade] * times)
        elif large:
            text.append("  ", _style(upper, upper))
        else:
            text.append("▀", _style(upper, lower))

    def scale(self, width: int) -> Text:
        """The colours from risen to pressed the most."""
        text = Text()
        low = -FULL // 4
        for column in range(width):
            level = low + (FULL - low) * column // max(width - 1, 1)
            self._pixel(text, level, level, False, False)
        return text

    def bar(self, share: float | None, width: int, tone: Tone) -> Text:
        """A share of 0..1 as a bar; empty without one."""
        full, empty = ("#", "-") if self.ascii_only else ("█", "░")
        number = 0 if share is None else round(share * width)
        text = Text().append(full * number, self.style(tone))
        return text.append(empty * (width - number), "dim")

    @property
    def limit(self) -> str:
        """The mark of a limit on a bar."""
        return "|" if self.ascii_only else "┃"

    def motion(self, motion: FingerMotion, width: int) -> Text:
        """How a finger moves: up to the mark it is still, and at the end it is twice as much."""
        if motion.now is None:
            return Text().append("?" * width, self.style(Tone.TROUBLE))
        full, empty = ("#", "-") if self.ascii_only else ("█", "░")
        share, below = min(motion.now / motion.limit, 2.0), width // 2
        above = width - below - 1
        still = min(round(share * below), below)
        moving = min(math.ceil(max(share - 1.0, 0.0) * below), above)
        style: Style | str = self.style(Tone.TROUBLE) if moving else ""
        text = Text().append(full * still, style).append(empty * (below - still), "dim")
        text.append(self.limit, "bold").append(full * moving, style)
        return text.append(empty * (above - moving), "dim")

    @property
    def sigma(self) -> str:
        """The unit of motion, one character wide; blank where it cannot be written."""
        return " " if self.ascii_only else "\u03c3"

    @property
    def point(self) -> str:
        """A point of a plot."""
        return "*" if self.ascii_only else "\u25cf"

    @property
    def rule(self) -> str:
        """What a plot is where it has no point."""
        return "." if self.ascii_only else "\u00b7"

    def moments(self, tones: Sequence[Tone | None]) -> Text:
        """A part of the timeline: a sign for each moment, on its colour where there is colour."""
        text = Text()
        for tone, run in itertools.groupby(tones):
            number = sum(1 for _ in run)
            if tone is None:
                text.append(" " * number)
            else:
                text.append(PLAIN[tone] * number, self._on_colour(tone))
        return text

    def legend(self) -> list[Text]:
        """The signs of the timeline, each with its word."""
        return [
            Text.assemble((PLAIN[tone], self._on_colour(tone)), (f" {word}", "dim"))
            for tone, word in WORDS.items()
        ]

    def _on_colour(self, tone: Tone) -> Style:
        return _moment(tone) if self.colour and not self.ascii_only else Style()

    def style(self, tone: Tone) -> Style:
        """Letters in the colour of a tone."""
        named = self.colour and tone is not Tone.WAITING  # grey letters are hard to read
        return Style(color=COLOURS[tone], bold=True) if named else Style(bold=True)

    def banner(self, tone: Tone) -> Style:
        """Letters on the colour of a tone."""
        if not self.colour:
            return Style(bold=tone is not Tone.LEANS)
        if tone is Tone.LEANS:
            return Style(color=COLOURS[tone])  # hollow
        return Style(color="#ffffff", bgcolor=COLOURS[tone], bold=True)


def _ramp() -> list[Color]:
    pressed = ((0, _REST), *_PRESSED, (FULL, _DEEPEST))
    found = [_between(_RISEN, _REST, (level + FULL) / FULL) for level in range(-FULL, 0)]
    for (low, one), (high, other) in itertools.pairwise(pressed):
        found += [_between(one, other, (x - low) / (high - low)) for x in range(low, high)]
    return [*found, Color.from_rgb(*_DEEPEST)]


def _between(one: tuple[int, int, int], other: tuple[int, int, int], share: float) -> Color:
    mixed = [a + (b - a) * share for a, b in zip(one, other, strict=True)]
    return Color.from_rgb(*mixed)


@functools.lru_cache(maxsize=4096)
def _style(upper: int, lower: int) -> Style:
    """Of two pixels in one character; made once, because that takes longer than all else."""
    return Style(color=_colour(upper), bgcolor=_colour(lower))


@functools.cache
def _moment(tone: Tone) -> Style:
    return Style(color="#ffffff", bgcolor=COLOURS[tone])


def _colour(level: int) -> Color:
    return _RAMP[level + FULL]


_RAMP = _ramp()
"""Colours of the levels -FULL to FULL."""
