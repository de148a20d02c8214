"""`graspd report WHAT`: what the models cost and how exact they are, measured here and now."""

from __future__ import annotations

import argparse
import importlib

REPORTS = {
    "error-vs-time": (
        "daemon.measure.error_vs_time.report",
        "how wrong each model is against how long it takes",
    ),
    "stability": (
        "daemon.measure.stability.report",
        "numerical error of the whole chain on stiff and extreme readings",
    ),
    "worth": (
        "daemon.measure.worth.report",
        "what `stable` is worth on another day, by how many outcomes were told",
    ),
}
"""Name: module with `add_arguments(parser)` and `run(args) -> int`, one line of help."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the reports and their arguments."""
    reports = parser.add_subparsers(dest="report", metavar="WHAT", required=True)
    for name, (module, text) in REPORTS.items():
        report = reports.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
        importlib.import_module(module).add_arguments(report)


def run(args: argparse.Namespace) -> int:
    """Make the report; its exit code."""
    module, _ = REPORTS[args.report]
    code: int = importlib.import_module(module).run(args)
    return code
