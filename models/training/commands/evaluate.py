"""`graspd evaluate`: run systems through protocols; write figures and RESULTS.md's table."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from graspd.models.training.commands.common import add_shared_arguments, exit_code, whole
from graspd.models.training.data.protocols import ABOUT, PROTOCOLS
from graspd.models.training.evaluating.files import markdown_table
from graspd.models.training.systems.registry import SYSTEMS

OUT = Path("runs/evaluate")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what `run` reads from the command line."""
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"systems (default: all): {', '.join(SYSTEMS)}"
    )
    parser.add_argument(
        "--protocol",
        action="append",
        choices=PROTOCOLS,
        help="may be repeated (default: all, of own tables alone cv and objects). "
        + "; ".join(f"{name}: {text}" for name, text in ABOUT.items()),
    )
    add_shared_arguments(parser)
    for option, text in (
        ("--train", "train on this table, and judge the tables of --test"),
        ("--test", "a table of another day, judged as the daemon does, by --train or --model"),
    ):
        parser.add_argument(
            option, type=Path, action="append", default=[], metavar="FILE", help=text
        )
    parser.add_argument(
        "--model",
        metavar="NAME",
        help="with --test: a model, or an .onnx file, in place of --train",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help=f"folder for results; what is there already is not run again (default: {OUT})",
    )
    parser.add_argument(
        "--seeds", type=whole(1, 1000), metavar="N", help="split seeds (default: 3)"
    )
    parser.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="scheduler of a Dask cluster of two threads or more, tcp://HOST:PORT, to run on "
        "instead (extra: cluster). Its computers share the folder --out. It runs what it is sent: "
        "only in a network that you trust",
    )
    parser.add_argument(
        "--quick", action="store_true", help="few grasps, folds and epochs: does it run?"
    )
    parser.add_argument(
        "--table",
        type=Path,
        metavar="FILE",
        help="write the table of all results in --out beside the paper's; needs --data",
    )
    parser.add_argument(
        "--list",
        action="store_true",
        help="say of each system what it is, which row of the paper it answers, and the command "
        "that makes that row",
    )
    parser.add_argument(
        "--json", action="store_true", help="print figures of each fold, or the list, as JSON"
    )


def run(args: argparse.Namespace) -> int:
    """Evaluate, or print the systems for `--list`; trainings in `--out` are not run again.
    Returns 0, 1 (a worker was lost), 2 (input or folder), 130 (Ctrl-C). Raises `ModelError`."""
    if args.list:
        from graspd.models.training.systems.explained import TITLES, explained

        if args.json:
            rows = [dict(zip(TITLES, row, strict=True)) for row in explained()]
            sys.stdout.write(json.dumps(rows, indent=2) + "\n")
        else:
            sys.stdout.write("\n".join(markdown_table(TITLES, explained())) + "\n")
        return 0
    from graspd.models.training.commands.evaluation import evaluate
    from graspd.models.training.evaluating.frame import LostWorkerError

    folder: Path = args.out or OUT
    if not args.test:
        args.out = folder
    keeps = not args.test
    return exit_code("evaluate", folder, lambda: evaluate(args), LostWorkerError, keeps=keeps)
