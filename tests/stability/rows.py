"""What the cases of stability have measured: tables for people, or JSON."""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import pytest

from graspd.daemon.process.text import printable
from graspd.models.training.evaluating.files import markdown_table

Row = dict[str, Any]
QUICK_BELOW = 1_000_000
"""Outcomes that the learner is told unless `--quick` is given."""
NUMBERS = (
    *("readings", "compared", "input_error", "network_error", "chain_error", "mean_error"),
    "flips",
)
CASE_COLUMNS = ("model", "case", *NUMBERS, "verdicts", "reasons", "bounds")
STEP_COLUMNS = ("step", "expected", "found", "bounds")
LEGEND = (
    "compared: readings that the network is asked of; the others are flat.",
    "input_error: of any element of an input, over the largest magnitude in it.",
    "network_error: of p_slip, against the network in float64 with the same float32 input.",
    "chain_error: the same from the counts on, with nothing rounded; not bounded for trees.",
)


class Rows:
    """Plugin of pytest that prints the rows at the end."""

    def __init__(self, outcomes: int, *, as_json: bool) -> None:
        self._outcomes = outcomes
        self._as_json = as_json
        self._rows: list[Row] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when != "call" and not report.failed:
            return
        crash = getattr(report.longrepr, "reprcrash", None)
        failure = str(crash.message if crash else report.longrepr) if report.failed else None
        name = report.nodeid.rpartition("::")[2]
        row = row_of(dict(report.user_properties).get("row"), name, failure)
        self._rows += [] if row is None else [row]

    def pytest_sessionfinish(self) -> None:
        if self._rows:
            sys.stdout.write(text(self._rows, self._outcomes, as_json=self._as_json) + "\n")


def row_of(noted: object, name: str, failure: str | None) -> Row | None:
    """Return the row of a case; None: it notes none and has not failed. NaN becomes None."""
    if isinstance(noted, str):
        row: Row = json.loads(noted, parse_constant=lambda _name: None)
    elif failure is not None:
        row = {"step": name, "expected": "a result", "found": failure.partition("\n")[0]}
    else:
        return None
    problems = "; ".join(row.pop("problems", ()))
    row["bounds"] = "kept" if failure is None else f"BROKEN {problems}".rstrip()
    return row


def text(rows: Sequence[Row], outcomes: int, *, as_json: bool) -> str:
    """Return all rows, how many break a bound, and on what machine that is."""
    machine = f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}"
    broken = sum(row["bounds"] != "kept" for row in rows)
    if as_json:
        quick = outcomes < QUICK_BELOW
        return json.dumps({"rows": rows, "broken": broken, "machine": machine, "quick": quick})
    last = f"{broken} of {len(rows)} rows break a bound, {outcomes:.0e} outcomes. {machine}."
    return "\n".join([*map(printable, _markdown(rows)), "", last])


def _markdown(rows: Sequence[Row]) -> Iterator[str]:
    """Yield two tables: each model on each case, and the steps that belong to no model."""
    cases = sorted((row for row in rows if "case" in row), key=lambda row: str(row["model"]))
    steps = [row for row in rows if "case" not in row]
    for columns, chosen in ((CASE_COLUMNS, cases), (STEP_COLUMNS, steps)):
        lines = [[_cell(row[key]) for key in columns] for row in chosen]
        yield from markdown_table(columns, lines, right=NUMBERS)
        yield ""
    yield from LEGEND


def _cell(value: object) -> str:
    match value:
        case float():
            return f"{value:.1e}"
        case dict():
            return ", ".join(f"{name} {count}" for name, count in value.items())
        case None:
            return "-"
        case _:
            return str(value)
