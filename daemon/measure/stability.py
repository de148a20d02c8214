"""`graspd report stability`: numerical errors of the whole chain, against references and bounds.

The rows are the test cases in `tests/stability` of the checkout. This command runs them and prints
three tables: each model, each model on each case, and the steps that belong to no model.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from daemon.process.extras import needs
from daemon.process.text import complain, markdown_table, printable, progress
from models import zoo
from models.bts3 import TABLES
from models.contract import ModelError

INPUT_RELATIVE_MAX = 1e-5
"""Largest error of a reading's input over the largest magnitude in that input."""
P_SLIP_ERROR_MAX = 1e-4
"""Largest error of a probability. A verdict further from its threshold must not flip."""
CHECKOUT = Path(__file__).parents[2]
CASES = Path("tests/stability")
PACKAGES = ("pytest", "hypothesis", "onnx", "torch")
BROKEN, WRONG = 1, 2
OUTCOMES = 1_000_000
"""Outcomes that the learner is told; the tests alone tell 10^4."""

Row = dict[str, Any]
SUMMARY_TITLES = (
    "model",
    "readings",
    "compared",
    "input error",
    "p_slip error",
    "whole chain",
    "flips",
    "bounds",
)
CASE_TITLES = (
    *("model", "case"),
    *SUMMARY_TITLES[1:6],
    *("mean", "flips", "verdicts and reasons", "bounds"),
)
STEP_TITLES = ("step", "expected", "found", "bounds")
NUMBERS = frozenset(CASE_TITLES[2:9])
"""Columns whose cells stand to the right."""
ERRORS = ("input_error", "network_error", "chain_error", "mean_error")
LEGEND = (
    "compared: readings that the network is asked of; the others are flat.",
    "input error: of any element of an input, over the largest magnitude in it; against extended "
    "precision.",
    "p_slip error: against the network in float64, fed with the daemon's own float32 input, and of "
    "what is published.",
    "whole chain: the same from the counts on, with nothing rounded. Not bounded for trees and "
    "quantised networks, whose answer jumps.",
)


def run(args: argparse.Namespace) -> int:
    """Measure and print; return 1 if a bound is broken, 2 if something is missing or unknown."""
    problem = _missing(args.model, args.data)
    if problem is not None:
        complain(problem)
        return WRONG
    try:
        rows = _measured(args)
        if args.markdown is not None:
            args.markdown.write_text("\n".join(_markdown(rows)) + "\n", "utf-8")
    except (OSError, ElementTree.ParseError) as error:
        complain(error)
        return WRONG
    if not rows:
        return WRONG
    if args.json:
        sys.stdout.write(json.dumps(_as_json(rows)) + "\n")
    else:
        sys.stdout.write("\n".join(map(printable, _text(rows))) + "\n")
    return BROKEN if _broken(rows) else 0


def _missing(names: Sequence[str], data: Path | None) -> str | None:
    """Say what is not there: the tests, a package, a model or a table."""
    if not (CHECKOUT / CASES).is_dir():
        return f"report stability runs {CASES}: run it in a checkout of graspd, not as installed"
    for package in PACKAGES:
        if find_spec(package) is None:
            absent = ModuleNotFoundError(name=package)
            return needs("report stability", "train,test", absent)
    try:
        for name in names:
            zoo.find(name)
    except ModelError as error:
        return str(error)
    tables = [] if data is None else [data / f"{table.name}.csv" for table in TABLES]
    for path in tables:
        if not path.is_file():
            return f"{path}: no such file; `graspd data` gets it"
    return None


