"""`graspd report error-vs-time`: error of each model against its run time on this computer.

Errors are those of the models' cards. Times are measured now, all candidates in turns, in several
runs: figures are medians of the runs. Machines are noisy, so compare ratios.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import sys
from collections.abc import Iterable, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from graspd.models.training.commands.common import WrongInputError, say
from graspd.models.training.data.datasets import Grasps, read_all
from graspd.models.training.evaluating.files import markdown_table
from graspd.models.training.evaluating.style import (
    BLUE,
    ORANGE,
    PAPER,
    QUICK,
    mark_quick,
    style,
    to_svg,
)
from graspd.models.training.reports.candidates import Row, Times, candidates, measure
from graspd.models.training.reports.machine import described, machine

RUNS = 3
READINGS, PACED = 2000, 300
"""Readings of each candidate in a run: without pause, and at 100 Hz."""
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
    "paced p50 (lowest..highest run) / p99, us",
    "CPU at 100 Hz",
)
ON_PAGE = {
    "model, F1 in %": 0,
    "known objects": 2,
    **{COLUMNS[place]: place for place in (3, 4, 8, 9)},
}
"""Titles of the table on a page, and the place of each in `COLUMNS`."""
PAGE_TABLE = re.compile(
    rf"(?:^\*\*{QUICK}\*\*\n\n)*^\| model, F1 in %.*\n(?:\|.*\n)+(?:\nprocessor .*\n)?",
    re.MULTILINE,
)
DEFAULT = "small-session"
PANELS = (
    (("cv",), "known objects"),
    (("objects", "objects-whole"), "other objects"),
    (("session",), "another day"),
)
"""Groups of protocols, and the title of each; a model has at most one protocol of a group. A model
without the first one of a group was measured on two palm poses only, and is drawn hollow."""
TIME = "paced_p50_us"
COLOURS = {"model": BLUE, "peer": ORANGE}
MARKERS = {"model": "o", "peer": "s"}
SIZE_IN = (8.6, 3.7)
"""Width and height at which the pages show the picture, inches."""
KEY = (
    "circle: model of graspd, square: published code, line: 95 % interval, "
    "hollow: on two palm poses only\n"
    "another day: the -session models have seen 50 unlabelled grasps of it"
)
TITLE_PT, FONT_PT = 9.5, 8.5
MARKER_PT = 6.5

Report = dict[str, Any]
"""Content of `error-vs-time.json`: `machine`, `quick`, numbers of `readings`, `rows`."""


def run(args: argparse.Namespace) -> int:
    """Measure run times; write and print the report. Raises `DatasetError`, `ModelError`, `OSError`
    or, for a page without one such table, `WrongInputError`."""
    grasps = read_all(args.data)
    if args.page is not None and len(PAGE_TABLE.findall(args.page.read_text())) != 1:
        raise WrongInputError(f"{args.page}: has not the one table that begins `model, F1 in %`")
    args.out.mkdir(parents=True, exist_ok=True)
    say("report", "measuring, one candidate after the other: some minutes")
    measured = report(grasps, quick=args.quick)
    lines = table(measured)
    text = "\n".join(lines)
    base = args.out / "error-vs-time"
    base.with_suffix(".json").write_text(json.dumps(measured) + "\n")
    base.with_suffix(".md").write_text(text + "\n")
    base.with_suffix(".svg").write_text(draw(measured, lines))
    if args.page is not None:
        put = "\n".join(page_table(measured)) + "\n"
        # Read again: it may have been edited meanwhile.
        args.page.write_text(PAGE_TABLE.sub(lambda _: put, args.page.read_text()))
        (args.page.parent / "error-vs-time.svg").write_text(draw(measured, lines))
    sys.stdout.write(f"{text}\n")
    return 0


def report(grasps: Grasps, *, quick: bool) -> Report:
    """Return the figures of all candidates, timed now. Raises `ModelError`."""
    if quick:
        grasps = grasps.few()
    several = candidates(grasps)
    readings, paced = (QUICK_READINGS, QUICK_PACED) if quick else (READINGS, PACED)
    steps = {row["name"]: step for row, step in several}
    runs = [measure(steps, readings, paced) for _ in range(RUNS)]
    rows = [{**row, **_over_runs([run[row["name"]] for run in runs])} for row, _ in several]
    return {
        "machine": machine(),
        "quick": quick,
        "readings": {"hot": readings, "paced": paced, "runs": RUNS},
        "rows": sorted(rows, key=_rank),
    }


def _over_runs(runs: Sequence[Times]) -> Row:
    """Return `time`, the median of each time, and `time_of_runs`, its lowest and highest run."""
    several = {name: [run[name] for run in runs] for name in runs[0]}
    return {
        "time": {name: statistics.median(values) for name, values in several.items()},
        "time_of_runs": {name: [min(values), max(values)] for name, values in several.items()},
    }


def _rank(row: Row) -> tuple[str, float]:
    """Return a sort key: models before peers, and those with the best F1 on known objects first."""
    return row["kind"], -error_of(row, PANELS[0][0]).get("f1", 0.0)


def table(measured: Report) -> list[str]:
    """Return the lines of a Markdown table of all rows, with a line on how it was made."""
    return _with_origin(measured, markdown_table(COLUMNS, map(_cells, measured["rows"])))


def page_table(measured: Report) -> list[str]:
    """Return the table for a page, with the columns `ON_PAGE`: candidates for the whole hand, the
    fastest first, F1 without intervals."""
    rows = []
    for row in whole_hand(measured["rows"]):
        cells = _cells(row)
        cells[2] = _percent(error_of(row, PANELS[0][0]))
        rows.append([cells[place] for place in ON_PAGE.values()])
    return _with_origin(measured, markdown_table(tuple(ON_PAGE), rows))


def _with_origin(measured: Report, lines: Iterable[str]) -> list[str]:
    number = measured["readings"]
    made = (
        f"{described(measured['machine'])}; {number['runs']} runs of {number['hot']} readings hot "
        f"and {number['paced']} paced; `graspd report error-vs-time`"
    )
    mark = [f"**{QUICK}**", ""] if measured["quick"] else []
    return [*mark, *lines, "", made]


def _cells(row: Row) -> list[str]:
    known, other, day = (error_of(row, protocols) for protocols, _ in PANELS)
    took, (low, high) = row["time"], row["time_of_runs"][TIME]
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
        f"{took[TIME]:.0f} ({low:.0f}..{high:.0f}) / {took['paced_p99_us']:.0f}",
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


def error_of(row: Row, protocols: Sequence[str]) -> dict[str, float]:
    """Return the figures of the first of these protocols that a row has; empty: none."""
    return next((row["error"][name] for name in protocols if name in row["error"]), {})


def whole_hand(rows: Sequence[Row]) -> list[Row]:
    """Return the candidates for the whole hand, the fastest first."""
    most = max(len(row["fingers"]) for row in rows)
    several = [row for row in rows if len(row["fingers"]) == most]
    return sorted(several, key=lambda row: float(row["time"][TIME]))


def draw(report: Report, figures: Sequence[str]) -> str:
    """Return the picture, as SVG; `figures`: lines of the report's table, for its description."""
    rows = whole_hand(report["rows"])
    with style():
        figure = Figure(figsize=SIZE_IN, dpi=72, layout="constrained")
        *panels, last = figure.subplots(1, len(PANELS) + 1, sharey=True)
        for axes, (protocols, asked) in zip(panels, PANELS, strict=True):
            _draw_errors(axes, rows, protocols, asked)
        _draw_times(last, rows)
        _name_rows(panels[0], rows)
        title = f"Error and run time, on {report['machine']['processor']}"
        figure.suptitle(f"{title}\n{KEY}", fontsize=TITLE_PT)
        if report["quick"]:
            mark_quick(figure)
        return to_svg(figure, title, figures)


