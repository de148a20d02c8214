"""`graspd train`: grasp tables in, a model file and its card out."""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from pathlib import Path

from models.training.commands.arguments import progress_bar, whole
from models.training.data.datasets import DatasetError, Grasps, own_tables, unpublished
from models.training.data.folds import TooFewGraspsError
from models.training.data.own import ENOUGH_GRASPS, FEWEST_GRASPS, read_with_own
from models.training.making.card import Card
from models.training.making.enough import check_enough
from models.training.making.export import ExportError
from models.training.making.making import EXTRA_TRAININGS, Order, make
from models.training.systems.systems import SYSTEMS

EXIT_OK, EXIT_BUG, EXIT_INPUT, EXIT_INTERRUPTED = 0, 1, 2, 130
MAX_SEED = 2**32 - 1
"""The largest that scikit-learn takes."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what `run` reads from the command line."""
    parser.add_argument("model", choices=sorted(SYSTEMS), metavar="MODEL", help=_models())
    parser.add_argument(
        "--data",
        type=Path,
        metavar="DIR",
        help="folder with palm_down.csv, palm_side.csv and, for some models, palm_45.csv",
    )
    parser.add_argument(
        "--own",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="a grasp table of your own, as `graspd export-grasps` writes it, that is one session: "
        f"{FEWEST_GRASPS} grasps or more, some that slipped and some that stayed. May be given "
        "several times. Beside the tables of --data, or, without --data, alone",
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
    parser.add_argument(
        "--folds",
        type=whole(2, 1000),
        default=10,
        metavar="N",
        help="default: 10. Needs as many objects, and as many grasps that slipped and that stayed",
    )
    parser.add_argument(
        "--only",
        choices=("cv", "objects", "objects-whole"),
        metavar="PROTOCOL",
        help="measure by this one protocol (cv: known objects; objects: others, which cannot be "
        "measured of a single one) and leave the other studies out: for a model that is compared "
        "and not used",
    )
    parser.add_argument(
        "--jobs", type=whole(1, 256), default=1, metavar="N", help="trainings at once (default: 1)"
    )
    parser.add_argument("--quiet", action="store_true", help="show no progress bar")


def run(args: argparse.Namespace) -> int:
    """Train, measure, export. Returns 0, 1 (export failed), 2 (data or folder), 130 (Ctrl-C)."""
    if args.data is None and not args.own:
        return _fail("needs --data DIR, --own FILE, or both", EXIT_INPUT)
    out: Path = args.out or Path("runs") / args.model
    started_s = time.monotonic()
    try:
        grasps = read_with_own(args.data, args.own)
        order = _order(args, grasps)
        if args.data is not None:
            _check_published(order, grasps, args.data)
        elif len(grasps) < ENOUGH_GRASPS:
            sys.stderr.write(_few(len(grasps)))
        check_enough(order, grasps)
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
    except DatasetError as error:
        return _fail(str(error), EXIT_INPUT)
    except TooFewGraspsError as error:
        return _fail(f"{error} (see --folds and --only)", EXIT_INPUT)
    except ExportError as error:
        return _fail(str(error), EXIT_BUG)
    sys.stdout.write(_summary(card, out / f"{args.model}.onnx", time.monotonic() - started_s))
    return EXIT_OK


def _models() -> str:
    return f"one of {', '.join(SYSTEMS)}"


def _order(args: argparse.Namespace, grasps: Grasps) -> Order:
    system, own = SYSTEMS[args.model], own_tables(grasps.files)
    if own:
        published = () if args.data is None else system.tables
        system = dataclasses.replace(system, tables=(*published, *own))
    names = tuple(path.name for path in args.own)
    return Order(system, args.folds, args.seed, args.jobs, args.only, names)


def _check_published(order: Order, grasps: Grasps, folder: Path) -> None:
    """Raise `DatasetError` if a table is missing; warn of tables that are not the published."""
    there, own = {file.name for file in grasps.files}, own_tables(grasps.files)
    for table in order.system.tables:
        if table not in there:
            raise DatasetError(folder / f"{table}.csv", f"is missing, {order.system.name} needs it")
    for name in unpublished(grasps.files):
        if name not in own:
            sys.stderr.write(
                f"graspd train: warning: {name}.csv is not the published table; the figures are of "
                "this data only\n"
            )


def _few(grasps: int) -> str:
    return (
        f"graspd train: warning: {grasps} grasps are few: the daemon will take many others for "
        f"unlike the training, and call them unknown; {ENOUGH_GRASPS} are enough\n"
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
