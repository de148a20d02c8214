"""`graspd report WHAT`: what the models cost and how exact they are, measured here and now."""

from __future__ import annotations

import argparse
import importlib
from typing import Any

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


class _Report(argparse.ArgumentParser):
    """Imports its report, which takes seconds, once that is chosen."""

    module = ""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:  # noqa: ANN401
        importlib.import_module(self.module).add_arguments(self)
        return super().parse_known_args(args, namespace)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the reports."""
    reports = parser.add_subparsers(
        dest="report", metavar="WHAT", required=True, parser_class=_Report
    )
    for name, (module, text) in REPORTS.items():
        report = reports.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
        report.module = module


def run(args: argparse.Namespace) -> int:
    """Make the report; its exit code."""
    module, _ = REPORTS[args.report]
    code: int = importlib.import_module(module).run(args)
    return code
