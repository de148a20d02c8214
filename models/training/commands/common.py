"""Shared parts of the training commands: arguments, messages, progress, exit codes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from graspd.models.contract import Dataset
from graspd.models.training.data.datasets import DatasetError, lab_table_names, unpublished
from graspd.models.training.data.protocols import TooFewGraspsError

EXIT_OK, EXIT_FAILED, EXIT_INPUT, EXIT_INTERRUPTED = 0, 1, 2, 130


class WrongInputError(Exception):
    """The command line names something missing, or does not fit the data."""


def whole(low: int, high: int) -> Callable[[str], int]:
    """Return a type for `argparse`: whole numbers from `low` to `high`, at most ten digits."""

    def parse(text: str) -> int:
        if text.isascii() and text.isdigit() and len(text) <= 10 and low <= int(text) <= high:
            return int(text)
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {low} to {high}")

    return parse


def exit_code(
    command: str, folder: Path, work: Callable[[], None], failure: type[Exception]
) -> int:
    """Run `work`, which writes into `folder`; print an error in one line.

    Returns 0; 1 for `failure`; 2 for wrong input, data or folder; 130 for Ctrl-C.
    """
    try:
        work()
    except KeyboardInterrupt:
        say(command, "interrupted; the same command goes on from here")
        return EXIT_INTERRUPTED
    except OSError as error:
        say(command, f"{error.filename or folder}: {error.strerror or error}")
        return EXIT_INPUT
    except (DatasetError, TooFewGraspsError, WrongInputError) as error:
        say(command, str(error))
        return EXIT_INPUT
    except failure as error:
        say(command, str(error))
        return EXIT_FAILED
    return EXIT_OK


def warn_of_unpublished(command: str, files: Sequence[Dataset]) -> None:
    """Warn of tables with a published name that are not, byte for byte, the published ones."""
    own = lab_table_names(files)
    for name in unpublished(files):
        if name not in own:
            text = f"{name}.csv is not the published table; the figures are of this data only"
            say(command, f"warning: {text}")


def say(command: str, text: str) -> None:
    """Write one line to standard error."""
    sys.stderr.write(f"graspd {command}: {text}\n")


@contextmanager
def progress_bar(first: str, total: int, *, hidden: bool) -> Iterator[Callable[[str], None]]:
    """Show on stderr, if it is a terminal, how many of `total` trainings are done.

    Yields a function to call after each training, with the bar's next text.
    """
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress

    console = Console(stderr=True)
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    hidden = hidden or not console.is_terminal
    with Progress(*columns, console=console, disable=hidden, transient=True) as bar:
        task = bar.add_task(first, total=total)
        yield lambda name: bar.update(task, advance=1, description=name)
