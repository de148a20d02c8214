"""A Unix socket file that replaces nothing but the socket of a process that has ended."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import grp
import os
import socket
import stat
from contextlib import ExitStack
from pathlib import Path

BACKLOG = 100
"""Connections that may wait to be accepted; as many as libzmq asks for."""


class OccupiedError(Exception):
    """Another file, or a running program's socket, is at the path."""


class SocketFile:
    """Listens at a path. A file there is never replaced, unless it is a socket of a dead process.

    `PATH.lock` is held meanwhile, so that of two that find a dead socket one takes its place and
    the other is refused. `close` removes both files.
    """

    def __init__(self, path: Path, mode: int | None = None, group: str | None = None) -> None:
        """With a `mode` and a `group` of the file, or what the process's are.

        Raises `OccupiedError`, `LookupError` for an unknown group, or `OSError` where no socket can
        be made; leaves no file then.
        """
        self.path = path
        self._mode = mode
        self._group = None if group is None else _group_id(group)
        self._lock_path = Path(f"{path}.lock")
        self._identity: tuple[int, int] | None = None
        self.listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        with ExitStack() as stack:
            stack.callback(self.listener.close)
            _refuse_other_kinds(path)
            self._lock = _lock(self._lock_path)
            stack.callback(self.close)
            self._bind()
            stack.pop_all()

    def _bind(self) -> None:
        try:
            self.listener.bind(str(self.path))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            _refuse_living(self.path)
            self.path.unlink()
            self.listener.bind(str(self.path))
        self._identity = _identity(self.path)
        if self._group not in (None, self.path.stat().st_gid):
            os.chown(self.path, -1, self._group)
        if self._mode is not None:
            os.chmod(self.path, self._mode)
        # Not before: nobody can have connected while the file was everybody's.
        self.listener.listen(BACKLOG)

    def close(self) -> None:
        """Stop listening, and remove both files."""
        self.listener.close()
        with contextlib.suppress(OSError):  # a folder that has gone or was locked: no harm
            if self._identity is not None and _identity(self.path) == self._identity:
                self.path.unlink()
        with contextlib.suppress(OSError):
            self._lock_path.unlink()
        os.close(self._lock)


def _group_id(name: str) -> int:
    try:
        return grp.getgrnam(name).gr_gid
    except KeyError:
        raise LookupError(f"there is no group {name}") from None


def _identity(path: Path) -> tuple[int, int]:
    status = path.lstat()
    return status.st_dev, status.st_ino


def _refuse_other_kinds(path: Path) -> None:
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise OccupiedError(f"{path} is there and is no socket")


def _refuse_living(path: Path) -> None:
    _refuse_other_kinds(path)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            return  # whoever bound it has ended
        except OSError:  # a full queue, another type of socket, no permission: it is somebody's
            pass
    raise OccupiedError(f"{path} is the socket of another program that runs")


def _lock(path: Path) -> int:
    """Descriptor of the lock file, locked."""
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    while True:
        descriptor = os.open(path, flags, 0o600)
        with ExitStack() as stack:
            stack.callback(os.close, descriptor)
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode) or status.st_size:
                raise OccupiedError(f"{path} is there and is no lock of graspd")
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise OccupiedError("another graspd publishes there") from None
            if _is_at(path, status):
                stack.pop_all()
                return descriptor
            # Its former holder removed it while we were opening it.


def _is_at(path: Path, status: os.stat_result) -> bool:
    try:
        return _identity(path) == (status.st_dev, status.st_ino)
    except FileNotFoundError:
        return False
