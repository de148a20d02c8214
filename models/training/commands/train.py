"""`graspd train`: grasp tables in, a model file and its card out."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from graspd.models import zoo
from graspd.models.training.commands.common import (
    WrongInputError,
    add_shared_arguments,
    check_fingers,
    exit_code,
    progress_bar,
    read_grasps,
    say,
    whole,
)
from graspd.models.training.data.datasets import DatasetError, lab_table_names
from graspd.models.training.data.protocols import FOLDS, TooFewGraspsError
from graspd.models.training.systems.registry import SYSTEMS

if TYPE_CHECKING:
    from graspd.models.training.making.plan import TrainingPlan

MAX_SEED = 2**32 - 1
"""Largest seed that scikit-learn takes."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what `run` reads from the command line."""
    parser.add_argument(
        "model", choices=sorted(SYSTEMS), metavar="MODEL", help=f"one of {', '.join(SYSTEMS)}"
    )
    add_shared_arguments(parser)
    parser.add_argument(
        "--name",
        type=_name,
        metavar="NAME",
        help="name of the result (default: MODEL, with --own and the names of these tables)",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the result (default: runs/NAME)"
    )
    parser.add_argument(
        "--seed", type=whole(0, MAX_SEED), default=0, metavar="N", help="default: 0"
    )
    parser.add_argument(
        "--folds",
        type=whole(2, 1000),
        metavar="N",
        help="needs as many objects, and as many grasps that slipped and that stayed (default: 10, "
        "or as many as these are enough for)",
    )
    parser.add_argument(
        "--only",
        choices=("cv", "objects", "objects-whole"),
        metavar="PROTOCOL",
        help="measure by this one protocol (cv: known objects; objects: others, which cannot be "
        "measured of a single one) and leave the other studies out: for a model that is compared "
        "and not used",
    )


def run(args: argparse.Namespace) -> int:
    """Train, measure, export.
    Returns 0, 1 (export failed, process lost), 2 (data or folder), 130 (Ctrl-C)."""
    from graspd.models.training.evaluating.frame import LostWorkerError
    from graspd.models.training.making.export import ExportError

    folder: Path = args.out or Path("runs")
    return exit_code("train", folder, lambda: _train(args), ExportError, LostWorkerError)


def _train(args: argparse.Namespace) -> None:
    from graspd.models.training.making.make_model import EXTRA_TRAININGS, make_model
    from graspd.models.training.making.plan import limits, preflight, with_enough_folds

    started_s = time.monotonic()
    grasps = read_grasps("train", args)
    plan = _plan(args, lab_table_names(grasps.files))
    out: Path = args.out or Path("runs") / plan.model
    if args.own and plan.model in zoo.names():
        raise WrongInputError(f"graspd ships a model {plan.model!r}: choose another --name")
    check_fingers([plan.system], grasps)
    if args.data is not None:
        there = {file.name for file in grasps.files}
        for table in plan.system.tables:
            if table not in there:
                path = args.data / f"{table}.csv"
                raise DatasetError(path, f"is missing, {plan.system.name} needs it")
    for sentence in limits(plan, grasps):
        say("train", f"warning: {sentence}")
    try:
        if args.folds is None:
            plan, why = with_enough_folds(plan, grasps)
            if why:
                say("train", f"takes {plan.folds} folds: {why}")
        else:
            preflight(plan, grasps)
        # Fail now, not after minutes of training.
        out.mkdir(parents=True, exist_ok=True)
        total = len(plan.jobs(grasps)) + EXTRA_TRAININGS
        with progress_bar(args.model, total, hidden=args.quiet) as on_job:
            contract = make_model(plan, grasps, out, lambda: on_job(args.model))
    except TooFewGraspsError as error:
        raise WrongInputError(f"{error} (see --folds and --only)") from error
    seconds, file = time.monotonic() - started_s, out / f"{plan.model}.onnx"
    figures = ", ".join(
        f"{measured.protocol} F1 {100 * measured.f1_mean:.1f} +- {100 * measured.f1_std:.1f} %"
        for measured in contract.measured
    )
    sys.stdout.write(f"{file}: {figures}, {seconds:.0f} s\n")
    if plan.lab_files or plan.name:
        say("train", f"for a scene, below [model]: path = {json.dumps(str(file.absolute()))}")


def _plan(args: argparse.Namespace, lab: tuple[str, ...]) -> TrainingPlan:
    """Return the plan of the command line; `lab`: names of the tables that are not published."""
    from graspd.models.training.making.plan import TrainingPlan

    system = SYSTEMS[args.model]
    if lab:
        published = () if args.data is None else system.tables
        system = dataclasses.replace(system, tables=(*published, *lab))
    files = tuple(path.name for path in args.own)
    folds = args.folds or FOLDS
    jobs = args.jobs or 1
    return TrainingPlan(system, folds, args.seed, jobs, args.only, files, args.name, args.read_as)


def _name(text: str) -> str:
    if text in zoo.names():
        raise argparse.ArgumentTypeError(f"graspd ships a model {text!r}: choose another name")
    if not zoo.is_name(text):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a name: up to {zoo.NAME_MAX} letters, digits, '.', '_' and '-'"
        )
    return text
