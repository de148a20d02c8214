"""`graspd report stability`: numerical errors of the whole chain, against references and bounds.
The rows are the test cases in `tests/stability`, which print them (`tests/stability/rows.py`)."""

from __future__ import annotations

import argparse
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

from graspd.daemon.process.text import complain, progress
from graspd.extras import needs
from graspd.models import zoo
from graspd.models.bts3 import TABLES
from graspd.models.contract import ModelError

CHECKOUT = Path(__file__).resolve().parents[2]
CASES = Path("tests/stability")
PACKAGES = ("pytest", "hypothesis", "onnx", "torch")
BROKEN, WRONG = 1, 2
OUTCOMES, QUICK_OUTCOMES = 100_000, 3_000
"""Outcomes that the learner is told."""


def run(args: argparse.Namespace) -> int:
    """Measure and print; return 1 if a bound is broken, 2 if something is missing or unknown."""
    problem = _missing(args)
    if problem is not None:
        complain(problem)
        return WRONG
    command = [sys.executable, "-m", "pytest", "--override-ini=addopts=", "--import-mode=importlib"]
    command += ["-p", "no:terminal", "-p", "no:cacheprovider"]
    command.append("--timeout=0")  # a slow machine is no error of the chain
    command.append(f"--outcomes={QUICK_OUTCOMES if args.quick else OUTCOMES}")
    command.append(f"--rows={'json' if args.json else 'markdown'}")
    command += [f"--model={name}" for name in args.model]
    if args.data is not None:
        command.append(f"--data={args.data.resolve()}")
    progress(f"running the cases of {CASES}, one to four minutes")
    done = subprocess.run(
        [*command, str(CASES)], check=False, cwd=CHECKOUT, stdout=subprocess.PIPE, encoding="utf-8"
    )
    progress("")
    sys.stdout.write(done.stdout)
    return done.returncode if done.returncode in (0, BROKEN) else WRONG


def _missing(args: argparse.Namespace) -> str | None:
    """Return what is missing: the tests, a package, a model or a table."""
    if not (CHECKOUT / CASES).is_dir():
        return f"report stability runs {CASES}: run it in a checkout of graspd, not as installed"
    for package in PACKAGES:
        if find_spec(package) is None:
            absent = ModuleNotFoundError(name=package)
            return needs("report stability", "train,test", absent)
    try:
        for name in args.model:
            zoo.find(name)
    except ModelError as error:
        return str(error)
    tables = [] if args.data is None else [args.data / f"{table.name}.csv" for table in TABLES]
    absent_tables = [path for path in tables if not path.is_file()]
    return f"{absent_tables[0]}: no such file; `graspd data` gets it" if absent_tables else None
