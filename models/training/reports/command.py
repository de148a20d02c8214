"""`graspd report WHAT`: measure cost and errors of the models on this computer."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path

from graspd.models.training.commands.common import exit_code, whole


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the reports and their arguments, without loading them, which takes seconds."""
    reports = parser.add_subparsers(
        dest="report", metavar="WHAT", required=True, help="what to measure"
    )
    for name, (_, text, declare) in REPORTS.items():
        report = reports.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
        declare(report)


def run(args: argparse.Namespace) -> int:
    """Make the report; return its exit code, 2 for wrong input or folder. Raises `ModelError`."""
    report = importlib.import_module(REPORTS[args.report][0])
    folder = getattr(args, "out", Path())  # stability writes no file
    return exit_code("report", folder, lambda: report.run(args), keeps=False)


def _error_vs_time(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--data", type=Path, required=True, metavar="DIR", help="folder with the grasp tables"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs/error-vs-time"),
        metavar="DIR",
        help="folder for the table, the picture and the figures",
    )
    parser.add_argument(
        "--page",
        type=Path,
        metavar="FILE",
        help="also put the table into this page, and the picture beside it (deploy/MEASURED.md)",
    )
    parser.add_argument("--quick", action="store_true", help="few readings: does it run?")


def _stability(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("model", nargs="*", help="names in the zoo (default: all)")
    parser.add_argument(
        "--data", type=Path, metavar="DIR", help="folder of the real grasps: all of them too"
    )
    parser.add_argument("--quick", action="store_true", help="3000 outcomes instead of 10^5")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")


def _worth(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--data", type=Path, required=True, metavar="DIR", help="folder with the grasp tables"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs/worth"),
        metavar="DIR",
        help="folder for the picture, the tables and the figures (runs/worth)",
    )
    parser.add_argument(
        "--seeds", type=whole(1, 1000), default=1, metavar="N", help="of the object folds"
    )
    parser.add_argument(
        "--card",
        type=Path,
        metavar="FILE",
        help="card of a `small-session`, to put the figures on as well",
    )
    parser.add_argument("--quick", action="store_true", help="few grasps, one epoch: does it run?")


REPORTS = {
    "error-vs-time": (
        "graspd.models.training.reports.error_vs_time",
        "how wrong each model is against how long it takes",
        _error_vs_time,
    ),
    "stability": (
        "graspd.models.training.reports.stability",
        "numerical error of the whole chain on stiff and extreme readings",
        _stability,
    ),
    "worth": (
        "graspd.models.training.reports.worth",
        "what `stable` is worth on another day, by how many outcomes were told",
        _worth,
    ),
}
"""By name: module with `run(args) -> int`, line of help, function that declares arguments."""
