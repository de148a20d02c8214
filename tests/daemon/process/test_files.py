"""Files are replaced whole or not at all, and reading one never waits; the install command."""

from __future__ import annotations

import errno
import os
import stat
import sys
from pathlib import Path

import pytest

from graspd.daemon.process.files import read_regular, write_atomically
from graspd.extras import installer


def test_a_replaced_file_has_the_given_mode(tmp_path: Path) -> None:
    path = tmp_path / "kept"
    write_atomically(path, b"former")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    write_atomically(path, b"new", mode=0o644)
    assert (path.read_bytes(), stat.S_IMODE(path.stat().st_mode)) == (b"new", 0o644)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("step", ["fsync", "chmod", "replace"])
def test_a_failed_replacement_leaves_the_former_file_unchanged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    path = tmp_path / "kept"
    write_atomically(path, b"former")

    def full(*_arguments: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, step, full)
    with pytest.raises(OSError, match="No space left") as raised:
        write_atomically(path, b"new")
    assert raised.value.filename == str(path)
    assert path.read_bytes() == b"former"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_is_replaced_though_its_folder_cannot_be_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = os.open

    def no_folder(path: Path, flags: int, *mode: int) -> int:
        if path == tmp_path:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        return opened(path, flags, *mode)

    monkeypatch.setattr(os, "open", no_folder)
    write_atomically(tmp_path / "kept", b"new")
    assert (tmp_path / "kept").read_bytes() == b"new"


def test_a_regular_file_is_read_up_to_its_limit(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"12345")
    assert read_regular(tmp_path / "file", 5) == b"12345"
    with pytest.raises(OSError, match="larger than 4 bytes"):
        read_regular(tmp_path / "file", 4)


def test_other_things_than_regular_files_are_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero")):
        with pytest.raises(OSError, match="not a regular file"):
            read_regular(path, 10)
    with pytest.raises(FileNotFoundError):
        read_regular(tmp_path / "nothing", 10)


@pytest.mark.parametrize(
    ("file", "content", "command"),
    [
        ("pyvenv.cfg", "home = /usr/bin\n", "'{}/bin/python 3' -m pip install"),
        ("pipx_metadata.json", "{}", "pipx runpip graspd install"),
        ("pyvenv.cfg", "home = /usr/bin\nuv = 0.4.0\n", "uv pip install --python {}"),
    ],
)
def test_the_install_command_fits_the_tool_that_made_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str, content: str, command: str
) -> None:
    environment = tmp_path / "graspd"
    environment.mkdir()
    monkeypatch.setattr(sys, "prefix", str(environment))
    monkeypatch.setattr(sys, "executable", f"{environment}/bin/python 3")
    assert installer() == f"'{sys.executable}' -m pip install"
    (environment / file).write_text(content)
    assert installer() == command.format(environment)
