"""`graspd report error-vs-time`: error of each model against its run time on this computer.

Errors are those of the models' cards. Times are measured now, all candidates in turns: machines are
noisy, so compare ratios.
"""

from __future__ import annotations

import argparse
import itertools
import json
import platform
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from graspd.models import zoo
from graspd.models.training.commands.common import say
from graspd.models.training.data.datasets import Grasps, read_all
from graspd.models.training.evaluating.files import markdown_table
from graspd.models.training.evaluating.style import (
    BLUE,
    ORANGE,
    PAPER,
    QUICK,
    QUIET,
    mark_quick,
    style,
    to_svg,
)
from graspd.models.training.reports.candidates import Row, candidates, measure

READINGS, PACED = 2000, 300
QUICK_READINGS, QUICK_PACED = 100, 5
COLUMNS = (
    "model",
    "fingers",
    "F1, known objects (95 %)",
    "other objects",
    "another day",
    "Brier",
    "ECE",
    "hot p50 / p99 / p99.9, us",
    "paced p50 / p99, us",
    "CPU at 100 Hz",
)
DEFAULT = "small-session"
PANELS = (
    (("cv",), "known objects"),
    (("objects", "objects-whole"), "other objects"),
    (("session",), "another day"),
)
"""Protocols and their question; a model has at most one of a group.
Without the first it was measured on two palm poses only, and is drawn hollow."""
COLOURS = {"model": BLUE, "peer": ORANGE}
MARKERS = {"model": "o", "peer": "s"}
SIZE_IN = (9.5, 9.6)
ERROR_MAX = 104.0
"""Upper end of an axis, %: a point at 100 is seen whole."""
KEY = (
    "circles: graspd's models, squares: peers, line: the front, bars: 95 %, "
    "hollow: two palm poses only"
)
FONT_PT = 8.5
MARKER_PT = 8.0

Report = dict[str, Any]
"""Figures in `error-vs-time.json`."""


def run(args: argparse.Namespace) -> int:
    """Measure models' error and time, write and print. Raises `DatasetError` or `ModelError`."""
    grasps = read_all(args.data)
    say("report", "measuring, one candidate after the other: some minutes")
    measured = report(grasps, [zoo.ZOO, *args.models], quick=args.quick)
    args.out.mkdir(parents=True, exist_ok=True)
    lines, figures = table(measured), json.dumps(measured)
    text = "\n".join(lines)
    base = args.out / "error-vs-time"
    base.with_suffix(".json").write_text(figures + "\n")
    base.with_suffix(".md").write_text(text + "\n")
    base.with_suffix(".svg").write_text(draw(measured, lines))
    sys.stdout.write(f"{figures if args.json else text}\n")
    return 0


def report(grasps: Grasps, folders: Sequence[Path], *, quick: bool = False) -> Report:
    """Return the figures of all models in these folders. Raises `ModelError`."""
    if quick:
        grasps = grasps.few()
    several = candidates(folders, grasps)
    readings, paced = (QUICK_READINGS, QUICK_PACED) if quick else (READINGS, PACED)
    times = measure({row["name"]: step for row, step in several}, readings, paced)
    rows = [{**row, "time": times[row["name"]]} for row, _ in several]
    return {
        "machine": {"processor": _processor(), "python": platform.python_version()}
        | {package: version(package) for package in ("numpy", "onnxruntime")},
        "quick": quick,
        "readings": {"hot": readings, "paced": paced},
        "rows": sorted(rows, key=_rank),
    }


def _rank(row: Row) -> tuple[str, float]:
    """Order models before peers, and the most exact first."""
    return row["kind"], -error_of(row, PANELS[0][0]).get("f1", 0.0)


def table(measured: Report) -> list[str]:
    """Return the lines of a Markdown table of all rows, with a line on how it was made."""
    machine = ", ".join(f"{name} {value}" for name, value in measured["machine"].items())
    made = (
        f"{machine}; {measured['readings']['hot']} readings hot, {measured['readings']['paced']} "
        f"paced; `graspd report error-vs-time`"
    )
    rows = (_cells(row) for row in measured["rows"])
    mark = [f"**{QUICK}**", ""] if measured["quick"] else []
    return [*mark, *markdown_table(COLUMNS, rows), "", made]


def _cells(row: Row) -> list[str]:
    known, other, day = (error_of(row, protocols) for protocols, _ in PANELS)
    took = row["time"]
    name = f"`{row['name']}`" if row["kind"] == "model" else row["name"]
    return [
        f"{name}, the default" if row["name"] == DEFAULT else name,
        " ".join(row["fingers"]),
        _interval(known),
        _percent(other),
        _percent(day),
        _score(known, "brier"),
        _score(known, "ece"),
        f"{took['hot_p50_us']:.0f} / {took['hot_p99_us']:.0f} / {took['hot_p99.9_us']:.0f}",
        f"{took['paced_p50_us']:.0f} / {took['paced_p99_us']:.0f}",
        f"{took['cpu_percent_at_100_hz']:.1f} %",
    ]


