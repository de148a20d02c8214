"""`graspd report stability`: numerical errors of the whole chain, against references and bounds.
The rows are the test cases in `tests/stability`, which print them (`tests/stability/rows.py`)."""

from __future__ import annotations

import argparse
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

from graspd.extras import needs
from graspd.models import zoo
from graspd.models.bts3 import TABLES
from graspd.models.training.commands.common import WrongInputError, say

CHECKOUT = Path(__file__).resolve().parents[3]
CASES = Path("tests/stability")
PACKAGES = ("pytest", "hypothesis", "onnx", "torch")
BROKEN, WRONG = 1, 2
OUTCOMES, QUICK_OUTCOMES = 100_000, 3_000
"""Outcomes that the learner is told."""


def run(args: argparse.Namespace) -> int:
    """Measure and print; return 1 if a bound is broken. Raises `WrongInputError`, `ModelError`."""
    _check(args)
    command = [sys.executable, "-m", "pytest", "--override-ini=addopts=", "--import-mode=importlib"]
    command += ["-p", "no:terminal", "-p", "no:cacheprovider"]
    command.append("--timeout=0")  # a slow machine is no error of the chain
    command.append(f"--outcomes={QUICK_OUTCOMES if args.quick else OUTCOMES}")
    command.append(f"--rows={'json' if args.json else 'markdown'}")
    command += [f"--model={name}" for name in args.model]
    if args.data is not None:
        command.append(f"--data={args.data.resolve()}")
    say("report", f"running the cases of {CASES}, one to four minutes")
    done = subprocess.run(
        [*command, str(CASES)], check=False, cwd=CHECKOUT, stdout=subprocess.PIPE, encoding="utf-8"
    )
    sys.stdout.write(done.stdout)
    return done.returncode if done.returncode in (0, BROKEN) else WRONG


def _check(args: argparse.Namespace) -> None:
    """Raise `WrongInputError` or `ModelError` if tests, a package, model or table is missing."""
    if not (CHECKOUT / CASES).is_dir():
        raise WrongInputError(f"stability runs {CASES}: run it in a checkout, not as installed")
    for package in PACKAGES:
        if find_spec(package) is None:
            absent = ModuleNotFoundError(name=package)
            raise WrongInputError(needs("report stability", "train,test", absent))
    for name in args.model:
        zoo.find(name)
    for table in () if args.data is None else TABLES:
        path = args.data / f"{table.name}.csv"
        if not path.is_file():
            raise WrongInputError(f"{path}: no such file; `graspd data` gets it")
