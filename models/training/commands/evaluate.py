"""`graspd evaluate`: systems through protocols, figures and the reproduction table out."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

from models.training.commands.arguments import progress_bar, whole
from models.training.data.datasets import DatasetError, read_all, unpublished
from models.training.data.folds import TooFewGraspsError
from models.training.data.protocols import ABOUT, PROTOCOLS, STANDARD
from models.training.evaluating.campaign import Campaign, campaign, quickened
from models.training.evaluating.grid import best_of_grid, grid_of
from models.training.evaluating.results import Made, table
from models.training.evaluating.summary import Summary, made_with, read_all_of, to_json
from models.training.evaluating.sweep import ClusterError
from models.training.systems.system import System, digest
from models.training.systems.systems import SYSTEMS

EXIT_OK, EXIT_FAILED, EXIT_INPUT, EXIT_INTERRUPTED = 0, 1, 2, 130
SEEDS = 3
MAX_PROCESSES = 1024


class WrongInputError(Exception):
    """The command line asks for what is not there."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what `run` reads from the command line."""
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"systems (default: all): {', '.join(SYSTEMS)}"
    )
    parser.add_argument(
        "--protocol",
        action="append",
        choices=PROTOCOLS,
        help="may be repeated (default: the first five). "
        + "; ".join(f"{name}: {text}" for name, text in ABOUT.items()),
    )
    parser.add_argument(
        "--data", type=Path, required=True, metavar="DIR", help="folder with the grasp tables"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs/evaluate"),
        metavar="DIR",
        help="folder for results; what is there already is not run again (default: runs/evaluate)",
    )
    parser.add_argument(
        "--seeds", type=whole(1, 1000), metavar="N", help=f"split seeds (default: {SEEDS})"
    )
    parser.add_argument(
        "--jobs",
        type=whole(1, MAX_PROCESSES),
        default=1,
        metavar="N",
        help="processes on this machine (default: 1)",
    )
    parser.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="scheduler of a Dask cluster, tcp://HOST:PORT, to run on instead (extra: cluster); "
        "it runs what it is sent: only in a network that you trust",
    )
    parser.add_argument(
        "--quick", action="store_true", help="few grasps, folds and epochs: does it run?"
    )
    parser.add_argument(
        "--grid", action="store_true", help="try the grids of classical systems and name the best"
    )
    parser.add_argument(
        "--table", type=Path, metavar="FILE", help="write the table of all results in --out"
    )
    parser.add_argument("--plots", type=Path, metavar="DIR", help="draw them into this folder")
    parser.add_argument("--json", action="store_true", help="print the summaries as JSON")
    parser.add_argument("--quiet", action="store_true", help="show no progress bar")


def run(args: argparse.Namespace) -> int:
    """Evaluate. Returns 0, 1 (the cluster failed), 2 (input or folder), 130 (Ctrl-C).

    Whatever was finished by then is kept and not run again.
    """
    try:
        return _run(args)
    except KeyboardInterrupt:
        sys.stderr.write("graspd evaluate: interrupted; the same command goes on from here\n")
        return EXIT_INTERRUPTED
    except OSError as error:
        return _fail(f"{error.filename or args.out}: {error.strerror or error}", EXIT_INPUT)
    except (DatasetError, TooFewGraspsError, WrongInputError) as error:
        return _fail(str(error), EXIT_INPUT)
    except ClusterError as error:
        return _fail(str(error), EXIT_FAILED)


def _run(args: argparse.Namespace) -> int:
    started_s = time.monotonic()
    systems = _systems(args.names, args.grid)
    _check_extras(args)
    grasps = read_all(args.data)
    for name in unpublished(grasps.files):
        sys.stderr.write(
            f"graspd evaluate: warning: {name}.csv is not the published table; the figures are of "
            "this data only\n"
        )
    wanted = campaign(
        [variant for system in systems for variant in grid_of(system)] if args.grid else systems,
        args.protocol or list(STANDARD),
        grasps,
        seeds=args.seeds or (1 if args.quick else SEEDS),
        quick=args.quick,
    )
    summaries = _evaluate(wanted, args)
    if args.json:
        sys.stdout.buffer.write(to_json(summaries))
    if args.grid:
        _report_grid(systems, summaries, args)
    if args.table or args.plots:
        everything = read_all_of(args.out, wanted.data, _digests(args.quick))
        _report(everything, args, time.monotonic() - started_s)
    return EXIT_OK


def _evaluate(wanted: Campaign, args: argparse.Namespace) -> list[Summary]:
    shown = not (args.json or args.grid)

    def on_summary(summary: Summary) -> None:
        if shown:
            sys.stdout.write(line_of(summary))
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


def line_of(summary: Summary) -> str:
    """One line for people."""
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
        raise WrongInputError(f"no system {unknown[0]!r}: there are {', '.join(SYSTEMS)}")
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
        if wanted and not _is_installed(package):
            raise WrongInputError(f"needs the package '{package}': pip install '.[{extra}]'")


def _is_installed(package: str) -> bool:
    return find_spec(package) is not None


def _digests(quick: bool) -> dict[str, str]:
    return {
        name: digest(quickened(system) if quick else system) for name, system in SYSTEMS.items()
    }


def _report(summaries: Sequence[Summary], args: argparse.Namespace, seconds: float) -> None:
    if args.table:
        command = "graspd " + " ".join(_command(args))
        made = Made(command, seconds, made_with(), quick=args.quick)
        args.table.parent.mkdir(parents=True, exist_ok=True)
        args.table.write_text(table(summaries, made))
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
    systems: Sequence[System], summaries: Sequence[Summary], args: argparse.Namespace
) -> None:
    for system in systems:
        for protocol in args.protocol or STANDARD:
            report = best_of_grid(system, protocol, summaries)
            (args.out / f"{system.name}.{protocol}.grid.json").write_bytes(to_json(report))
            if not args.json:
                best = report[0]
                sys.stdout.write(
                    f"{best.name} {protocol}: best of {len(report)}, F1 {100 * best.f1.mean:.2f} "
                    f"+- {100 * best.f1.std:.1f} %\n"
                )


def _fail(problem: str, code: int) -> int:
    sys.stderr.write(f"graspd evaluate: {problem}\n")
    return code
