"""`graspd scene`, `schema`, `manual` and `completion`: print a text that is ready."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from graspd.daemon.publish.messages import schema
from graspd.daemon.scene import explained

FILES = Path(__file__).parent / "shell"
"""Made of the command line's parsers by `python -m tests.daemon.commands.shell_files`."""
SHELLS = ("bash", "zsh", "fish")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `parser.prog`; only `scene` and `completion` have any."""
    if parser.prog == "graspd completion":
        parser.add_argument(
            "shell",
            choices=SHELLS,
            help='which shell: eval "$(graspd completion bash)", in zsh after compinit; '
            "graspd completion fish | source",
        )
    if parser.prog != "graspd scene":
        return
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--example",
        choices=explained.examples(),
        help="print a commented scene to edit, as in `graspd scene --example spi > right.toml`; "
        "then `graspd check right.toml`",
    )
    what.add_argument(
        "--schema",
        action="store_true",
        help="print the JSON Schema of a scene, by which an editor completes and explains keys",
    )
    what.add_argument(
        "--page", action="store_true", help="print type, unit, default and range of every key"
    )


def run(args: argparse.Namespace) -> int:
    """Print the text."""
    match args.command:
        case "scene" if args.example is not None:
            text = explained.example(args.example)
        case "scene":
            text = explained.schema_text() if args.schema else explained.page()
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
