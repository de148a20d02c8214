"""`python -m tests.bench.cases FOLDER [CASE...]`: other people's files, each with its command.

A case is a folder with inputs and a `README`, whose line `Command (in this folder):` is run in a
copy, with `PY` for this Python and `graspd` for the command of its environment. `EXPECTED` says
what must come. A case that it does not have is run, and what comes is printed.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Final, NamedTuple

ROOT: Final = Path(__file__).parents[2]
COMMAND: Final = "Command (in this folder):"
LIMIT_S: Final = 300.0
"""Longest run of a case, s; the slowest trains two models."""
SHOWN: Final = 25
"""Lines of the output of a failed case that are printed."""
RENAMED: Final = {'file = "session.json"': 'folder = "session"'}
"""Keys of scenes that were renamed since the cases were made."""


class Comes(NamedTuple):
    """What a command gives."""

    code: int | None
    """Exit code of the last command; None: any."""
    must: tuple[str, ...] = ()
    """Patterns, each in the output."""
    never: tuple[str, ...] = ()
    """Patterns that are not in the output."""


TABLE: Final = Comes(0, (r"grasp again +\d+ of [1-9]|[1-9]\d* verdicts",), ("not a label", "Error"))
"""A grasp table was read."""
STREAM: Final = Comes(0, (r"[1-9]\d* readings", r"[1-9]\d* grasps?, [1-9]\d* judged"))
"""A stream or a link log was read, and a grasp in it was judged."""
READ: Final = Comes(None, (r"[1-9]\d* readings",), (r"Traceback",))
"""A log of a few readings was read."""
ONE_GRASP: Final = Comes(0, ("260 readings", "1 grasps?, 1 judged"))
MADE: Final = r"out/small-session-\w+\.onnx"
TRAINED: Final = Comes(0, (r"replay 0", MADE), ("column is missing", "not CSV"))
DIFFERS: Final = (
    Comes(0, (r"\b0 differ",)),
    Comes(0, (r"warnings: \[.+\]",)),
)
A_STREAM: Final = r"\b(a|as) stream\b|--as\b"
NO_TABLE: Final = (
    ONE_GRASP,
    Comes(2, (A_STREAM,), (r"again +\d+ of 260", r"260 verdicts")),
)
CANDUMP: Final = (READ, Comes(2, (r"line 1\b.*candump", r"time")))

EXPECTED: Final[dict[str, tuple[Comes, ...]]] = {
    "advice-usb2can": (Comes(None, (r"Windows",), (r"pip install",)),),
    "can-asc": (
        Comes(None, READ.must, (r"--scene is for", r"ff_biotac_1")),
        Comes(2, (r"CAN logs are read as candump",)),
    ),
    "candump-four-decimals": CANDUMP,
    "candump-half-unreadable": (
        ONE_GRASP,
        Comes(None, (r"WARNING.*\b3[,\d]* of 6,?24\d\b.*",)),
    ),
    "candump-nanoseconds": CANDUMP,
    "candump-suffix-txt": (ONE_GRASP,),
    "candump-terminal-form": (READ, Comes(2, (r"candump", r"-L or -l|-l or -L"))),
    "candump-two-buses-in-phase": (ONE_GRASP,),
    "check-interface-without-package": (
        Comes(None, (r"check 2", r"run 2", r"python-can\[gs[-_]usb\]"), (r"install usb\b",)),
    ),
    "check-unknown-interface": (
        Comes(None, (r"check 2", r"run 2", r"(?s)no interface 'socketcan_native'.*no interface")),
    ),
    "client-after-fork": (
        Comes(0, (r"child unknown after (0\.\d|1\.0) s",), (r"has not returned",)),
        Comes(0, (r"Error: .*(process|fork)",), (r"has not returned",)),
    ),
    "comment-line": (TABLE, Comes(2, (r"line 1\b.*header",))),
    "counts-normalised": (
        Comes(None, (r"2,?880", r"0\.6825", r"normali[sz]ed"), (r"(?m)^True$",)),
    ),
    "csv-gz": (TABLE, Comes(2, (r"gzip", r"unpack"))),
    "csv-semicolon": (TABLE, Comes(2, (r"separated by ;",))),
    "csv-sep-line": (TABLE, Comes(2, (r"separated by ;",))),
    "joints-degrees": (Comes(None, (r"FFJ3 = \d+\.\d+ rad\b.*(joint angle|degrees)",)),),
    "label-blank-in-stream": (STREAM,),
    "label-true-false": (Comes(0, (*TABLE.must, r"(?m)^[1-9]\d*$"), TABLE.never),),
    "label-unknown-by-pandas": (TABLE,),
    "layout-ff-e1": (
        Comes(2, (r"ff_e1", r"ff_biotac_1|--as stream")),
        Comes(2, (r"--as stream", r"--rate-hz")),
    ),
    "library-pickle": (Comes(0), Comes(1, (r"TypeError: .*graspd\.load",))),
    "library-polars": (Comes(0, (r"\[\[0\.\d",)), Comes(1, (r"ValueError: .*pandas",))),
    "mcap-metadata-at-end": (STREAM,),
    "mcap-metadata-dropped": (
        Comes(None, (r"record `graspd`", r"dropped|lost|include-metadata")),
        Comes(0, (*STREAM.must, r"WARNING.*metadata")),
    ),
    "mcap-ordered-by-topic": DIFFERS,
    "mcap-upper-suffix": (STREAM,),
    "quoted-newline": (Comes(0, (MADE,), (r"not CSV",)),),
    "record-pace-fast": DIFFERS,
    "scene-bom": (Comes(0, (r"scene\.toml: fine",)), Comes(2, (r"byte order mark",))),
    "session-seed-from-time": (
        Comes(
            None,
            (r"no session is kept", r"\bfew\b|\b1 grasps?\b|one grasp|" + A_STREAM),
            (r"no such key",),
        ),
    ),
    "socketcand": (Comes(None, (r"(?m)^2$", r"host", r"port"), (r"trying again",)),),
    "stdin": (TABLE, Comes(2, (r"needs a file",))),
    "stream-10-hz": (STREAM, Comes(None, (r"100 ms|10 (Hz|a second)", r"0 judged", r"\d+ Hz"))),
    "stream-milliseconds": (STREAM, Comes(None, (r"10 s\b", r"\bms\b|milliseconds"))),
    "stream-rostopic-percent-time": NO_TABLE,
    "stream-time-column-named-time": NO_TABLE,
    "sweeps-without-time": (Comes(2, (r"--as|--stream|--rate",), (r"\d+ stable",)),),
    "trailing-comma": (TABLE, Comes(2, (r"empty|trailing",))),
    "train-bom": (TRAINED,),
    "train-counts-with-point": (TRAINED,),
    "train-on-a-stream": (Comes(2, (A_STREAM,), (MADE,)),),
    "train-six-readings-per-grasp": (
        Comes(None, (r"out_six.*F1 [3-6]\d",)),
        Comes(None, (r"same grasp|one grasp|nearly repeat|near cop",)),
    ),
    "two-fingers": (Comes(None, (r"small-session-ff-mf",), (r"column is missing",)),),
}
"""What each case must give, from its `Expected:` alone: one of these."""


class Result(NamedTuple):
    """What a command gave."""

    code: int
    """Exit code; -1 after `LIMIT_S`."""
    output: str
    """Of both streams."""

    def is_one_of(self, expected: tuple[Comes, ...]) -> bool:
        return any(
            one.code in (None, self.code)
            and all(re.search(pattern, self.output) for pattern in one.must)
            and not any(re.search(pattern, self.output) for pattern in one.never)
            for one in expected
        )


def main(arguments: list[str] | None = None) -> int:
    """Run the cases; return 1 if one does not give what it must."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.cases", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("cases", nargs="*", help="names of some (default: all)")
    options = parser.parse_args(arguments)
    given = sorted(path.parent.name for path in options.folder.glob("*/README"))
    held = 0
    names = [name for name in given if not options.cases or name in options.cases]
    for name in names:
        result = run(options.folder.resolve() / name)
        expected = EXPECTED.get(name)
        fine = expected is not None and result.is_one_of(expected)
        held += fine
        mark = "ok" if fine else "unknown" if expected is None else "FAILED"
        sys.stdout.write(f"{mark:8}{name}: exit code {result.code}\n")
        for line in () if fine else result.output.splitlines()[-SHOWN:]:
            sys.stdout.write(f"        {line[:200]}\n")
        sys.stdout.flush()
    sys.stdout.write(f"{held} of {len(names)}\n")
    return 0 if held == len(names) else 1


