"""The picture of what each window sees of slides, drawn from the tables in deploy/JUDGING.md.

    python -m tests.bench.stillness_figure

writes deploy/stillness.svg. Put new figures in the tables and run it again.
"""

from __future__ import annotations

import re
import sys
from typing import Final

from matplotlib.figure import Figure

from models.training.evaluating.style import BLUE, INK, OLIVE, style, to_svg
from tests.conftest import ROOT

PAGE: Final = ROOT / "deploy" / "JUDGING.md"
PICTURE: Final = ROOT / "deploy" / "stillness.svg"
WINDOWS: Final = "window, ms"
GATE: Final = "one of three fingers slides: of that time called still"
GATE_WINDOWS_MS: Final = {"early": 100.0, "sure": 240.0}
"""The gate's two windows, by the titles of their columns."""
COLOURS: Final = (BLUE, OLIVE)


def row(page: str, title: str) -> list[str]:
    """Return the cells of the table's row that begins with this title."""
    (line,) = re.findall(rf"^\| {re.escape(title)} \|(.*)\|$", page, re.MULTILINE)
    return [cell.strip() for cell in line.split("|")]


def curves(page: str) -> list[list[str]]:
    """Return the rows of the table by window, titles first."""
    (table,) = re.findall(rf"(?:^\| {WINDOWS}.*\n)(?:\|.*\n)+", page, re.MULTILINE)
    lines = [line for line in table.splitlines() if not line.startswith("|--")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def draw(page: str) -> str:
    """Return the picture of this page's tables, as SVG."""
    (_, *windows), *lines = curves(page)
    with style():
        figure = Figure(figsize=(7.0, 4.2), layout="constrained")
        axes = figure.subplots()
        for (name, *missed), colour in zip(lines, COLOURS, strict=True):
            axes.plot([*map(float, windows)], [*map(float, missed)], color=colour, label=name)
        for (name, window_ms), cell in zip(GATE_WINDOWS_MS.items(), row(page, GATE), strict=True):
            share = float(cell.removesuffix(" %"))
            axes.plot(window_ms, share, "o", color=INK)
            axes.annotate(
                f"{name}: {cell}",
                (window_ms, share),
                xytext=(-8, -4),
                textcoords="offset points",
                ha="right",
                va="top",
                color=INK,
            )
        axes.set(xlabel="time in which it is looked at, ms", ylim=(0, 100))
        axes.set_ylabel("of a sliding finger's time called still, %")
        axes.legend()
        said = [f"| {' | '.join(cells)} |" for cells in curves(page)]
        said.append(f"| {GATE} | {' | '.join(row(page, GATE))} |")
        return to_svg(figure, "Time looked at against the share of slides missed", said)


def main() -> int:
    """Draw and write."""
    PICTURE.write_text(draw(PAGE.read_text()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
