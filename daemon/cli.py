"""The command line: `graspd COMMAND ...`.

Exit codes: 0 done; 1 something failed while running; 2 the command line, scene, recording, model
or data is wrong; 130 and 143 stopped by SIGINT and SIGTERM before the work was done.
"""

from __future__ import annotations

import argparse
import importlib
import logging
import os
import sys
from collections.abc import Sequence
from importlib.metadata import version

COMMANDS = {
    "run": ("daemon.commands.run", "run the daemon on a scene"),
    "replay": ("daemon.commands.replay", "judge recordings and print the verdicts"),
    "check": ("daemon.commands.check", "say whether a scene is right and what it needs"),
    "doctor": (
        "daemon.commands.doctor",
        "look at hardware, model and privileges for what is wrong",
    ),
    "twin": ("daemon.commands.twin", "stand in for a bridge, a CAN board or a palm"),
    "data": ("daemon.commands.data", "get the real grasp recordings"),
    "schema": ("daemon.commands.schema", "print the JSON Schema of the messages"),
    "train": ("models.training.command", "train and export a model (extra: train)"),
}
"""Name: module with `add_arguments(parser)` and `run(args) -> int`, one line of help."""

FAILED = 1
WRONG = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(
        prog="graspd",
        description="Says before a Shadow Dexterous Hand lifts whether the grasp will hold.",
    )
    parser.add_argument("--version", action="version", version=f"graspd {version('graspd')}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    named = next((word for word in arguments if not word.startswith("-")), None)
    run = None
    for name, (module_name, text) in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
        if name == named:
            try:
                module = importlib.import_module(module_name)
            except ModuleNotFoundError as error:
                return _extra_is_missing(name, error)
            module.add_arguments(command)
            run = module.run
    args = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="graspd: %(levelname)s: %(message)s")
    if run is None:
        parser.error(f"'{args.command}' must come first")
    try:
        code: int = run(args)
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever read our output has gone, as in `graspd replay | head`: nothing is wrong.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    return code


def _extra_is_missing(command: str, error: ModuleNotFoundError) -> int:
    if command != "train" or (error.name or "").split(".")[0] in {"daemon", "drivers", "models"}:
        raise error
    sys.stderr.write(
        f"graspd: {command} needs the package '{error.name}': pip install 'graspd[train]'\n"
    )
    return WRONG