def _draw_errors(axes: Axes, rows: Sequence[Row], protocols: Sequence[str], asked: str) -> None:
    for place, row in enumerate(rows):
        error = error_of(row, protocols)
        if not error:
            continue
        colour = COLOURS[row["kind"]]
        wrong, *reach = (100.0 * (1.0 - error[name]) for name in ("f1", "high", "low"))
        axes.plot(reach, [place, place], color=colour, lw=1.6, alpha=0.6)
        is_other = row["error"].get(protocols[0]) is not error
        face = PAPER if is_other else colour
        marker = MARKERS[row["kind"]]
        axes.plot(wrong, place, marker, color=colour, markerfacecolor=face, markersize=MARKER_PT)
    axes.set_xlim(left=0.0)
    axes.set_title(asked, fontsize=FONT_PT)
    axes.set_xlabel("1 - F1, %", fontsize=FONT_PT)
    axes.tick_params(labelsize=FONT_PT)


def _draw_times(axes: Axes, rows: Sequence[Row]) -> None:
    for place, row in enumerate(rows):
        colour, marker = COLOURS[row["kind"]], MARKERS[row["kind"]]
        axes.plot(row["time"][TIME] / 1000.0, place, marker, color=colour, markersize=MARKER_PT)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_title("time of a reading", fontsize=FONT_PT)
    axes.set_xlabel("ms, median at 100 Hz", fontsize=FONT_PT)
    axes.tick_params(labelsize=FONT_PT)


def _name_rows(axes: Axes, rows: Sequence[Row]) -> None:
    names = [row["name"] for row in rows]
    shown = [f"{name} (default)" if name == DEFAULT else name for name in names]
    axes.set_yticks(range(len(rows)), shown)
    for name, label in zip(names, axes.get_yticklabels(), strict=True):
        label.set_fontweight("bold" if name == DEFAULT else "normal")
    axes.set_ylim(len(rows) - 0.5, -0.5)
