"""The manual page is that of the commands as they are."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys

import pytest

pytest.importorskip("argparse_manpage", reason="needs the extra `test`")

from tests.daemon.commands.shell_files import PAGE, manual


@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="argparse says usage otherwise")
def test_the_page_is_that_of_these_commands(monkeypatch: pytest.MonkeyPatch) -> None:
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
