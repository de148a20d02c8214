"""Run `graspd evaluate` after its command line is read."""

from __future__ import annotations

import argparse
import difflib
import itertools
import shlex
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager

import joblib
import numpy as np
import pandas as pd

from graspd.extras import needs
from graspd.models.runtime import one_line
from graspd.models.training.commands.common import (
    WrongInputError,
    check_fingers,
    progress_bar,
    read_grasps,
    say,
)
from graspd.models.training.commands.other_day import judge_other_days
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.data.protocols import FOLDS, PROTOCOLS, EvalProtocol
from graspd.models.training.evaluating.figures import (
    Figures,
    made_with,
    read,
    with_probability,
    write,
)
from graspd.models.training.evaluating.files import write_whole
from graspd.models.training.evaluating.frame import (
    Job,
    LostWorkerError,
    evaluated,
    jobs_of,
    processes,
)
from graspd.models.training.evaluating.results_table import results_table
from graspd.models.training.making.plan import TrainingPlan, with_enough_folds
from graspd.models.training.systems.explained import quick_seconds
from graspd.models.training.systems.registry import (
    SYSTEMS,
    System,
    digest,
    with_recipes,
)

SEEDS = 3
"""Number of split seeds of an evaluation unless `--seeds` says otherwise."""
QUICK_GRASPS, QUICK_FOLDS, QUICK_EPOCHS = 200, 2, 1
"""Grasps (as many of each table), folds and epochs of `--quick`, which only tests that all runs;
figures mean nothing."""

CONNECT_TIMEOUT_S = 10
VERDICTS = "verdicts"
"""Folder in `--out` with a Parquet file of verdicts for each system and protocol."""


