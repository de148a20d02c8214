"""What `graspd evaluate` does once its command line is read."""

from __future__ import annotations

import argparse
import difflib
import sys
import time
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from itertools import product

from models.training.commands.arguments import (
    SEEDS,
    WrongInputError,
    warn_of_unpublished,
)
from models.training.commands.progress import progress_bar
from models.training.data.datasets import read_all, unpublished
from models.training.data.protocols import STANDARD, EvalProtocol
from models.training.evaluating.campaign import Campaign, campaign, quickened
from models.training.evaluating.files import to_json, write_whole
from models.training.evaluating.grid import best_of_grid, grid_of
from models.training.evaluating.results_table import Made, results_table
from models.training.evaluating.summaries import Summary, made_with, read_summaries
from models.training.systems.registry import SYSTEMS
from models.training.systems.system import System, digest


def evaluate(args: argparse.Namespace) -> None:
    """Evaluate; raises what `exit_code` knows."""
    started_s = time.monotonic()
    systems = _systems(args.names, args.grid)
    _check_extras(args)
    protocols = list(dict.fromkeys(args.protocol or STANDARD))
    grasps = read_all(args.data)
    warn_of_unpublished("evaluate", unpublished(grasps.files))
    wanted = campaign(
        [variant for system in systems for variant in grid_of(system)] if args.grid else systems,
        protocols,
        grasps,
        seeds=args.seeds or (1 if args.quick else SEEDS),
        quick=args.quick,
    )
    summaries = _evaluate(wanted, args)
    if args.json:
        sys.stdout.buffer.write(to_json(summaries))
    if args.grid:
        _report_grid(systems, protocols, summaries, args)
    if args.table or args.plots:
        _report(wanted.data, args, time.monotonic() - started_s)


def _evaluate(wanted: Campaign, args: argparse.Namespace) -> list[Summary]:
    shown = not (args.json or args.grid)

    def on_summary(summary: Summary) -> None:
        if shown:
            sys.stdout.write(_line(summary))
            sys.stdout.flush()

    with progress_bar("starting", len(wanted.jobs), hidden=args.quiet) as on_job:
        return wanted.run(
            args.out,
            processes=args.jobs,
            dask=args.dask,
            on_job=on_job,
            on_summary=on_summary,
            keep=not args.grid,
        )


def _line(summary: Summary) -> str:
    f1, accuracy = (summary.main.spreads[name] for name in ("f1", "accuracy"))
    error = "" if f1.error is None else f", s.e. {100 * f1.error:.2f} over {f1.seeds} seeds"
    return (
        f"{summary.system} {summary.protocol} ({summary.headline}): "
        f"F1 {100 * f1.mean:.1f} +- {100 * f1.std:.1f} %{error}; "
        f"accuracy {100 * accuracy.mean:.1f} %, {summary.seconds:.0f} s\n"
    )


def _systems(names: Sequence[str], grid: bool) -> list[System]:
    unknown = [name for name in names if name not in SYSTEMS]
    if unknown:
        near = difflib.get_close_matches(unknown[0], SYSTEMS, n=1)
        meant = f"; did you mean {near[0]}?" if near else ""
        raise WrongInputError(f"no system {unknown[0]!r}: there are {', '.join(SYSTEMS)}{meant}")
    systems = [SYSTEMS[name] for name in dict.fromkeys(names)] or list(SYSTEMS.values())
    if not grid:
        return systems
    with_grid = [system for system in systems if grid_of(system)]
    if not with_grid:
        raise WrongInputError("none of these systems has a grid")
    return with_grid


def _check_extras(args: argparse.Namespace) -> None:
    """Now, not after hours of training."""
    for wanted, package, extra in (
        (args.dask, "distributed", "cluster"),
        (args.plots, "matplotlib", "report"),
    ):
        if wanted and find_spec(package) is None:
            raise WrongInputError(f"needs the package '{package}': pip install '.[{extra}]'")


def _report(data: str, args: argparse.Namespace, seconds: float) -> None:
    """Table and plots of all that is in the folder of this data (a digest)."""
    digests = {
        name: digest(quickened(system) if args.quick else system)
        for name, system in SYSTEMS.items()
    }
    summaries = read_summaries(args.out, data, digests)
    if args.table:
        command = "graspd " + " ".join(_command(args))
        made = Made(command, seconds, made_with(), quick=args.quick)
        args.table.parent.mkdir(parents=True, exist_ok=True)
        write_whole(args.table, results_table(summaries, made).encode())
    if args.plots:
        from models.training.evaluating.plots import draw

        draw(summaries, args.plots)


def _command(args: argparse.Namespace) -> Iterator[str]:
    """The command line without the folders of this machine."""
    yield "evaluate"
    yield from args.names
    for protocol in args.protocol or ():
        yield f"--protocol {protocol}"
    yield "--data DIR --out DIR"
    if args.seeds:
        yield f"--seeds {args.seeds}"
    if args.quick:
        yield "--quick"
    if args.jobs > 1:
        yield f"--jobs {args.jobs}"
    if args.dask:
        yield "--dask ADDRESS"
    yield "--table FILE"


def _report_grid(
    systems: Sequence[System],
    protocols: Sequence[EvalProtocol],
    summaries: Sequence[Summary],
    args: argparse.Namespace,
) -> None:
    for system, protocol in product(systems, protocols):
        report = best_of_grid(system, protocol, summaries)
        write_whole(args.out / f"{system.name}.{protocol}.grid.json", to_json(report))
        if not args.json:
            best = report[0]
            sys.stdout.write(
                f"{best.name} {protocol}: best of {len(report)}, F1 {100 * best.f1.mean:.2f} "
                f"+- {100 * best.f1.std:.1f} %\n"
            )
