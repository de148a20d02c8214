"""The command line as people type it: help, what is mistyped, versions, the manual."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import zmq

from graspd.daemon.cli import COMMANDS, LIBRARIES, whole_parser
from tests.conftest import ROOT
from tests.daemon.commands.shell_files import PAGE, manual, parsers
from tests.kit.inside import graspd
from tests.kit.programs import ran
from tests.kit.terminal import Terminal

EXTRAS = (
    "torch", "sklearn", "scipy", "joblib", "threadpoolctl", "onnx", "onnxscript", "skl2onnx",
    "rich", "distributed", "matplotlib", "keras", "mcap", "lz4", "zstandard", "foxglove",
)  # fmt: skip
"""Packages that only extras bring."""
LOOP = (ROOT / "deploy/clients/loop.toml").read_text()
CORE_ONLY = f"""
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {EXTRAS!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
from graspd.daemon.cli import main
"""


def test_the_help_of_every_command_needs_no_extra() -> None:
    names = [parser.prog.split()[1:] for parser in parsers(whole_parser())]
    assert len(names) > len(COMMANDS)
    code = f"""{CORE_ONLY}
for words in {names!r}:
    try:
        main([*words, "--help"])
    except SystemExit as left:
        assert left.code == 0, words
    else:
        raise AssertionError(words)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("usage: graspd") == len(names)


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (["train", "svm", "--own", "absent.csv"], "train"),
        (["evaluate", "--data", "absent"], "train"),
        (["report", "worth", "--data", "absent"], "train,report"),
        (["export-grasps", "absent.mcap", "--out", "absent.csv"], "record"),
        (["run", "loop.toml"], "record"),
        (["check", "loop.toml"], "record"),
    ],
)
def test_a_command_without_its_extra_says_how_to_install_it(
    arguments: list[str], extra: str, tmp_path: Path
) -> None:
    own = LOOP.replace("/tmp/graspd-", f"{tmp_path}/").replace("../..", str(ROOT))
    (tmp_path / "loop.toml").write_text(own)
    code = f"{CORE_ONLY}\nsys.exit(main({arguments!r}))"
    done = ran(sys.executable, "-c", code, cwd=tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert f"run {sys.executable} -m pip install '.[{extra}]' in " in line


def test_every_argument_of_every_command_has_help() -> None:
    silent = [
        f"{parser.prog} {action.option_strings or action.dest}"
        for parser in parsers(whole_parser())
        for action in parser.actions
        if not action.help
    ]
    assert silent == []
    assert [parser.prog for parser in parsers(whole_parser()) if not parser.description] == []


@pytest.mark.parametrize(
    ("files_first", "mixed"),
    [
        ("replay A B --json --scene X", "replay A --json --scene X B"),
        ("replay A B --json --scene X", "replay --json A --scene X B"),
        ("watch A B --web --port 8", "watch A --port 8 B --web"),
        ("check A B --json", "check A --json B"),
        ("export-grasps A B --out X", "export-grasps A --out X B"),
        ("evaluate svm cnn1 --jobs 2", "evaluate svm --jobs 2 cnn1"),
        ("report stability svm mlp --quick", "report stability svm --quick mlp"),
    ],
)
def test_options_and_files_come_in_any_order(files_first: str, mixed: str) -> None:
    expected = whole_parser().parse_args(files_first.split())
    assert whole_parser().parse_args(mixed.split()) == expected


def test_the_version_option_prints_python_and_library_versions_too() -> None:
    first, second = graspd("--version").stdout.splitlines()
    assert re.fullmatch(rf"graspd {re.escape(version('graspd'))}( at \S+)?", first)
    told = dict(part.rsplit(" ", 1) for part in second.split(", "))
    assert told.pop("Python") == ".".join(map(str, sys.version_info[:3]))
    assert told.pop("libzmq") == zmq.zmq_version()
    assert told == {name: version(name) for name in LIBRARIES}


@pytest.mark.parametrize(
    ("setting", "is_coloured"), [({}, True), ({"NO_COLOR": "1"}, False), ({"TERM": "dumb"}, False)]
)
def test_verdicts_are_coloured_on_a_terminal_unless_switched_off(
    setting: dict[str, str], is_coloured: bool
) -> None:
    with Terminal("replay", "--verbose", **{"NO_COLOR": "", **setting}) as terminal:
        assert terminal.end() == 0
    assert (b"\x1b[32mstable" in terminal.output) == is_coloured
    assert (b"\x1b" in terminal.output) == is_coloured


@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="argparse says usage otherwise")
def test_the_kept_manual_page_matches_the_parsers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert PAGE.read_text() == manual(), "run: python -m tests.daemon.commands.shell_files"


def test_the_manual_page_is_shown_without_a_warning() -> None:
    man = shutil.which("man")
    if man is None:
        pytest.skip("no man: apt install man-db")
    command = [man, "--local-file", "--warnings", str(PAGE)]
    environment = {**os.environ, "MANWIDTH": "80", "LC_ALL": "C.UTF-8"}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert done.stderr == ""
    shown = " ".join(re.sub(r"\x1b\[[0-9;]*m|.\x08", "", done.stdout).split())
    assert "Make a grasp table of what was recorded" in shown