def evaluate(args: argparse.Namespace) -> None:
    """Evaluate as the command line says. Raises what `exit_code` handles, and `ModelError`."""
    systems = _systems(args.names)
    if args.train or args.test or args.model:
        epochs = QUICK_EPOCHS if args.quick else None
        judge_other_days(args, systems if args.names else (), epochs)
        return
    if args.table and args.data is None:
        raise WrongInputError("--table compares with the paper's figures: it needs --data")
    if args.dask and args.jobs:
        raise WrongInputError("--jobs is of this machine: it does not go with --dask")
    grasps = read_grasps("evaluate", args)
    check_fingers(systems, grasps)
    if args.quick:
        systems = [with_recipes(system, epochs=QUICK_EPOCHS) for system in systems]
        random, tables = np.random.default_rng(0), range(len(grasps.files))
        each = -(-QUICK_GRASPS // len(tables))
        rows = [np.flatnonzero(grasps.table_of == table) for table in tables]
        chosen = np.concatenate([random.permutation(some)[:each] for some in rows])
        grasps = grasps.rows(np.sort(chosen))
    protocols = _protocols(args, grasps)
    folds = QUICK_FOLDS if args.quick else FOLDS
    if args.own:
        folds = _enough_folds(systems, protocols, folds, grasps, _seeds(args))
    with _cluster(args.dask) if args.dask else processes(args.jobs or 1):
        made = _evaluated(systems, protocols, folds, grasps, args)
    if args.json:
        scores = pd.concat(
            one.scores.assign(system=one.system, protocol=one.protocol) for one in made
        )
        sys.stdout.write(scores.reset_index().to_json(orient="records", indent=2) + "\n")
    if args.table:
        _report(grasps, args)


@contextmanager
def _cluster(address: str) -> Iterator[None]:
    """Run trainings on the cluster of the Dask scheduler at this address, within the block.
    Raises `WrongInputError` without extra or scheduler, `LostWorkerError` for a lost training."""
    try:
        from distributed import Client, KilledWorker
    except ModuleNotFoundError as error:
        raise WrongInputError(needs("--dask", "cluster", error)) from error
    try:
        client = Client(address, timeout=CONNECT_TIMEOUT_S)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise WrongInputError(f"no Dask scheduler at {address}: {one_line(error)}") from error
    try:
        with client, joblib.parallel_config("dask"):
            yield
    except (KilledWorker, CancelledError) as error:
        raise LostWorkerError(f"the cluster lost a training: {one_line(error)}") from error


def _systems(names: Sequence[str]) -> list[System]:
    unknown = [name for name in names if name not in SYSTEMS]
    if unknown:
        near = difflib.get_close_matches(unknown[0], SYSTEMS, n=1)
        meant = f"; did you mean {near[0]}?" if near else ""
        raise WrongInputError(f"no system {unknown[0]!r}: there are {', '.join(SYSTEMS)}{meant}")
    return [SYSTEMS[name] for name in dict.fromkeys(names)] or list(SYSTEMS.values())


def _protocols(args: argparse.Namespace, grasps: Grasps) -> list[EvalProtocol]:
    """Return the requested protocols; by default all, or of own tables alone `cv` and, of several
    objects, `objects`."""
    if args.protocol or args.data is not None:
        return list(dict.fromkeys(args.protocol or PROTOCOLS))
    if len(set(grasps.objects)) > 1:
        return ["cv", "objects"]
    say("evaluate", "all grasps are of one object: measured by cv, of known objects, alone")
    return ["cv"]


def _seeds(args: argparse.Namespace) -> range:
    return range(args.seeds or (1 if args.quick else SEEDS))


def _enough_folds(
    systems: Sequence[System],
    protocols: Sequence[EvalProtocol],
    folds: int,
    grasps: Grasps,
    seeds: range,
) -> int:
    """Return the largest number of folds, up to `folds`, for which the user's grasps are enough.
    Raises `TooFewGraspsError` if they are enough for none."""
    for system, protocol, seed in itertools.product(systems, protocols, seeds):
        plan, why = with_enough_folds(TrainingPlan(system, folds, seed, only=protocol), grasps)
        if why:
            say("evaluate", f"takes {plan.folds} folds: {why}")
        folds = plan.folds
    return folds


def _evaluated(
    systems: Sequence[System],
    protocols: Sequence[EvalProtocol],
    folds: int,
    grasps: Grasps,
    args: argparse.Namespace,
) -> list[Figures]:
    """Run all jobs; return the figures of each system in each protocol. Their rows are written, and
    the figures printed, once all their jobs are done."""
    groups = {
        (system.name, protocol): jobs_of(system, protocol, grasps, _seeds(args), folds)
        for system in systems
        for protocol in protocols
    }
    wanted = [job for group in groups.values() for job in group]
    if args.quick:
        _announce(wanted, "on the cluster" if args.dask else f"{args.jobs or 1} at once")
    found: dict[Job, pd.DataFrame] = {}
    made: dict[tuple[str, str], Figures] = {}
    with progress_bar("starting", len(wanted), hidden=args.quiet) as on_job:
        for job, rows in evaluated(wanted, grasps, args.out / "jobs"):
            found[job] = rows
            on_job(f"{job.system.name} {job.protocol}")
            key = (job.system.name, job.protocol)
            if all(each in found for each in groups[key]):
                parts = [found.pop(each) for each in groups[key]]
                made[key] = Figures.of(with_probability(pd.concat(parts, ignore_index=True)))
                _show(made[key], args)
    return [made[key] for key in groups]


def _announce(wanted: Sequence[Job], how: str) -> None:
    """Print the number of quick trainings, and their rough time by protocol and by system."""
    jobs = [(job.protocol, job.system.name, quick_seconds(job.system)) for job in wanted]
    took = pd.DataFrame(jobs, columns=["protocol", "system", "seconds"])
    total = f"about {took['seconds'].sum():.0f} s of processor time"
    say("evaluate", f"{len(wanted)} trainings, {how}: {total}, less what is kept")
    for which in ("protocol", "system"):
        sums = took.groupby(which, sort=False)["seconds"].sum()
        say("evaluate", ", ".join(f"{name} {seconds:.0f} s" for name, seconds in sums.items()))


def _show(one: Figures, args: argparse.Namespace) -> None:
    write(one, args.out / VERDICTS)
    if args.json:
        return
    f1, accuracy = one.spread("f1"), one.spread("accuracy")
    error = "" if f1.error is None else f", s.e. {100 * f1.error:.2f} over {f1.seeds} seeds"
    sys.stdout.write(
        f"{one.system} {one.protocol} ({one.headline}): "
        f"F1 {100 * f1.mean:.1f} +- {100 * f1.std:.1f} %{error}; "
        f"accuracy {100 * accuracy.mean:.1f} %, {one.trainings['seconds'].sum():.0f} s\n"
    )
    sys.stdout.flush()


def _report(grasps: Grasps, args: argparse.Namespace) -> None:
    """Write the results page to `--table`, from all results in `--out` that are of these grasps."""
    digests = {
        name: digest(with_recipes(system, epochs=QUICK_EPOCHS) if args.quick else system)
        for name, system in SYSTEMS.items()
    }
    several = read(args.out / VERDICTS, grasps.digest(), digests)
    command = "graspd " + " ".join(_command(args))
    text = results_table(several, grasps, command, made_with(), quick=args.quick)
    args.table.parent.mkdir(parents=True, exist_ok=True)
    write_whole(args.table, text.encode())


def _command(args: argparse.Namespace) -> Iterator[str]:
    """Yield the words of the command line, without folders of this computer."""
    yield "evaluate"
    yield from args.names
    for protocol in args.protocol or ():
        yield f"--protocol {protocol}"
    if args.data is not None:
        yield "--data DIR"
    for path in args.own:
        yield f"--own {shlex.quote(path.name)}"
    if args.read_as:
        yield f"--as {args.read_as}"
    yield "--out DIR"
    if args.seeds:
        yield f"--seeds {args.seeds}"
    if args.quick:
        yield "--quick"
    if args.jobs:
        yield f"--jobs {args.jobs}"
    if args.dask:
        yield "--dask ADDRESS"
    yield "--table FILE"
