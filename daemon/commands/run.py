"""`graspd run SCENE`: the daemon."""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import os
import resource
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from graspd.daemon.process.signals import StopSignal
from graspd.daemon.process.text import complain
from graspd.daemon.publish import PublishError
from graspd.daemon.run.loop import Ended
from graspd.daemon.run.runner import run_scene
from graspd.drivers.base import DriverError, LinkCause, LinkError, RecordingError

if TYPE_CHECKING:
    from graspd.daemon.run.systemd import Systemd

DESCRIPTORS = 65_536
"""Limit of open descriptors, for all peers. libzmq 4.3.5 ends a process that has none left."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("scene", type=Path, help="scene file (TOML)")


def run(args: argparse.Namespace) -> int:
    """Run until stopped; 0 after SIGINT, SIGTERM, SIGHUP or the end of a recording, else 1.

    Raises `SceneError`, `ModelError` or `RecordingError`.
    """
    _allow_descriptors()
    try:
        with ExitStack() as stack:
            stop = stack.enter_context(StopSignal())
            ended = run_scene(args.scene, stop, manager=_manager(stack))
    except RecordingError:
        raise
    except PublishError as error:
        complain(f"{error}{_held_by(error.taken)}")
        return 1
    except DriverError as error:
        taken = None
        if isinstance(error, LinkError) and error.cause is LinkCause.IN_USE:
            taken = error.endpoint
        complain(f"{error}{_held_by(taken)}")
        return 1
    if ended is Ended.SLEPT:
        complain("the computer has slept: start graspd again, as systemd does")
        return 1
    return 0


def _held_by(endpoint: str | None) -> str:
    """Return text that names the processes on the endpoint's port; "" if none is found."""
    if endpoint is None:
        return ""
    from graspd.daemon.doctor.computer import port_holders

    scheme, _, address = endpoint.partition("://")
    holders = port_holders(scheme, int(address.rpartition(":")[2]))
    return f": {'; '.join(map(str, holders))}" if holders else ""


def _allow_descriptors() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = DESCRIPTORS if hard == resource.RLIM_INFINITY else min(DESCRIPTORS, hard)
    if soft != resource.RLIM_INFINITY and soft < limit:
        with contextlib.suppress(OSError):  # forbidden: the service manager has set it
            resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))


def _manager(stack: ExitStack) -> Systemd | None:
    """Return systemd if it started this process and waits for notifications."""
    if "NOTIFY_SOCKET" not in os.environ:
        return None
    from graspd.daemon.run.systemd import Systemd

    manager = Systemd.of(os.environ)
    if manager is not None:
        faulthandler.enable()  # shows where the loop hung when the watchdog ends it
        stack.callback(manager.close)
        stack.callback(manager.stopping)
    return manager
