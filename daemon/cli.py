"""The command line: `graspd COMMAND ...`.

Exit codes:
0: done.
1: a failure while running (device, socket, output, download), or a finding of `doctor`.
2: the command line, scene, recording or model is wrong.
130, 143: stopped by SIGINT or SIGTERM before the work was done.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import NoReturn

from graspd.daemon import version
from graspd.daemon.commands.arguments import Parser, UsageError
from graspd.daemon.process import logs
from graspd.daemon.process.files import is_linux
from graspd.daemon.process.text import complain
from graspd.extras import needs

COMMANDS = {
    "run": (".run", "run the daemon on a scene"),
    "replay": (".replay", "judge recordings and print the verdicts"),
    "watch": (".watch", "see it live, in a terminal (extra: watch) or a browser"),
    "scene": (".texts", "print an example scene, or what each of its keys means"),
    "check": (".check", "say whether a scene is right and what it needs"),
    "doctor": (".doctor", "look at hardware, model and privileges for what is wrong"),
    "twin": (".twin", "stand in for a bridge, a CAN board or a palm"),
    "data": (".data", "get the real grasp recordings"),
    "schema": (".texts", "print the JSON Schema of the messages"),
    "models": (".models", "list the models and show their cards"),
    "session": (".session", "show, reset or seed what is known of the sensors"),
    "export-grasps": (
        ".export_grasps",
        "make a grasp table of what was recorded, for train (extra: record)",
    ),
    "keys": (".keys", "make and list the keys of those who may connect by TCP"),
    "train": ("graspd.models.training.commands.train", "train and export a model (extra: train)"),
    "evaluate": (
        "graspd.models.training.commands.evaluate",
        "measure how good systems are (extra: train)",
    ),
    "report": (
        "graspd.models.training.reports.command",
        "measure error, time and exactness of the models (extras: train, report; stability: none)",
    ),
    "manual": (".texts", "print the manual page: graspd manual | man -l -"),
}
"""Commands by name: a module with `add_arguments(parser)` and `run(args) -> int`, and help.

A name that begins with a dot is one of `graspd.daemon.commands`.
"""
EXTRAS = {
    "export-grasps": "record",
    "models": "train",
    "train": "train",
    "evaluate": "train",
    "report": "train,report",
}
"""Extra to install, by command, if a module is missing; help, and some uses, work without."""
LINUX = {"run", "doctor", "keys"}
"""Commands that need Linux, also for their help."""
LIBRARIES = ("onnxruntime", "numpy", "pyzmq", "python-can", "pyserial")
"""Libraries whose versions `--version` prints."""
FAILED, WRONG = 1, 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code. `graspd.daemon.__main__` sets up the process."""
    return parse(arguments)()


def parse(arguments: Sequence[str] | None = None) -> Callable[[], int]:
    """Return a function that runs the command and returns its exit code.

    `arguments` None: those of the process. Raises `SystemExit` for a wrong command line and after
    `--help` or `--version`.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    named = next((word for word in arguments if not word.startswith("-")), None)
    if named in LINUX and not is_linux():
        complain(f"graspd {named} needs Linux")
        raise SystemExit(WRONG)
    parser = _parser(lambda name: name == named)
    if not arguments:
        parser.print_help(sys.stderr)
        raise SystemExit(WRONG)
    args = parser.parse_args(arguments)
    logs.set_up(os.environ)

    def run() -> int:
        try:
            code: int = _module(args.command).run(args)
        except ModuleNotFoundError as error:
            if args.command not in EXTRAS:
                raise
            problem = needs(args.command, EXTRAS[args.command], error)
        except _input_errors() as error:
            problem = str(error)
        except OSError as error:
            if error.filename is None:  # not an error of the file system
                raise
            complain(f"{error.filename}: {error.strerror}")
            return FAILED
        else:
            return code
        sys.stdout.flush()
        complain(problem)
        return WRONG

    return run


def _input_errors() -> tuple[type[Exception], ...]:
    """Return the errors that say which input is wrong, for exit code `WRONG`. They are imported
    only here, when a command has failed."""
    from graspd.daemon.scene import SceneError
    from graspd.daemon.session.file import SessionFileError
    from graspd.drivers.base import DriverError
    from graspd.models.contract import ModelError

    return UsageError, SceneError, ModelError, DriverError, SessionFileError


def whole_parser() -> Parser:
    """Return the parser of all commands, with all arguments."""
    return _parser(lambda _name: True)


def _parser(is_wanted: Callable[[str], bool]) -> Parser:
    """Return the parser of all commands, with the arguments of those that `is_wanted`."""
    parser = Parser(
        prog="graspd",
        description="Says before a Shadow Dexterous Hand lifts whether the grasp will hold.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="tell versions and leave")
    commands = parser.add_subparsers(
        dest="command", metavar="COMMAND", required=True, help="what to do; each has its own --help"
    )
    for name, (_, text) in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
        if is_wanted(name):
            _module(name).add_arguments(command)
    return parser


def _module(command: str) -> ModuleType:
    return importlib.import_module(COMMANDS[command][0], "graspd.daemon.commands")


class _Version(argparse.Action):
    """Print graspd's version in the first line, those of Python and libraries in the second."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        # Imported here, as only `--version` needs them.
        import platform
        from importlib import metadata

        import zmq

        libraries = [f"Python {platform.python_version()}"]
        libraries += [f"{name} {metadata.version(name)}" for name in LIBRARIES]
        libraries.append(f"libzmq {zmq.zmq_version()}")
        ours = f"graspd {version()}{_commit()}"
        sys.stdout.write(f"{ours}\n{', '.join(libraries)}\n")
        parser.exit()


def _commit() -> str:
    """Return the commit of a checkout, such as ` at 1a2b3c4d`; "" if not a checkout, or no git."""
    import subprocess

    folder = Path(__file__).resolve().parents[1]
    if not (folder / ".git").exists():
        return ""
    describe = ["git", "-C", str(folder), "describe", "--always", "--dirty"]
    try:
        told = subprocess.run(describe, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.SubprocessError):  # no git, or a checkout of another user
        return ""
    return f" at {told.strip()}"
