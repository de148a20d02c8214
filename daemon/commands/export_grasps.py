"""`graspd export-grasps RECORDING...`: recorded grasps with known outcomes, for `graspd train`."""

from __future__ import annotations

import argparse
import io
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from graspd.daemon.commands.arguments import UsageError, check_folder
from graspd.daemon.process.files import write_atomically
from graspd.daemon.process.text import complain, write_lines
from graspd.daemon.publish.messages import OBJECT_PATTERN
from graspd.drivers.recordings.kinds import STANDARD_INPUT, files_of
from graspd.extras import require

if TYPE_CHECKING:
    from graspd.daemon.record.export import Export

FAILED = 1
STANDARD_OUTPUT = STANDARD_INPUT
"""Name of standard output on a command line."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "recordings",
        nargs="+",
        type=Path,
        metavar="RECORDING",
        help="what `graspd run` with [record] has written (MCAP), in the order of time; - is "
        "standard input",
    )
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="TABLE",
        help="grasp table (CSV) to write; - is standard output",
    )
    parser.add_argument(
        "--parquet",
        action="store_true",
        help="write TABLE as Parquet, for `graspd.read_grasps` (extra: pandas)",
    )
    parser.add_argument("--force", action="store_true", help="replace a TABLE that is there")
    parser.add_argument(
        "--object",
        type=_name,
        default="unknown",
        metavar="NAME",
        help="what was grasped where the controller told no object",
    )


def run(args: argparse.Namespace) -> int:
    """Write the table; return 1 if it cannot be written or no grasp has an outcome, else 0."""
    to_stdout = args.out == STANDARD_OUTPUT
    if to_stdout and args.parquet:
        raise UsageError("--parquet needs a file for --out; to - goes CSV")
    if not to_stdout and args.out.exists() and not args.force:
        raise UsageError(f"{args.out} is there already: --force replaces it")
    if not to_stdout:
        check_folder(args.out.parent)  # now, not after minutes of reading
    if args.parquet:
        _require_parquet()
    from graspd.daemon.record.export import collect, write

    with files_of(args.recordings) as files:
        export = collect(files)
    (complain if to_stdout else write_lines)(_summary(export))
    if not export.grasps:
        complain(f"no judged grasp with an outcome: nothing is written: {_why(export)}")
        return FAILED
    if to_stdout:
        write(sys.stdout, export, args.object)
        return 0
    try:
        if args.parquet:
            from graspd.daemon.record.frames import grasps_of

            content = bytes(grasps_of(export, args.object).to_parquet())
        else:
            table = io.StringIO(newline="")
            write(table, export, args.object)
            content = table.getvalue().encode()
        write_atomically(args.out, content, mode=0o644)
    except OSError as error:
        complain(f"{args.out}: {error.strerror or error}")
        return FAILED
    return 0


def _require_parquet() -> None:
    """Raise `UsageError` without the packages that write Parquet."""
    try:
        for package in ("pandas", "pyarrow"):
            require(package, "--parquet", "pandas")
    except ModuleNotFoundError as error:
        raise UsageError(str(error)) from error


def _summary(export: Export) -> str:
    grasps = export.grasps.values()
    slipped = sum(grasp.slipped for grasp in grasps)
    further = {
        "objects by name": len({grasp.object_name for grasp in grasps} - {None}),
        "grasps without an object": sum(grasp.object_name is None for grasp in grasps),
    }
    counted = [f"{count} {what}" for what, count in further.items() if count]
    return "; ".join([f"{len(grasps)} grasps, {slipped} slipped", *counted, *export.lacks()])


def _why(export: Export) -> str:
    """Return why there is no grasp, in words."""
    if export.repaired:
        return "all with an outcome were judged with repaired electrodes"
    if export.without_outcome:
        return "the controller told no outcome"
    if export.unjoined:
        return "the grasps of these outcomes were judged in other recordings"
    return "no grasp was judged; `graspd replay` says why"


def _name(text: str) -> str:
    if not re.fullmatch(OBJECT_PATTERN, text):
        raise argparse.ArgumentTypeError(
            "an object has a name of letters, digits, '_', '-' and '.'"
        )
    return text
