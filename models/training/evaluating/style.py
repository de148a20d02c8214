"""Style of all figures: one palette, light and dark, and how a figure becomes an SVG."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final

import matplotlib as mpl
from matplotlib.figure import Figure

INK, PAPER, GRID, QUIET = "#1f2328", "#ffffff", "#d8dee4", "#6e7781"
"""Colours of text and axes, background, grid lines, and secondary text."""
BLUE, NAVY, ORANGE, OLIVE = "#1f6f8b", "#123f50", "#c65d21", "#9a8f2f"
"""Colours of graspd, graspd under a risk limit, others, and graspd without outcomes."""
DARK: Final = {
    INK: "#e6edf3",
    PAPER: "#0d1117",
    GRID: "#30363d",
    QUIET: "#8d96a0",
    BLUE: "#58b4d1",
    NAVY: "#c3e6f2",
    ORANGE: "#f0883e",
    OLIVE: "#d0c24f",
}
"""Colours for readers who prefer dark pages, by the light colour that each replaces."""
QUICK: Final = "made with --quick: the figures mean nothing"
"""Mark on all results of `--quick`."""
_COLOUR: Final = re.compile(r"(fill|stroke): (#[0-9a-f]{6})(?:; )?")
_STYLE: Final = re.compile(r'style="([^"]*)"')


@contextmanager
def style() -> Iterator[None]:
    """Set this style for figures that are made within the block."""
    settings: dict[Any, Any] = {
        "svg.hashsalt": "graspd",
        "figure.facecolor": PAPER,
        "savefig.facecolor": PAPER,
        "axes.facecolor": PAPER,
        "axes.edgecolor": QUIET,
        "axes.labelcolor": INK,
        "axes.titlecolor": INK,
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "grid.color": GRID,
        "text.color": INK,
        "xtick.color": QUIET,
        "ytick.color": QUIET,
        "xtick.labelcolor": INK,
        "ytick.labelcolor": INK,
        "legend.frameon": False,
    }
    with mpl.rc_context(settings):
        yield


def mark_quick(figure: Figure) -> None:
    """Say in the figure that it was made with `--quick`."""
    figure.text(0.5, 0.5, QUICK, color=ORANGE, fontsize=16, rotation=20, ha="center", va="center",
                zorder=10, alpha=0.7)  # fmt: skip


def to_svg(figure: Figure, title: str, figures: Sequence[str]) -> str:
    """Return the figure as an SVG with its title and its figures in words, line by line.

    It follows the reader's light or dark pages. Made inside `style`, it is the same each time.
    """
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    drawn = _STYLE.sub(_with_classes, text.getvalue())
    head = f"<title>{_plain(title)}</title>"
    if figures:
        head += "\n <desc>\n" + _plain("\n".join(figures)) + "\n </desc>"
    first = drawn.index(">", drawn.index("<svg")) + 1
    return f"{drawn[:first]}\n {head}\n {_rules()}{drawn[first:]}"


def _with_classes(found: re.Match[str]) -> str:
    """Return a `style` attribute with the palette's colours replaced by CSS classes."""
    classes = [
        f"{kind[0]}{colour[1:]}" for kind, colour in _COLOUR.findall(found[1]) if colour in DARK
    ]
    if not classes:
        return found[0]
    rest = _COLOUR.sub(lambda each: "" if each[2] in DARK else each[0], found[1])
    return f'class="{" ".join(classes)}" style="{rest}"'


def _rules() -> str:
    light = "".join(map(_rule, DARK, DARK))
    dark = "".join(map(_rule, DARK, DARK.values()))
    return f"<style>{light}@media (prefers-color-scheme: dark) {{{dark}}}</style>"


def _rule(name: str, colour: str) -> str:
    return f".f{name[1:]}{{fill:{colour}}}.s{name[1:]}{{stroke:{colour}}}"


def _plain(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;")
