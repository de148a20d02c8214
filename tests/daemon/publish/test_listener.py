"""Which process may publish at a path; other files there are never lost."""

from __future__ import annotations

import os
import socket
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from graspd.daemon.publish import PublishError
from graspd.daemon.publish.listener import Listener
from tests.daemon.publish.doors import Publisher


def dead_socket(path: Path) -> None:
    """Leave a socket file without a listener, as a killed daemon does."""
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()


def link_to_a_file(path: Path) -> None:
    path.with_name("kept").write_text("kept")
    path.symlink_to("kept")


OTHERS: dict[str, Callable[[Path], object]] = {
    "file": lambda path: path.write_text("kept"),
    "folder": Path.mkdir,
    "fifo": os.mkfifo,
    "link": link_to_a_file,
    "link to nothing": lambda path: path.symlink_to("absent"),
}


@pytest.mark.parametrize("kind", OTHERS)
@pytest.mark.parametrize("name", ["v", "v.lock"])
def test_foreign_files_at_socket_and_lock_paths_are_refused_and_kept(
    tmp_path: Path, name: str, kind: str
) -> None:
    path = tmp_path / name
    OTHERS[kind](path)
    before = {each.name: each.lstat().st_ino for each in tmp_path.iterdir()}
    why = "is there and is not a socket" if name == "v" else "cannot publish on ipc://"
    with pytest.raises(PublishError, match=why) as error:
        Publisher(f"ipc://{tmp_path}/v")
    assert "\n" not in str(error.value)
    assert {each.name: each.lstat().st_ino for each in tmp_path.iterdir()} == before
    if kind in ("file", "link"):
        assert path.read_text() == "kept"


@pytest.mark.parametrize("kind", [socket.SOCK_STREAM, socket.SOCK_DGRAM, socket.SOCK_SEQPACKET])
def test_the_socket_of_a_running_program_is_refused_and_kept(tmp_path: Path, kind: int) -> None:
    path = tmp_path / "v"
    with socket.socket(socket.AF_UNIX, kind) as theirs:
        theirs.bind(str(path))
        if kind != socket.SOCK_DGRAM:
            theirs.listen(0)
        for _ in range(2):  # the second time its queue is full
            with pytest.raises(PublishError, match="v is the socket of another program that runs"):
                Publisher(f"ipc://{path}")
        assert [each.name for each in tmp_path.iterdir()] == ["v"]


def test_a_second_graspd_on_the_same_path_is_refused(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint):
        with pytest.raises(PublishError, match="another graspd"):
            Publisher(endpoint)
        assert sorted(each.name for each in tmp_path.iterdir()) == ["v", "v.lock"]
        assert stat.S_IMODE((tmp_path / "v.lock").stat().st_mode) == 0o600


def test_a_socket_left_by_a_killed_daemon_is_taken_over(tmp_path: Path) -> None:
    dead_socket(tmp_path / "v")
    (tmp_path / "v.lock").touch()
    with Publisher(f"ipc://{tmp_path}/v"), socket.socket(socket.AF_UNIX) as client:
        client.connect(str(tmp_path / "v"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["file", "socket"])
def test_closing_keeps_a_file_that_replaced_the_socket(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "v"
    with Publisher(f"ipc://{path}"):
        path.unlink()
        if kind == "file":
            path.write_text("kept")
        else:
            dead_socket(path)
    assert [each.name for each in tmp_path.iterdir()] == ["v"]


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("absent/v", "there is no folder .*/absent; `graspd doctor SCENE` says who makes it"),
        ("file/v", "Not a directory"),
        (".", "is there and is not a socket"),
        ("x" * 200, "AF_UNIX path too long"),
        ("/proc/graspd", r"cannot publish on ipc:///proc/graspd: \w"),  # not even root may
    ],
)
def test_an_unusable_path_is_refused_with_one_line(tmp_path: Path, path: str, says: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(PublishError, match=says) as error:
        Publisher(f"ipc://{tmp_path / path}")
    assert "\n" not in str(error.value)
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


def test_ipv6_on_a_kernel_without_it_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_arguments: object) -> None:
        raise OSError(97, "Address family not supported by protocol")  # socket(2)

    monkeypatch.setattr(socket, "socket", fail)
    with pytest.raises(PublishError, match="Address family not supported by protocol"):
        Listener("tcp://[::1]:5555")


def test_a_bind_that_fails_leaves_no_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Listener, "_bind", fail)
    with pytest.raises(PublishError, match="No space left"):
        Publisher(f"ipc://{tmp_path}/v")
    assert list(tmp_path.iterdir()) == []
