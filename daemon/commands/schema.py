"""`graspd schema`: the JSON Schema of the messages."""

from __future__ import annotations

import argparse
import json
import sys

from daemon.publish.messages import schema


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments: none."""


def run(_args: argparse.Namespace) -> int:
    """Print the schema."""
    sys.stdout.write(schema_text())
    return 0


def schema_text() -> str:
    """The schema as the file `deploy/wire/messages.schema.json` holds it."""
    return json.dumps(schema(), indent=2, sort_keys=True) + "\n"
