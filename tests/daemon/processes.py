"""Running graspd, and a subscriber to it, as processes of their own."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from tests.kit.waiting import wait_until

GRASPD = (sys.executable, "-m", "graspd")
WITH_CONSTANTS = """
import importlib, sys
module, _, constants = sys.argv[1].partition(":")
vars(importlib.import_module(module)).update(eval(constants))
from graspd.daemon.__main__ import main
del sys.argv[1]
sys.exit(main())
"""
TIMEOUT_S = 200
NICENESS = -15

SUBSCRIBER = """
import sys, zmq
endpoint, wanted = sys.argv[1], int(sys.argv[2])
with zmq.Context() as context, context.socket(zmq.SUB) as socket:
    socket.connect(endpoint)
    socket.subscribe("verdict.")
    for _ in range(wanted):
        if not socket.poll(100_000):
            break
        topic, payload = socket.recv_multipart()
        print(payload.decode())
"""
"""Plain pyzmq: prints the verdicts that come at an endpoint, up to a number."""


class Started(subprocess.Popen[str]):
    """A process that is killed, not waited for, if the test fails."""

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        if kind is not None:
            self.kill()
        super().__exit__(kind, *rest)  # type: ignore[arg-type]


def graspd_with(module: str, **constants: object) -> tuple[str, ...]:
    """Words that start `graspd` after `constants` of the module named `module` are replaced."""
    return (sys.executable, "-c", WITH_CONSTANTS, f"{module}:{constants!r}")


def start(
    *arguments: object, before: Sequence[str] = (), program: Sequence[str] = GRASPD
) -> Started:
    """Start graspd, or `program`, with `arguments`, after the words `before`; leave it running.

    Without `before` its priority is raised if the system permits: other tests may run meanwhile.
    """
    process = Started(
        [*before, *program, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    if not before:
        put_first(process.pid)
    return process


def put_first(pid: int) -> None:
    """Raise the priority of a process if the system permits."""
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, pid, NICENESS)


@contextlib.contextmanager
def before_others() -> Iterator[None]:
    """Raise the priority of this thread, and of what it starts, if the system permits."""
    former = os.getpriority(os.PRIO_PROCESS, 0)
    put_first(0)
    try:
        yield
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, former)


def wait_for(path: Path) -> None:
    """Wait until a file exists."""
    wait_until(path.exists, 0.01, says=f"{path} did not appear")
