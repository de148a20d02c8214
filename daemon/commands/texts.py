"""`graspd schema`, `graspd manual` and `graspd completion SHELL`: print a text that is ready."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from daemon.publish.messages import schema

FILES = Path(__file__).parent / "shell"
"""Made of the command line's parsers by `python -m tests.daemon.commands.shell_files`."""
SHELLS = ("bash", "zsh", "fish")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the argument of `completion`; the other commands have none."""
    if parser.prog == "graspd completion":
        parser.add_argument(
            "shell",
            choices=SHELLS,
            help='which shell: eval "$(graspd completion bash)", in zsh after compinit; '
            "graspd completion fish | source",
        )


def run(args: argparse.Namespace) -> int:
    """Print the text."""
    match args.command:
        case "schema":
            text = schema_text()
        case "manual":
            text = (FILES / "graspd.1").read_text()
        case _:
            text = (FILES / f"graspd.{args.shell}").read_text()
    sys.stdout.write(text)
    return 0


def schema_text() -> str:
    """Return the schema as the file `deploy/wire/messages.schema.json` holds it."""
    return json.dumps(schema(), indent=2, sort_keys=True) + "\n"