def _measured(args: argparse.Namespace) -> list[Row]:
    """Run the cases in a process of its own; return their rows, none if they cannot be run."""
    outcomes = 10_000 if args.quick else OUTCOMES
    progress(f"running the cases of {CASES}, one to four minutes")
    with tempfile.TemporaryDirectory() as folder:
        results = Path(folder) / "results.xml"
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(CASES)]
        command += [f"--junitxml={results}", "--override-ini=junit_family=xunit1"]
        command.append(f"--outcomes={outcomes}")
        command += [f"--model={name}" for name in args.model]
        if args.data is not None:
            command.append(f"--data={args.data.resolve()}")
        done = subprocess.run(
            command,
            check=False,
            cwd=CHECKOUT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        progress("")
        if done.returncode not in (0, 1):
            complain(done.stdout.strip() or f"pytest ended with {done.returncode}")
            return []
        return list(_rows(results))


def _rows(results: Path) -> Iterator[Row]:
    """Rows that the tests noted in pytest's JUnit file, with what failed."""
    for case in ElementTree.parse(results).iter("testcase"):
        noted = case.find("properties/property[@name='row']")
        failure = case.find("failure") if case.find("error") is None else case.find("error")
        if noted is None and failure is None:
            continue
        if noted is not None:
            row: Row = json.loads(noted.get("value", "{}"))
        else:
            said = "" if failure is None else failure.get("message", "").partition("\n")[0]
            row = {"step": case.get("name", ""), "expected": "a result", "found": said}
        row["held"] = failure is None
        yield row


def _broken(rows: Sequence[Row]) -> int:
    return sum(not row["held"] for row in rows)


def _text(rows: Sequence[Row]) -> Iterator[str]:
    """Aligned columns, numbers to the right."""
    for titles, lines in _tables(rows):
        widths = [max(map(len, column)) for column in zip(titles, *lines, strict=True)]
        for line in (titles, *lines):
            cells = [
                cell.rjust(width) if title in NUMBERS else cell.ljust(width)
                for title, cell, width in zip(titles, line, widths, strict=True)
            ]
            yield "  ".join(cells).rstrip()
        yield ""
    yield from LEGEND
    yield _verdict(rows)


def _markdown(rows: Sequence[Row]) -> Iterator[str]:
    for titles, lines in _tables(rows):
        yield from markdown_table(titles, lines, right=NUMBERS)
        yield ""
    for line in (*LEGEND, _verdict(rows), f"Machine: {_machine()}."):
        yield line
        yield ""


def _tables(rows: Sequence[Row]) -> Iterator[tuple[Sequence[str], list[Sequence[str]]]]:
    cases = _cases(rows)
    names = dict.fromkeys(row["model"] for row in cases)
    summary = [_summary([row for row in cases if row["model"] == name]) for name in names]
    yield SUMMARY_TITLES, summary
    yield CASE_TITLES, [_case_cells(row) for row in cases]
    yield (
        STEP_TITLES,
        [(row["step"], row["expected"], row["found"], _bounds(row)) for row in _steps(rows)],
    )


def _cases(rows: Sequence[Row]) -> list[Row]:
    """Rows of models, those of the same model together."""
    return sorted((row for row in rows if "case" in row), key=lambda row: str(row["model"]))


def _steps(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if "case" not in row]


def _summary(rows: Sequence[Row]) -> Sequence[str]:
    """The worst of all cases of one model."""
    broken = _broken(rows)
    return (
        rows[0]["model"],
        str(sum(row["readings"] for row in rows)),
        str(sum(row["compared"] for row in rows)),
        *(f"{max(row[error] for row in rows):.1e}" for error in ERRORS[:3]),
        str(sum(row["flips"] for row in rows)),
        f"BROKEN, {broken} of {len(rows)} cases" if broken else "kept",
    )


def _case_cells(row: Row) -> Sequence[str]:
    return (
        row["model"],
        row["case"],
        str(row["readings"]),
        str(row["compared"]),
        *(f"{row[error]:.1e}" if row["compared"] else "-" for error in ERRORS),
        str(row["flips"]),
        _said(row),
        _bounds(row),
    )


def _said(row: Row) -> str:
    """Such as `unknown 24 (never-seen 20, flat 4), slip 3`."""
    reasons = ", ".join(f"{name} {number}" for name, number in row["reasons"].items())
    return ", ".join(
        f"{name} {number} ({reasons})" if name == "unknown" else f"{name} {number}"
        for name, number in sorted(row["verdicts"].items(), reverse=True)
    )


def _bounds(row: Row) -> str:
    if row["held"]:
        return "kept"
    problems = "; ".join(row.get("problems", ()))
    return f"BROKEN: {problems}" if problems else "BROKEN"


def _verdict(rows: Sequence[Row]) -> str:
    return (
        f"{_broken(rows)} of {len(rows)} rows break a bound (input {INPUT_RELATIVE_MAX:.0e} "
        f"relative, p_slip {P_SLIP_ERROR_MAX:.0e}, no verdict flipped further from its threshold "
        "than that)."
    )


def _machine() -> str:
    return f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}"


def _as_json(rows: Sequence[Row]) -> dict[str, object]:
    """All rows, without NaN, which JSON does not have."""
    finite = [
        {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in row.items()
        }
        for row in rows
    ]
    return {
        "bounds": {"input_relative": INPUT_RELATIVE_MAX, "p_slip": P_SLIP_ERROR_MAX},
        "cases": _cases(finite),
        "steps": _steps(finite),
        "broken": _broken(rows),
        "machine": _machine(),
    }
