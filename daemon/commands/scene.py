"""`graspd scene`: an example to edit, and what each key of a scene means."""

from __future__ import annotations

import argparse
import sys

from daemon.scene import explained


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
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
    """Print what was asked for."""
    if args.example is not None:
        text = explained.example(args.example)
    else:
        text = explained.schema_text() if args.schema else explained.page()
    sys.stdout.write(text)
    return 0
