"""Listen on an endpoint; take over the socket file of a process that has ended."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import grp
import os
import pwd
import socket
import stat
from contextlib import ExitStack
from pathlib import Path

from graspd.daemon.publish import PublishError

BACKLOG = 100
"""Connections that wait to be accepted, as in libzmq."""


class Listener:
    """An endpoint, and its listening socket.

    A file at the path of an `ipc://` one is replaced only if it is a socket of a dead process.
    `PATH.lock` decides which of two processes may do that. `close` removes both files.
    """

    def __init__(self, endpoint: str, mode: int | None = None, group: str | None = None) -> None:
        """Listen. Raises `PublishError`, and then leaves no file behind.

        `mode`, `group`: rights and group of an `ipc://` socket's file; None: those of the process.
        """
        self.endpoint = endpoint
        self.socket: socket.socket | None = None
        self._mode = mode
        self._identity: tuple[int, int] | None = None
        self._lock: int | None = None
        if not endpoint.startswith("ipc://"):
            self.socket = _listening(endpoint)
            return
        self._path = Path(endpoint.removeprefix("ipc://"))
        self._lock_path = Path(f"{self._path}.lock")
        try:
            self._take(None if group is None else _group_id(group))
        except (OSError, PublishError) as error:
            self.close()
            why = getattr(error, "strerror", None) or str(error)
            if isinstance(error, FileNotFoundError) and not self._path.parent.exists():
                folder = self._path.parent
                why = f"there is no folder {folder}; `graspd doctor SCENE` says who makes it"
            raise PublishError(f"cannot publish on {endpoint}: {why}") from error

    def _take(self, group: int | None) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        _refuse_other_kinds(self._path)
        self._lock = _locked(self._lock_path)
        self._bind(self.socket, group)

    def _bind(self, made: socket.socket, group: int | None) -> None:
        path = self._path
        try:
            made.bind(str(path))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            _refuse_living(path)
            path.unlink()
            made.bind(str(path))
        self._identity = _identity(path)
        if group is not None and group != path.stat().st_gid:
            os.chown(path, -1, group)
        if self._mode is not None:
            os.chmod(path, self._mode)
        made.listen(BACKLOG)  # last, so that no peer connects before mode and group are set

    def fileno(self) -> int:
        """Return the descriptor of the listening socket; -1 after `close`."""
        return -1 if self.socket is None else self.socket.fileno()

    def close(self) -> None:
        """Stop listening; remove `PATH.lock` and the socket's file, unless it was replaced. May be
        called again."""
        if self.socket is not None:
            self.socket.close()
        lock, self._lock = self._lock, None
        if lock is None:
            return
        with contextlib.suppress(OSError):  # the folder is gone or was locked
            if self._identity is not None and _identity(self._path) == self._identity:
                self._path.unlink()
        with contextlib.suppress(OSError):
            self._lock_path.unlink()
        os.close(lock)


def user_id(name: str) -> int:
    """Return the id of a user named in `ask.tell`, by name or by number. Raises `PublishError`."""
    try:
        return int(name) if name.isdecimal() else pwd.getpwnam(name).pw_uid
    except (KeyError, ValueError):  # ValueError: a number of over 4300 digits
        raise PublishError(f"ask.tell: there is no user {name}") from None


def _listening(endpoint: str) -> socket.socket:
    host, _, port = endpoint.removeprefix("tcp://").rpartition(":")
    family = socket.AF_INET6 if "[" in host else socket.AF_INET
    is_dual = family == socket.AF_INET6 and socket.has_dualstack_ipv6()  # else a `ValueError`
    try:
        made = socket.create_server(
            (host.strip("[]"), int(port)), family=family, backlog=BACKLOG, dualstack_ipv6=is_dual
        )
    except OSError as error:
        refusal = PublishError(f"cannot bind {endpoint}: {os.strerror(error.errno or 0)}")
        if error.errno == errno.EADDRINUSE:
            refusal.taken = endpoint
        raise refusal from error
    made.setblocking(False)
    return made


def _group_id(name: str) -> int:
    try:
        return grp.getgrnam(name).gr_gid
    except KeyError:
        raise PublishError(f"there is no group {name}") from None


def _identity(path: Path) -> tuple[int, int]:
    status = path.lstat()
    return status.st_dev, status.st_ino


def _refuse_other_kinds(path: Path) -> None:
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise PublishError(f"{path} is there and is not a socket")


def _refuse_living(path: Path) -> None:
    _refuse_other_kinds(path)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            return  # the process that bound it has ended
        except OSError:  # a full queue, another type of socket, no permission: the process is alive
            pass
    raise PublishError(f"{path} is the socket of another program that runs")


def _locked(path: Path) -> int:
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    while True:
        descriptor = os.open(path, flags, 0o600)
        with ExitStack() as stack:
            stack.callback(os.close, descriptor)
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode) or status.st_size:
                raise PublishError(f"{path} is there and is not a lock of graspd")
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise PublishError("another graspd publishes there") from None
            if os.fstat(descriptor).st_nlink:
                stack.pop_all()
                return descriptor
            # Its former holder removed the file after we had opened it.
