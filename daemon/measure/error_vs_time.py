"""`graspd report error-vs-time`: error of each model against its run time on this computer.

Errors are those of the models' cards. Times are measured now, all candidates in turns: machines are
noisy, so compare ratios.
"""

from __future__ import annotations

import argparse
import json
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from graspd.daemon.measure.candidates import candidates
from graspd.daemon.measure.picture import DEFAULT, PANELS, Report, Row, draw, error_of
from graspd.daemon.measure.timing import measure
from graspd.daemon.process.text import complain, markdown_table, progress, write_lines
from graspd.models import zoo
from graspd.models.contract import ModelError
from graspd.models.training.data.datasets import DatasetError, Grasps, read_all
from graspd.models.training.evaluating.style import QUICK

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


def run(args: argparse.Namespace) -> int:
    """Measure models' error and time, write and print; return 2 for wrong input."""
    try:
        grasps = read_all(args.data)
        measured = report(grasps, [zoo.ZOO, *args.models], quick=args.quick)
        args.out.mkdir(parents=True, exist_ok=True)
        lines, figures = table(measured), json.dumps(measured)
        text = "\n".join(lines)
        base = args.out / "error-vs-time"
        base.with_suffix(".json").write_text(figures + "\n")
        base.with_suffix(".md").write_text(text + "\n")
        base.with_suffix(".svg").write_text(draw(measured, lines))
    except (DatasetError, ModelError, OSError) as error:
        complain(error)
        return 2
    write_lines(figures if args.json else text)
    return 0


def report(grasps: Grasps, folders: Sequence[Path], *, quick: bool = False) -> Report:
    """Return the figures of all models in these folders. Raises `ModelError`."""
    if quick:
        grasps = grasps.few()
    several = candidates(folders, grasps)
    readings, paced = (QUICK_READINGS, QUICK_PACED) if quick else (READINGS, PACED)
    times = measure({row["name"]: step for row, step in several}, readings, paced)
    progress("")
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
