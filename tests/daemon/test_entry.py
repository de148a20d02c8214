"""The program's entry: another package in the way of graspd's own is named."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from daemon.entry import OURS

ROOT = Path(__file__).parents[2]
THEIRS = '"""Somebody else\'s."""\n'


def entered(path: Path) -> subprocess.CompletedProcess[str]:
    """Run the entry where `path` comes first."""
    return subprocess.run(
        [sys.executable, str(ROOT / "daemon/entry.py"), "--version"],
        env={**os.environ, "PYTHONPATH": str(path)},
        capture_output=True,
        text=True,
        check=False,
    )


def installed_over_ours(site: Path, name: str) -> None:
    """Write what pip leaves of a package that has an `__init__.py` of the same name."""
    (site / name / "__init__.py").write_text(THEIRS)
    info = site / f"python_{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: python-{name}\nVersion: 1.0\n")
    (info / "RECORD").write_text(f"{name}/__init__.py,,\n")


def test_all_is_well_where_nobody_is_in_the_way(tmp_path: Path) -> None:
    done = entered(tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("graspd ")


@pytest.mark.parametrize("name", OURS)
def test_a_package_of_the_same_name_that_is_found_first_is_named(name: str, tmp_path: Path) -> None:
    (tmp_path / name).mkdir()
    (tmp_path / name / "__init__.py").write_text(THEIRS)
    done = entered(tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"graspd: {tmp_path / name} is not graspd's: ")
    assert "PYTHONPATH" in line


@pytest.mark.parametrize("name", OURS)
def test_a_package_that_was_installed_over_ours_is_named(name: str, tmp_path: Path) -> None:
    for package in OURS:
        shutil.copytree(
            ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__")
        )
    installed_over_ours(tmp_path, name)
    done = entered(tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert f"{tmp_path / name} is not graspd's but of the package python-{name}: " in done.stderr