def _percent(error: dict[str, float]) -> str:
    return f"{100 * error['f1']:.1f}" if error else "-"


def _interval(error: dict[str, float]) -> str:
    if not error:
        return "-"
    return f"{100 * error['f1']:.1f} ({100 * error['low']:.1f}..{100 * error['high']:.1f})"


def _score(error: dict[str, float], name: str) -> str:
    return f"{error[name]:.3f}" if error else "-"


def _processor() -> str:
    """Return the name of the processor, or its architecture where the kernel does not tell."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.machine())


@dataclass(frozen=True, slots=True)
class Point:
    """One candidate in one panel."""

    name: str
    kind: str
    """`model` or `peer`."""
    us: float
    """Time of a paced reading, p50."""
    error: float
    """1 - F1, in %."""
    reach: tuple[float, float]
    """From the error down and up to the ends of its 95 % interval, in %."""
    hollow: bool


def error_of(row: Row, protocols: Sequence[str]) -> dict[str, float]:
    """Return the figures of the first of these protocols that a row has; empty: none."""
    return next((row["error"][name] for name in protocols if name in row["error"]), {})


def points(rows: Sequence[Row], protocols: Sequence[str]) -> Iterator[Point]:
    """Yield the candidates for the whole hand that have figures of one of these protocols."""
    most = max(len(row["fingers"]) for row in rows)
    for row in rows:
        error = error_of(row, protocols)
        if error and len(row["fingers"]) == most:
            yield Point(
                row["name"],
                row["kind"],
                row["time"]["paced_p50_us"],
                100.0 * (1.0 - error["f1"]),
                (100.0 * (error["high"] - error["f1"]), 100.0 * (error["f1"] - error["low"])),
                row["error"].get(protocols[0]) is not error,
            )


def front(several: Sequence[Point]) -> list[Point]:
    """Return the models without another that is both faster and more exact, fastest first."""
    best: list[Point] = []
    for point in sorted(several, key=lambda point: (point.us, point.error)):
        if point.kind == "model" and (not best or point.error < best[-1].error):
            best.append(point)
    return best


def draw(report: Report, figures: Sequence[str]) -> str:
    """Return the picture, as SVG; `figures` are the report's table."""
    with style():
        figure = Figure(figsize=SIZE_IN, dpi=72, layout="constrained")
        panels = figure.subplots(len(PANELS), 1, sharex=True)
        drawn = [list(points(report["rows"], protocols)) for protocols, _ in PANELS]
        times = [point.us for point in itertools.chain(*drawn)]
        panels[-1].set_xscale("log")
        panels[-1].set_xlim(min(times) / 1.5, max(times) * 1.5)
        for axes, several, (_, asked) in zip(panels, drawn, PANELS, strict=True):
            _draw_panel(axes, several, asked)
        panels[-1].set_xlabel("time of a reading, input and network, paced at 100 Hz, p50, us")
        title = f"Error against run time, on {report['machine']['processor']}"
        figure.suptitle(f"{title}\n{KEY}", fontsize=11)
        if report["quick"]:
            mark_quick(figure)
        return to_svg(figure, title, figures)


def _draw_panel(axes: Axes, several: Sequence[Point], asked: str) -> None:
    for point in several:
        colour = COLOURS[point.kind]
        reach = [[each] for each in point.reach]
        axes.errorbar(
            point.us, point.error, yerr=reach, ecolor=colour, alpha=0.6, lw=1.4, capsize=3
        )
        marker = "*" if point.name == DEFAULT else MARKERS[point.kind]
        axes.plot(
            point.us, point.error, marker, color=colour,
            markersize=MARKER_PT * (2.0 if marker == "*" else 1.0),
            markerfacecolor=PAPER if point.hollow else colour, zorder=5,
        )  # fmt: skip
    best = front(several)
    axes.plot(
        [point.us for point in best], [point.error for point in best],
        color=COLOURS["model"], lw=1.6, alpha=0.5, zorder=1,
    )  # fmt: skip
    if several:
        low = min(point.error - point.reach[0] for point in several)
        high = max(point.error + point.reach[1] for point in several)
        margin = 0.08 * (high - low)
        axes.set_ylim(max(low - margin, 0.0), min(high + margin, ERROR_MAX))
    axes.set_ylabel(f"{asked}\n1 - F1, %")
    name_points(axes, several)


def name_points(axes: Axes, several: Sequence[Point]) -> None:
    """Put the names in a column beside the panel, in the order of the errors."""
    ordered = sorted(several, key=lambda point: point.error)
    heights = np.linspace(0.02, 0.98, len(ordered))
    for point, height in zip(ordered, heights, strict=True):
        is_default = point.name == DEFAULT
        axes.annotate(
            f"{point.name} (default)" if is_default else point.name, (point.us, point.error),
            fontsize=FONT_PT, color=COLOURS[point.kind],
            fontweight="bold" if is_default else "normal", va="center",
            xytext=(1.02, height), textcoords="axes fraction",
            arrowprops={"arrowstyle": "-", "lw": 0.6, "color": QUIET, "relpos": (0.0, 0.5)},
        )  # fmt: skip
