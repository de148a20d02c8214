"""`graspd report stability`: numerical errors of the whole chain, against references and bounds."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from importlib.util import find_spec

from graspd.models import zoo
from graspd.models.bts3 import TABLES
from graspd.models.training.commands.common import WrongInputError, say
from graspd.models.training.evaluating.files import markdown_table
from graspd.models.training.reports.machine import described, machine
from graspd.models.training.reports.stability import chain, trust
from graspd.models.training.reports.stability.row import Row

OUTCOMES, QUICK_OUTCOMES = 100_000, 3_000
"""Number of outcomes that the learner takes in, usually and with `--quick`."""
COLUMNS = ("of", "case", "figures", "answers", "bounds")
LEGEND = (
    "compared: readings that the network is asked of; the others are flat.",
    "input: largest error of an input, over the largest magnitude in it.",
    "network: error of `p_slip`, against the network in float64 with the same float32 input.",
    "p_slip: the same from the counts on, with nothing rounded; not bounded for trees.",
    "flips: verdicts that differ from the reference further from the threshold than the bound.",
    "wrong: answers that are not probabilities and have no reason, or spreads off their floor.",
)
WITHOUT_ONNX = (
    "onnx is not installed: networks are not compared with their reference (extra: train)."
)


def run(args: argparse.Namespace) -> int:
    """Measure and print; return 1 if a bound is broken. Raises `WrongInputError`, `ModelError`."""
    names = args.model or zoo.names()
    for name in names:
        zoo.find(name)
    for table in () if args.data is None else TABLES:
        path = args.data / f"{table.name}.csv"
        if not path.is_file():
            raise WrongInputError(f"{path}: no such file; `graspd data` gets it")
    say("report", f"measuring {len(names)} models, some seconds each")
    rows = [row for name in names for row in chain.rows(name, args.data)]
    rows += trust.rows(QUICK_OUTCOMES if args.quick else OUTCOMES)
    sys.stdout.write(f"{_json(rows, quick=args.quick) if args.json else _text(rows)}\n")
    return int(any(row.broken for row in rows))


def _json(rows: Sequence[Row], *, quick: bool) -> str:
    each = [row.to_builtins() for row in rows]
    broken = sum(bool(row.broken) for row in rows)
    return json.dumps({"machine": machine(), "quick": quick, "broken": broken, "rows": each})


def _text(rows: Sequence[Row]) -> str:
    broken = sum(bool(row.broken) for row in rows)
    notes = LEGEND if find_spec("onnx") else (*LEGEND, WITHOUT_ONNX)
    last = f"{broken} of {len(rows)} rows break a bound, on {described(machine())}."
    return "\n".join(
        (*markdown_table(COLUMNS, (row.cells() for row in rows)), "", *notes, "", last)
    )