def run(case: Path) -> Result:
    """Run a case's command in a copy of its folder."""
    with tempfile.TemporaryDirectory(prefix="graspd-case-") as scratch:
        home = Path(scratch)
        (home / "data").symlink_to(case.parents[1] / "data")
        (home / "cases").mkdir()
        copy = home / "cases" / case.name
        shutil.copytree(case, copy, copy_function=shutil.copyfile)
        copy.chmod(0o755)
        for path in copy.iterdir():
            with contextlib.suppress(UnicodeDecodeError):
                path.write_bytes(_adapted(path.read_bytes().decode(), home).encode())
        readme = (copy / "README").read_text()
        line = next(line for line in readme.splitlines() if line.startswith(COMMAND))
        command = _adapted(line.removeprefix(COMMAND), home)
        _programs(home / "bin")
        return _shell(command, copy, home / "bin")


def _adapted(text: str, home: Path) -> str:
    for word, place in (("BUGS", home), ("CHECKOUT", ROOT)):
        text = re.sub(rf"\b{word}\b", str(place), text)
    for former, key in RENAMED.items():
        text = text.replace(former, key)
    return text


def _programs(folder: Path) -> None:
    """Make `PY` and `graspd`."""
    folder.mkdir()
    installed = Path(sysconfig.get_path("scripts")) / "graspd"
    for name, program in (("PY", Path(sys.executable)), ("graspd", installed)):
        script = folder / name
        script.write_text(f'#!/bin/sh\nexec "{program}" "$@"\n')
        script.chmod(0o755)


def _shell(command: str, folder: Path, programs: Path) -> Result:
    environment = os.environ | {"PATH": f"{programs}:{os.environ['PATH']}"}
    with subprocess.Popen(
        ["bash", "-c", command],
        cwd=folder,
        env=environment,
        text=True,
        errors="replace",
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    ) as shell:
        try:
            output, _ = shell.communicate(timeout=LIMIT_S)
        except subprocess.TimeoutExpired:
            os.killpg(shell.pid, signal.SIGKILL)
            return Result(-1, f"not done after {LIMIT_S:g} s")
        with contextlib.suppress(ProcessLookupError):
            os.killpg(shell.pid, signal.SIGKILL)  # what it left running
        return Result(shell.returncode, output.replace(f"{folder}/", ""))


if __name__ == "__main__":
    sys.exit(main())
