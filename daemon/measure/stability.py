"""`graspd report stability`: numerical errors of the whole chain, against references and bounds.
The rows are the test cases in `tests/stability`, which note them for this command."""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from graspd.daemon.process.extras import needs
from graspd.daemon.process.text import (
    complain,
    markdown_table,
    printable,
    progress,
    write_json,
    write_lines,
)
from graspd.models import zoo
from graspd.models.bts3 import TABLES
from graspd.models.contract import ModelError

CHECKOUT = Path(__file__).resolve().parents[2]
CASES = Path("tests/stability")
PACKAGES = ("pytest", "hypothesis", "onnx", "torch")
BROKEN, WRONG = 1, 2
OUTCOMES, QUICK_OUTCOMES = 100_000, 3_000
"""Outcomes that the learner is told."""

Row = dict[str, Any]
CASE_COLUMNS = {
    "model": "model",
    "case": "case",
    "readings": "readings",
    "compared": "compared",
    "input_error": "input error",
    "network_error": "p_slip error",
    "chain_error": "whole chain",
    "mean_error": "mean",
    "flips": "flips",
    "verdicts": "verdicts",
    "reasons": "reasons",
    "bounds": "bounds",
}
"""Titles by key of a row."""
STEP_COLUMNS = {"step": "step", "expected": "expected", "found": "found", "bounds": "bounds"}
NUMBERS = frozenset(list(CASE_COLUMNS.values())[2:9])
LEGEND = (
    "compared: readings that the network is asked of; the others are flat.",
    "input error: of any element of an input, over the largest magnitude in it.",
    "p_slip error: against the network in float64 with the same float32 input.",
    "whole chain: the same from the counts on, with nothing rounded; not bounded for trees.",
)


def run(args: argparse.Namespace) -> int:
    """Measure and print; return 1 if a bound is broken, 2 if something is missing or unknown."""
    problem = _missing(args.model, args.data)
    if problem is not None:
        complain(problem)
        return WRONG
    try:
        rows = _measured(args)
    except (OSError, ElementTree.ParseError) as error:
        complain(error)
        return WRONG
    if not rows:
        return WRONG
    broken = sum(row["bounds"] != "kept" for row in rows)
    if args.json:
        write_json({"rows": rows, "broken": broken, "machine": _machine(), "quick": args.quick})
    else:
        if args.quick:
            write_lines(f"**made with --quick: {QUICK_OUTCOMES:.0e} outcomes**", "")
        write_lines(*map(printable, _markdown(rows)))
        write_lines("", f"{broken} of {len(rows)} rows break a bound. {_machine()}.")
    return BROKEN if broken else 0


def _missing(names: Sequence[str], data: Path | None) -> str | None:
    """Return what is missing: the tests, a package, a model or a table."""
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
    """Run the cases in another process; return their rows, none if they cannot be run."""
    progress(f"running the cases of {CASES}, one to four minutes")
    with tempfile.TemporaryDirectory() as folder:
        results = Path(folder) / "results.xml"
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(CASES)]
        command += [f"--junitxml={results}", "--override-ini=junit_family=xunit1"]
        command.append("--timeout=0")  # a slow machine is no error of the chain
        command.append(f"--outcomes={QUICK_OUTCOMES if args.quick else OUTCOMES}")
        command += [f"--model={name}" for name in args.model]
        if args.data is not None:
            command.append(f"--data={args.data.resolve()}")
        done = subprocess.run(
            command, check=False, cwd=CHECKOUT, capture_output=True, encoding="utf-8"
        )
        progress("")
        if done.returncode not in (0, 1):
            complain((done.stdout + done.stderr).strip() or f"pytest ended with {done.returncode}")
            return []
        return list(_rows(results))


def _rows(results: Path) -> Iterator[Row]:
    """Yield the rows in pytest's JUnit file, with what failed. NaN becomes None."""
    for case in ElementTree.parse(results).iter("testcase"):
        noted = case.find("properties/property[@name='row']")
        failures = [*case.iter("failure"), *case.iter("error")]
        if noted is not None:
            row: Row = json.loads(noted.get("value", "{}"), parse_constant=lambda _name: None)
        elif failures:
            said = failures[0].get("message", "").partition("\n")[0]
            row = {"step": case.get("name", ""), "expected": "a result", "found": said}
        else:
            continue
        problems = "; ".join(row.pop("problems", ()))
        row["bounds"] = f"BROKEN {problems}".rstrip() if failures else "kept"
        yield row


def _markdown(rows: Sequence[Row]) -> Iterator[str]:
    """Yield two tables: each model on each case, and the steps that belong to no model."""
    cases = sorted((row for row in rows if "case" in row), key=lambda row: str(row["model"]))
    steps = [row for row in rows if "case" not in row]
    for columns, chosen in ((CASE_COLUMNS, cases), (STEP_COLUMNS, steps)):
        lines = [[_cell(row[key]) for key in columns] for row in chosen]
        yield from markdown_table(list(columns.values()), lines, right=NUMBERS)
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


def _machine() -> str:
    return f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}"
