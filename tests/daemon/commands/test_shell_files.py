"""The manual page and the completion of shells are those of the commands as they are."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys

import pytest

pytest.importorskip("shtab", reason="needs the extra `test`")
pytest.importorskip("argparse_manpage", reason="needs the extra `test`")

from graspd.models import zoo
from tests.daemon.commands.shell_files import FOLDER, files

LINES = {
    "graspd re": {"replay", "report"},
    "graspd twin ": {"spi", "can", "palm", "joints"},
    "graspd twin spi --st": {"--stuck-clock"},
    "graspd replay --gate ": {"settled", "every"},
    "graspd replay --model ": set(zoo.names()),
    "graspd check README": {"README.md"},
}
"""What is typed, and what is offered for its last word."""
BASH = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))
_shtab_graspd; printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="argparse says usage otherwise")
def test_the_files_are_those_of_these_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    old = [path.name for path, text in files() if path.read_text() != text]
    assert old == [], "run: python -m tests.daemon.commands.shell_files"


@pytest.mark.parametrize("line", LINES)
def test_bash_completes(line: str) -> None:
    command = [
        "bash",
        "--norc",
        "-euc",
        BASH,
        "bash",
        str(FOLDER / "graspd.bash"),
        *line.split(" "),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == LINES[line]


@pytest.mark.parametrize(
    ("shell", "options", "code", "said"),
    [
        ("fish", "--no-config", 'source "{}"; complete -C "graspd twin spi --st"', "--stuck-clock"),
        ("zsh", "-f", 'autoload -U compinit; compinit -D -u; eval "$(<{})"; print $_comps[graspd]',
         "_shtab_graspd"),
    ],
)  # fmt: skip
def test_another_shell_takes_its_script(shell: str, options: str, code: str, said: str) -> None:
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"no {shell}: apt install {shell}")
    command = [program, options, "-c", code.format(FOLDER / f"graspd.{shell}")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert said in done.stdout


def test_the_manual_page_is_shown_without_a_warning() -> None:
    man = shutil.which("man")
    if man is None:
        pytest.skip("no man: apt install man-db")
    command = [man, "--local-file", "--warnings", str(FOLDER / "graspd.1")]
    environment = {**os.environ, "MANWIDTH": "80", "LC_ALL": "C.UTF-8"}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert done.stderr == ""
    shown = " ".join(re.sub(r"\x1b\[[0-9;]*m|.\x08", "", done.stdout).split())
    assert "Make a grasp table of what was recorded" in shown
