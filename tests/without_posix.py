"""`python tests/without_posix.py COMMAND...`: run graspd where Python lacks POSIX, as on Windows.

`-c CODE` runs a program, `--refused` prints which modules of graspd cannot be imported. Libraries
are imported before anything is taken away: they know this system by `sys.platform`.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import pkgutil
import select
import selectors
import shutil
import signal
import socket
import stat
import sys
import time
from types import ModuleType
from typing import Any, Final

LIBRARIES: Final = (
    *("asyncio", "http.server", "multiprocessing.pool", "subprocess", "tempfile", "webbrowser"),
    *("can", "lz4.frame", "mcap.reader", "msgspec", "numpy", "onnxruntime", "pandas"),
    *("pyarrow.parquet", "pydantic", "rich.live", "serial", "zmq.auth", "zstandard"),
)
TRAINING: Final = (
    *("torch.onnx", "torch._dynamo", "joblib.externals.loky", "sklearn.svm", "onnxscript"),
    *("skl2onnx", "sklearn.model_selection"),
)
MODULES: Final = ("fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty")
CALLS: Final = """
    O_CLOEXEC O_DIRECTORY O_DSYNC O_NOCTTY O_NOFOLLOW O_NONBLOCK O_SYNC EFD_CLOEXEC SCHED_OTHER
    chown eventfd eventfd_read eventfd_write fchmod fchown fdatasync fork forkpty getegid geteuid
    getgid getgroups getloadavg getpgid getpriority getuid killpg mkfifo nice openpty pidfd_open
    pipe2 pread pwrite register_at_fork sched_getaffinity sched_param sched_setaffinity
    sched_setscheduler setpriority setsid statvfs sysconf ttyname uname
"""
"""Names of `os` that Python for Windows lacks."""
SIGNALS: Final = {"SIGABRT", "SIGFPE", "SIGILL", "SIGINT", "SIGSEGV", "SIGTERM"}
FAMILIES: Final = ("AF_UNIX", "AF_CAN", "PF_CAN", "SOCK_CLOEXEC", "SOCK_NONBLOCK")


def main(arguments: list[str]) -> int:
    """Take POSIX away, then run what the arguments name; return the exit code."""
    for name in LIBRARIES + (TRAINING if "train" in arguments else ()):
        with contextlib.suppress(ModuleNotFoundError):
            importlib.import_module(name)
    take_away()
    if arguments == ["--refused"]:
        sys.stdout.writelines(f"{name}\n" for name in refused())
        return 0
    if arguments[0] == "-c":
        exec(compile(arguments[1], "program", "exec"), {})
        return 0
    sys.argv[1:] = arguments
    return int(importlib.import_module("graspd.daemon.__main__").main())


def take_away() -> None:
    """Take away what Windows lacks; refuse to open folders, and to wait for others than sockets."""
    for module in MODULES:
        sys.modules[module] = None  # type: ignore[assignment]
    _remove(os, *CALLS.split())
    _remove(select, *(name for name in dir(select) if "poll" in name.lower()))
    _remove(selectors, "PollSelector", "EpollSelector")
    _remove(
        signal, *(n for n in dir(signal) if n[:3] == "SIG" and n[3] != "_" and n not in SIGNALS)
    )
    _remove(time, *(name for name in dir(time) if name.lower().startswith("clock_")))
    pair, family = socket.socketpair, socket.AF_UNIX
    _remove(socket, *FAMILIES)
    by_hand: Any = {
        (socket, "socketpair"): lambda: pair(family),
        (os, "open"): _open_of(os.open),
        (select, "select"): _select_of(select.select),
        (shutil, "_use_fd_functions"): False,
        (selectors, "DefaultSelector"): selectors.SelectSelector,
        (selectors.SelectSelector, "_select"): staticmethod(_select_of(select.select)),
    }
    for (owner, name), call in by_hand.items():
        setattr(owner, name, call)


def refused() -> list[str]:
    """Return the modules of graspd that cannot be imported; those for training are left out."""
    names = []
    package = importlib.import_module("graspd")
    for found in pkgutil.walk_packages(package.__path__, "graspd."):
        if found.name.startswith("graspd.models.training"):
            continue
        try:
            importlib.import_module(found.name)
        except ModuleNotFoundError as error:
            if error.name in MODULES:
                names.append(found.name)
        except AttributeError:
            names.append(found.name)
    return names


def _remove(module: ModuleType, *names: str) -> None:
    for name in names:
        if hasattr(module, name):
            delattr(module, name)


def _open_of(real: Any) -> Any:  # noqa: ANN401
    def call(path: Any, *rest: Any, **named: Any) -> int:  # noqa: ANN401
        if os.path.isdir(path):
            raise PermissionError(13, "Permission denied", path)
        return int(real(path, *rest, **named))

    return call


def _select_of(real: Any) -> Any:  # noqa: ANN401
    def call(*lists: Any) -> Any:  # noqa: ANN401
        for one in (one for many in lists[:3] for one in many):
            descriptor = one if isinstance(one, int) else one.fileno()
            if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                raise OSError(10038, "not a socket")
        return real(*lists)

    return call


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
