"""`graspd manual`: the manual page of all commands, made of the parsers that read them."""

from __future__ import annotations

import argparse
import sys
import textwrap
from collections.abc import Iterator
from typing import Final

from daemon.commands.arguments import Parser

ABOUT: Final = (
    "graspd tells a grasp controller, before a Shadow Dexterous Hand lifts, whether the object "
    "will stay or slip: BioTac SP fingertips in, one verdict out on a ZeroMQ socket. A verdict is "
    "stable, slip or unknown; whatever is missing, damaged, stale or moving is unknown. A scene, "
    "a TOML file, names what the hand has."
)
EXIT_STATUS: Final = (
    ("0", "Done."),
    ("1", "Something failed while running, or doctor has found something."),
    ("2", "The command line, a scene, a recording or a model is wrong."),
    ("130, 143", "Stopped by SIGINT or SIGTERM before the work was done."),
)
ENVIRONMENT: Final = (
    ("NO_COLOR", "If it is not empty, nothing is coloured on a terminal."),
    ("TERM", "If it is dumb, neither."),
)
LINE_MAX: Final = 72
"""Characters of a line of the source, before they are escaped."""
FILES: Final = (
    ("/etc/graspd/*.toml", "Scenes of the service graspd@.service, one per hand."),
    ("/run/graspd", "Sockets of the service."),
    ("/var/lib/graspd", "What each hand has learned, and recordings."),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments: none."""


def run(args: argparse.Namespace) -> int:
    """Print the page."""
    sys.stdout.write(page(args.whole_parser()))
    return 0


def page(parser: Parser) -> str:
    """The page in the language of man(7). It has no date and no version: it is kept in a file."""
    return "\n".join(_lines(parser)) + "\n"


def _lines(parser: Parser) -> Iterator[str]:
    yield '.\\" Made by: graspd manual'
    yield '.TH GRASPD 1 "" "graspd" "User Commands"'
    yield ".SH NAME"
    yield _text("graspd - says before a Shadow Dexterous Hand lifts whether the grasp will hold")
    yield ".SH SYNOPSIS"
    yield ".B graspd"
    yield ".I COMMAND"
    yield _text("[argument ...]")
    yield ".SH DESCRIPTION"
    yield _text(ABOUT)
    yield ".SH OPTIONS"
    yield from _arguments(parser)
    yield ".SH COMMANDS"
    yield from _commands(parser)
    for title, entries in (
        ("EXIT STATUS", EXIT_STATUS),
        ("ENVIRONMENT", ENVIRONMENT),
        ("FILES", FILES),
    ):
        yield f".SH {title}"
        for name, text in entries:
            yield from (".TP", f".B {_text(name)}", _text(text))


def _commands(parser: Parser) -> Iterator[str]:
    """Each command that can be run, with its arguments; those of commands of commands too."""
    for command in parser.subparsers.values():
        if command.subparsers:
            yield from _commands(command)
            continue
        yield f'.SS "{_text(command.prog)}"'
        yield _text(command.description or "")
        yield from _arguments(command)


def _arguments(parser: Parser) -> Iterator[str]:
    for action in parser.actions:
        if action.option_strings == ["-h", "--help"] or action.choices == parser.subparsers:
            continue
        yield ".TP"
        yield _title(action)
        yield _text(help_of(action))


def _title(action: argparse.Action) -> str:
    value = value_of(action)
    value = f"\\fI{_text(value)}\\fR" if value else ""
    if not action.option_strings:
        return value + ("..." if action.nargs in ("*", "+") else "")
    names = ", ".join(f"\\fB{_text(name)}\\fR" for name in action.option_strings)
    return f"{names} {value}".rstrip()


def value_of(action: argparse.Action) -> str:
    """What the help calls its value; "" if it takes none."""
    if action.nargs == 0:
        return ""
    if isinstance(action.metavar, str):
        return action.metavar
    if action.choices is not None:
        return f"{{{','.join(map(str, action.choices))}}}"
    return action.dest.upper() if action.option_strings else action.dest


def help_of(action: argparse.Action) -> str:
    """Its help, as `--help` shows it."""
    return (action.help or "") % vars(action)


def _text(text: str) -> str:
    """Plain text as roff takes it: nothing in it is a request or an escape."""
    lines = textwrap.wrap(text, LINE_MAX, break_long_words=False, break_on_hyphens=False)
    escaped = (line.replace("\\", "\\e").replace("-", "\\-") for line in lines)
    return "\n".join(f"\\&{line}" if line.startswith((".", "'")) else line for line in escaped)
