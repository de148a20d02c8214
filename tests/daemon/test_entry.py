"""The program's entry: another package in the way of graspd's own is named."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from graspd.daemon.entry import OURS

ROOT = Path(__file__).parents[2]


def entered(path: Path) -> subprocess.CompletedProcess[str]:
    """Run the entry where `path` comes first."""
    return subprocess.run(
        [sys.executable, str(ROOT / "daemon/entry.py"), "--version"],
        env={**os.environ, "PYTHONPATH": str(path)},
        capture_output=True,
        text=True,
        check=False,
    )


def test_all_is_well_where_no_package_is_in_the_way(tmp_path: Path) -> None:
    done = entered(tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("graspd ")


@pytest.mark.parametrize("name", OURS)
def test_a_package_of_the_same_name_that_is_found_first_is_named(name: str, tmp_path: Path) -> None:
    (tmp_path / name).mkdir()
    (tmp_path / name / "__init__.py").write_text('"""Somebody else\'s."""\n')
    done = entered(tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"graspd: {tmp_path / name} is not graspd's: leave {tmp_path} off ")
