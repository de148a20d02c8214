"""`graspd scene`, `schema` and `manual`: print scene, schema or manual page."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from graspd.daemon.publish.messages import schema
from graspd.daemon.scene import explained

MANUAL = Path(__file__).parent / "shell" / "graspd.1"
"""Manual page, made from the parsers by `python -m tests.daemon.commands.shell_files`."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `parser.prog`; only `scene` has any."""
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
    """Print the text that the command and its options choose; return 0."""
    match args.command:
        case "scene" if args.example is not None:
            text = explained.example(args.example)
        case "scene":
            text = explained.schema_text() if args.schema else explained.page()
        case "schema":
            text = schema_text()
        case _:
            text = MANUAL.read_text()
    sys.stdout.write(text)
    return 0


def schema_text() -> str:
    """Return the text of the file `deploy/wire/messages.schema.json`."""
    return json.dumps(schema(), indent=2, sort_keys=True) + "\n"
