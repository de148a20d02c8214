"""`graspd train`: grasp tables in, a model file and its card out."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar

from models.training.card import Card
from models.training.datasets import (
    DatasetError,
    Grasps,
    read_new_session,
    read_whole,
    unpublished,
)
from models.training.export import ExportError
from models.training.making import EXTRA_TRAININGS, Order, make
from models.training.networks import NETWORKS
from models.training.protocols import TooFewGraspsError
from models.training.recipe import Progress, Recipe

EXIT_OK, EXIT_BUG, EXIT_INPUT, EXIT_INTERRUPTED = 0, 1, 2, 130
MAX_SEED = 2**32 - 1
"""The largest that scikit-learn takes."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what `run` reads from the command line."""
    parser.add_argument("model", choices=sorted(NETWORKS), help="network to train")
    parser.add_argument(
        "--data",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder with palm_down.csv and palm_side.csv; palm_45.csv, if there, is judged too",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the result (default: runs/MODEL)"
    )
    parser.add_argument(
        "--seed", type=_whole(0, MAX_SEED), default=0, metavar="N", help="default: 0"
    )
    parser.add_argument(
        "--folds", type=_whole(2, 1000), default=10, metavar="N", help="default: 10"
    )
    parser.add_argument(
        "--epochs", type=_whole(1, 10_000), default=Recipe().epochs, metavar="N", help="default: 20"
    )
    parser.add_argument("--quiet", action="store_true", help="show no progress bar")


def run(args: argparse.Namespace) -> int:
    """Train, measure, export. Returns 0, 1 (export failed), 2 (data or folder), 130 (Ctrl-C)."""
    order = Order(NETWORKS[args.model], Recipe(epochs=args.epochs), args.folds, args.seed)
    out: Path = args.out or Path("runs") / args.model
    started_s = time.monotonic()
    try:
        grasps = read_whole(args.data)
        new_session = read_new_session(args.data)
        _warn_of_other_data(grasps, new_session)
        # Now, not after minutes of training.
        out.mkdir(parents=True, exist_ok=True)
        with _progress_bar(order, hidden=args.quiet) as on_epoch:
            card = make(order, grasps, new_session, out, on_epoch)
    except KeyboardInterrupt:
        sys.stderr.write("graspd train: interrupted\n")
        return EXIT_INTERRUPTED
    except OSError as error:
        return _fail(f"{error.filename or out}: {error.strerror or error}", EXIT_INPUT)
    except (DatasetError, TooFewGraspsError) as error:
        return _fail(str(error), EXIT_INPUT)
    except ExportError as error:
        return _fail(str(error), EXIT_BUG)
    sys.stdout.write(_summary(card, out / f"{args.model}.onnx", time.monotonic() - started_s))
    return EXIT_OK


def _whole(low: int, high: int) -> Callable[[str], int]:
    def parse(text: str) -> int:
        if text.isascii() and text.isdigit() and len(text) <= 10 and low <= int(text) <= high:
            return int(text)
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {low} to {high}")

    return parse


def _warn_of_other_data(grasps: Grasps, new_session: Grasps | None) -> None:
    files = grasps.files if new_session is None else grasps.files + new_session.files
    for name in unpublished(files):
        sys.stderr.write(
            f"graspd train: warning: {name}.csv is not the published table; the figures are of "
            "this data only\n"
        )


@contextmanager
def _progress_bar(order: Order, *, hidden: bool) -> Iterator[Progress]:
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("epochs, left"),
        TimeRemainingColumn(),
    )
    trainings = order.folds + EXTRA_TRAININGS
    with ProgressBar(
        *columns, console=console, disable=hidden or not console.is_terminal, transient=True
    ) as bar:
        task = bar.add_task(f"training 1 of {trainings}", total=order.epochs)
        done = 0

        def on_epoch() -> None:
            nonlocal done
            done += 1
            training = min(done // order.recipe.epochs + 1, trainings)
            bar.update(task, completed=done, description=f"training {training} of {trainings}")

        yield on_epoch


def _summary(card: Card, path: Path, seconds: float) -> str:
    measured = card.contract.measured
    return (
        f"{path}: F1 {100 * measured.f1_mean:.1f} +- {100 * measured.f1_std:.1f} % over "
        f"{measured.folds} folds, accuracy {100 * measured.accuracy_mean:.1f} %, "
        f"{seconds:.0f} s\n"
    )


def _fail(problem: str, code: int) -> int:
    sys.stderr.write(f"graspd train: {problem}\n")
    return code
