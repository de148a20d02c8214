"""Parser of command lines that suggests the likely word for a mistyped one; shared options."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from graspd.daemon.process.text import did_you_mean


class UsageError(Exception):
    """The command line is wrong; the text says how."""


class Parser(argparse.ArgumentParser):
    """A parser that takes options and files in any order; its errors suggest the likely word."""

    _is_intermixing = False
    """True while argparse parses options and files in two passes."""

    @property
    def actions(self) -> Sequence[argparse.Action]:
        """Options, positional arguments, and the choice of a subcommand."""
        return self._actions

    @property
    def subparsers(self) -> Mapping[str, Parser]:
        """Parsers of the subcommands by name; empty without any."""
        choices = (action.choices for action in self._actions)
        return next((each for each in choices if isinstance(each, Mapping)), {})

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:  # noqa: ANN401
        """Parse options and files in any order; report an unknown option first."""
        words: Sequence[str] = sys.argv[1:] if args is None else args
        is_mine = (lambda word: word.startswith("-")) if self.subparsers else lambda _word: True
        for word in takewhile(lambda word: word != "--" and is_mine(word), words):
            name = word.partition("=")[0]
            known = self._option_string_actions
            if name.startswith("--") and not any(option.startswith(name) for option in known):
                self.error(f"no such option: {name}{did_you_mean(name, known)}")
        if self.subparsers or self._is_intermixing or "--" in words:  # two passes lose the --
            return super().parse_known_args(args, namespace)
        self._is_intermixing = True
        try:
            return self.parse_known_intermixed_args(args, namespace)
        finally:
            self._is_intermixing = False

    def _check_value(self, action: argparse.Action, value: Any) -> None:  # noqa: ANN401
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            said = f"{error.message}{did_you_mean(str(value), map(str, action.choices or ()))}"
            raise argparse.ArgumentError(action, said) from None


def check_folder(folder: Path) -> None:
    """Raise `UsageError` if no file can be made in a folder."""
    try:
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}") from error


def within(lowest: float, highest: float) -> Callable[[str], float]:
    """Return a type for `argparse`: numbers from `lowest` to `highest`."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not lowest <= value <= highest:
            raise argparse.ArgumentTypeError(
                f"{text} is not a number from {lowest:g} to {highest:g}"
            )
        return value

    return parse


def add_reading(parser: argparse.ArgumentParser) -> None:
    """Declare `--as` and `--rate-hz`, which decide how a table is read."""
    parser.add_argument(
        "--as",
        dest="read_as",
        choices=("table", "stream"),
        help="of tables that may be either: each row is a grasp, or each row is a sweep",
    )
    parser.add_argument(
        "--rate-hz",
        type=within(0.001, 1e4),
        metavar="HZ",
        help="rows per second of a stream without times, and of a grasp table as played "
        "(default: 100)",
    )
