"""What the commands of the training half share: arguments, messages, exit codes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

from models.training.data.datasets import DatasetError
from models.training.data.folds import TooFewGraspsError

EXIT_OK, EXIT_FAILED, EXIT_INPUT, EXIT_INTERRUPTED = 0, 1, 2, 130
SEEDS = 3
"""Of the splits, that an evaluation takes by default."""


class WrongInputError(Exception):
    """The command line asks for what is not there, or cannot be done with these data."""


def whole(low: int, high: int) -> Callable[[str], int]:
    """For `argparse`: takes whole numbers from `low` to `high`, ten digits at most."""

    def parse(text: str) -> int:
        if text.isascii() and text.isdigit() and len(text) <= 10 and low <= int(text) <= high:
            return int(text)
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {low} to {high}")

    return parse


def exit_code(
    command: str, folder: Path, work: Callable[[], None], failure: type[Exception]
) -> int:
    """Do the work of a command that writes into `folder`, and say in one line why it ended.

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


def warn_of_unpublished(command: str, names: Iterable[str]) -> None:
    """Say which tables are not, byte for byte, the published ones."""
    for name in names:
        say(
            command,
            f"warning: {name}.csv is not the published table; the figures are of this data only",
        )


def say(command: str, text: str) -> None:
    """One line on standard error."""
    sys.stderr.write(f"graspd {command}: {text}\n")
