"""The picture of what each window sees of slides, drawn from the table in deploy/JUDGING.md.

    python -m tests.bench.stillness_figure

writes deploy/stillness.svg. Put new figures in the table and run it again.
"""

from __future__ import annotations

import re
import sys
from typing import Final

from matplotlib.figure import Figure

from graspd.models.training.evaluating.style import BLUE, OLIVE, style, to_svg
from tests.conftest import ROOT

PAGE: Final = ROOT / "deploy" / "JUDGING.md"
PICTURE: Final = ROOT / "deploy" / "stillness.svg"
WINDOWS: Final = "window, ms"
COLOURS: Final = (BLUE, OLIVE)


def curves(page: str) -> list[list[str]]:
    """Return the rows of the table by window, titles first."""
    (table,) = re.findall(rf"(?:^\| {WINDOWS}.*\n)(?:\|.*\n)+", page, re.MULTILINE)
    lines = [line for line in table.splitlines() if not line.startswith("|--")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def draw(page: str) -> str:
    """Return the picture of this page's table, as SVG."""
    (_, *windows), *lines = curves(page)
    with style():
        figure = Figure(figsize=(7.0, 4.2), layout="constrained")
        axes = figure.subplots()
        for (name, *missed), colour in zip(lines, COLOURS, strict=True):
            axes.plot([*map(float, windows)], [*map(float, missed)], color=colour, label=name)
        axes.set(xlabel="time in which it is looked at, ms", ylim=(0, 100))
        axes.set_ylabel("of a sliding finger's time called still, %")
        axes.legend()
        said = [f"| {' | '.join(cells)} |" for cells in curves(page)]
        return to_svg(figure, "Time looked at against the share of slides missed", said)


def main() -> int:
    """Draw and write."""
    PICTURE.write_text(draw(PAGE.read_text()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
