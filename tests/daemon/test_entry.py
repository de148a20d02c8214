"""The program's entry: another package in the way of graspd's own is named."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from base64 import urlsafe_b64encode
from hashlib import sha256
from pathlib import Path

import pytest

from daemon.entry import OURS

ROOT = Path(__file__).parents[2]
THEIRS = '"""Somebody else\'s."""\n'


def entered(path: Path, entry: Path = ROOT / "daemon/entry.py") -> subprocess.CompletedProcess[str]:
    """What the entry does where `path` comes first."""
    return subprocess.run(
        [sys.executable, str(entry), "--version"],
        env={**os.environ, "PYTHONPATH": str(path)},
        capture_output=True,
        text=True,
        check=False,
    )


def record(path: Path, content: str) -> str:
    digest = urlsafe_b64encode(sha256(content.encode()).digest()).rstrip(b"=").decode()
    return f"{path},sha256={digest},{len(content)}\n"


def distribution(site: Path, name: str, files: dict[str, str]) -> None:
    """What pip leaves of an installed package beside its files."""
    info = site / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "RECORD").write_text("".join(record(Path(path), files[path]) for path in files))


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
    shutil.copy(ROOT / "daemon/entry.py", tmp_path / "graspd.py")
    inits = {f"{each}/__init__.py": (ROOT / each / "__init__.py").read_text() for each in OURS}
    distribution(tmp_path, "graspd", inits)
    done = entered(tmp_path, tmp_path / "graspd.py")
    assert (done.returncode, done.stderr) == (0, "")
    (tmp_path / name / "__init__.py").write_text(THEIRS)
    distribution(tmp_path, f"python-{name}", {f"{name}/__init__.py": THEIRS})
    done = entered(tmp_path, tmp_path / "graspd.py")
    assert (done.returncode, done.stdout) == (2, "")
    assert f"{tmp_path / name} is not graspd's but of the package python-{name}: " in done.stderr


def test_a_file_of_ours_that_somebody_edited_is_no_clash(tmp_path: Path) -> None:
    for package in OURS:
        shutil.copytree(
            ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__")
        )
    distribution(tmp_path, "graspd", {"daemon/__init__.py": "another\n"})
    assert entered(tmp_path).returncode == 0
