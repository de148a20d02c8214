"""Shared parts of the training commands: arguments, messages, progress, exit codes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from graspd.drivers.recordings.kinds import files_of
from graspd.drivers.recordings.layout import ReadAs
from graspd.models.training.data.datasets import (
    FEWEST_GRASPS,
    DatasetError,
    Grasps,
    lab_table_names,
    read_table,
    read_with_lab_tables,
    unpublished,
)
from graspd.models.training.data.protocols import TooFewGraspsError, near_copies
from graspd.models.training.systems.registry import SYSTEMS, System


class WrongInputError(Exception):
    """The command line has an unknown name or options that exclude each other, or does not fit the
    data, or an extra or a file that it needs is missing."""


def whole(low: int, high: int) -> Callable[[str], int]:
    """Return a type for `argparse`: whole numbers from `low` to `high`, at most ten digits."""

    def parse(text: str) -> int:
        if text.isascii() and text.isdigit() and len(text) <= 10 and low <= int(text) <= high:
            return int(text)
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {low} to {high}")

    return parse


def add_shared_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options that `graspd train` and `graspd evaluate` share."""
    parser.add_argument("--quiet", action="store_true", help="show no progress bar")
    parser.add_argument(
        "--data",
        type=Path,
        metavar="DIR",
        action=_Data,
        help="folder with the published grasp tables: palm_down.csv, palm_side.csv and, for some "
        "models and protocols, palm_45.csv; a file is one of --own",
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
        "--as",
        dest="read_as",
        choices=("table",),
        help="of --own: read a table of which many rows repeat each other, as it has several "
        "readings of each grasp",
    )
    parser.add_argument(
        "--jobs",
        type=whole(1, 1024),
        metavar="N",
        help="trainings at once on this machine (default: 1)",
    )


class _Data(argparse.Action):
    """Action of `--data`: set `data` to a folder, or append a file to `own`."""

    def __call__(
        self,
        _parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        _option: str | None = None,
    ) -> None:
        if isinstance(values, Path) and values.is_file():
            namespace.own = [*namespace.own, values]
        else:
            namespace.data = values


def exit_code(
    command: str,
    folder: Path,
    work: Callable[[], int | None],
    *failures: type[Exception],
    keeps: bool = True,
) -> int:
    """Run `work`, which writes into `folder`; print an error in one line.

    `keeps`: True if after Ctrl-C the same command continues from what is in the folder.

    Returns what `work` does, None as 0; 1 for an exception of `failures`; 2 for wrong input, data
    or folder; 130 for Ctrl-C. Raises the `OSError` of a failed write to standard output.
    """
    try:
        return work() or 0
    except KeyboardInterrupt:
        say(command, f"interrupted{'; the same command continues from here' if keeps else ''}")
        return 130
    except OSError as error:
        raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
        if getattr(raw, "failure", None) is error:  # of `guarded`, which handles it
            raise
        say(command, f"{error.filename or folder}: {error.strerror or error}")
        return 2
    except (DatasetError, TooFewGraspsError, WrongInputError) as error:
        say(command, str(error))
        return 2
    except failures as error:
        say(command, str(error))
        return 1


def read_grasps(command: str, args: argparse.Namespace) -> Grasps:
    """Return the grasps of `--data` and `--own`. Raises `WrongInputError`, `DatasetError`.

    Warns of grasps without outcome, rows that nearly repeat others, and tables that have a
    published name but differ from the published file.
    """
    if args.data is None and not args.own:
        raise WrongInputError("needs --data DIR, --own FILE, or both")
    if args.read_as and not args.own:
        raise WrongInputError("--as is for tables of --own: there is none")
    with files_of(args.own) as own:
        grasps = read_with_lab_tables(args.data, own, args.read_as)
    if grasps.without_outcome:
        say(command, f"warning: {grasps.without_outcome} grasps have no outcome, and are left out")
    if copies := near_copies(grasps):
        say(
            command,
            f"warning: {copies} of {len(grasps)} rows nearly repeat another: each such group is "
            "kept in one fold, and counts as one grasp",
        )
    lab = lab_table_names(grasps.files)
    for name in unpublished(grasps.files):
        if name not in lab:
            text = f"{name}.csv is not the published table; the figures are of this data only"
            say(command, f"warning: {text}")
    return grasps


def read_each(paths: Sequence[Path], read_as: ReadAs | None) -> list[Grasps]:
    """Return the grasps of each table. Raises `DatasetError`."""
    with files_of(paths) as files:
        return [read_table(path, read_as) for path in files]


def check_fingers(systems: Iterable[System], grasps: Grasps) -> None:
    """Raise `WrongInputError` for a system that judges a finger which the grasps lack."""
    for system in systems:
        there = set(grasps.fingers)
        if not there.issuperset(system.fingers):
            forms = [name for name, one in SYSTEMS.items() if there.issuperset(one.fingers)]
            raise WrongInputError(
                f"{system.name} judges {', '.join(system.fingers)}, the grasps have "
                f"{', '.join(grasps.fingers)}: systems for them are {', '.join(forms) or 'none'}"
            )


def say(command: str, text: str) -> None:
    """Write the line `graspd COMMAND: TEXT` to standard error."""
    sys.stderr.write(f"graspd {command}: {text}\n")


@contextmanager
def progress_bar(
    first: str, total: int, *, hidden: bool = False
) -> Iterator[Callable[[str], None]]:
    """Show on stderr, if a terminal and not `hidden`, how many of `total` trainings are done.

    `first`: text of the bar at first. Yields a function to call after each training, with the
    bar's next text.
    """
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress

    console = Console(stderr=True)
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    hidden = hidden or not console.is_terminal
    with Progress(*columns, console=console, disable=hidden, transient=True) as bar:
        task = bar.add_task(first, total=total)
        yield lambda name: bar.update(task, advance=1, description=name)
