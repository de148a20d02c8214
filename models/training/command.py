"""`graspd train`: grasp tables in, a model file and its card out."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from models.training.arguments import progress_bar, whole
from models.training.card import Card
from models.training.datasets import DatasetError, Grasps, read_all, unpublished
from models.training.export import ExportError
from models.training.folds import TooFewGraspsError
from models.training.making import EXTRA_TRAININGS, Order, make
from models.training.systems import SYSTEMS

EXIT_OK, EXIT_BUG, EXIT_INPUT, EXIT_INTERRUPTED = 0, 1, 2, 130
MAX_SEED = 2**32 - 1
"""The largest that scikit-learn takes."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what `run` reads from the command line."""
    parser.add_argument("model", choices=sorted(SYSTEMS), metavar="MODEL", help=_models())
    parser.add_argument(
        "--data",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder with palm_down.csv, palm_side.csv and, for some models, palm_45.csv",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the result (default: runs/MODEL)"
    )
    parser.add_argument(
        "--results",
        type=Path,
        metavar="DIR",
        help="folder of finished trainings, which are not run again; `graspd evaluate` shares it "
        "(default: trainings in --out)",
    )
    parser.add_argument(
        "--seed", type=whole(0, MAX_SEED), default=0, metavar="N", help="default: 0"
    )
    parser.add_argument("--folds", type=whole(2, 1000), default=10, metavar="N", help="default: 10")
    parser.add_argument(
        "--only",
        choices=("cv", "objects", "objects-whole"),
        metavar="PROTOCOL",
        help="measure by this one protocol and leave the other studies out: for a model that is "
        "compared and not used",
    )
    parser.add_argument(
        "--jobs", type=whole(1, 256), default=1, metavar="N", help="trainings at once (default: 1)"
    )
    parser.add_argument("--quiet", action="store_true", help="show no progress bar")


def run(args: argparse.Namespace) -> int:
    """Train, measure, export. Returns 0, 1 (export failed), 2 (data or folder), 130 (Ctrl-C)."""
    order = Order(SYSTEMS[args.model], args.folds, args.seed, args.jobs, args.only)
    out: Path = args.out or Path("runs") / args.model
    started_s = time.monotonic()
    try:
        grasps = read_all(args.data)
        _check_tables(order, grasps, args.data)
        # Now, not after minutes of training.
        out.mkdir(parents=True, exist_ok=True)
        results = args.results or out / "trainings"
        total = len(order.jobs(grasps)) + EXTRA_TRAININGS
        with progress_bar(args.model, total, hidden=args.quiet) as on_job:
            card = make(order, grasps, out, results, lambda: on_job(args.model))
    except KeyboardInterrupt:
        sys.stderr.write("graspd train: interrupted; the same command goes on from here\n")
        return EXIT_INTERRUPTED
    except OSError as error:
        return _fail(f"{error.filename or out}: {error.strerror or error}", EXIT_INPUT)
    except (DatasetError, TooFewGraspsError) as error:
        return _fail(str(error), EXIT_INPUT)
    except ExportError as error:
        return _fail(str(error), EXIT_BUG)
    sys.stdout.write(_summary(card, out / f"{args.model}.onnx", time.monotonic() - started_s))
    return EXIT_OK


def _models() -> str:
    return f"one of {', '.join(SYSTEMS)}"


def _check_tables(order: Order, grasps: Grasps, folder: Path) -> None:
    """Raise `DatasetError` if a table is missing; warn of tables that are not the published."""
    there = {file.name for file in grasps.files}
    for table in order.system.tables:
        if table not in there:
            raise DatasetError(folder / f"{table}.csv", f"is missing, {order.system.name} needs it")
    for name in unpublished(grasps.files):
        sys.stderr.write(
            f"graspd train: warning: {name}.csv is not the published table; the figures are of "
            "this data only\n"
        )


def _summary(card: Card, path: Path, seconds: float) -> str:
    figures = ", ".join(
        f"{measured.protocol} F1 {100 * measured.f1_mean:.1f} +- {100 * measured.f1_std:.1f} %"
        for measured in card.contract.measured
    )
    return f"{path}: {figures}, {seconds:.0f} s\n"


def _fail(problem: str, code: int) -> int:
    sys.stderr.write(f"graspd train: {problem}\n")
    return code
