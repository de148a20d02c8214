"""`graspd watch`: see what the daemon says, in a terminal or in a browser."""

from __future__ import annotations

import argparse
import os
import select
import sys
from pathlib import Path
from typing import NamedTuple

import zmq

from daemon import scene
from daemon.process.extras import needs
from daemon.process.signals import StopSignal
from daemon.process.text import complain
from daemon.publish.keys import KeysError
from daemon.scene import SceneError
from daemon.watch.feed import Feed, load_keys
from daemon.watch.view import View

ENDPOINT = "ipc:///run/graspd/right.ipc"
"""Where the daemon publishes unless its scene says otherwise."""
PORT = 8377
FOXGLOVE_PORT = 8765
"""Where viewers look unless they are told otherwise."""
TICK_S = 0.02
"""Between two looks at what has come for viewers, s."""
NICENESS = 10
"""Drawing takes a tenth of a processor, and a daemon on the same one comes first."""
FAILED, WRONG = 1, 2


class UsageError(Exception):
    """The command line is wrong; the message says how."""


class Target(NamedTuple):
    """What to subscribe to."""

    endpoint: str
    hand: str | None
    server_key: Path | None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("scene", type=Path, nargs="?", help="scene file of the daemon (TOML)")
    where.add_argument(
        "--connect", metavar="ENDPOINT", help=f"where it publishes (default: {ENDPOINT})"
    )
    parser.add_argument(
        "--keys", type=Path, metavar="FILE", help="own .key_secret file, for a daemon with [curve]"
    )
    parser.add_argument(
        "--server-key",
        type=Path,
        metavar="FILE",
        help="the daemon's .key file (default: as the scene has it)",
    )
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--web", action="store_true", help="serve a page on this computer instead")
    how.add_argument(
        "--foxglove",
        action="store_true",
        help="serve Lichtblick and Foxglove on this computer instead (extra: foxglove)",
    )
    parser.add_argument(
        "--port", type=_port, help=f"of the page ({PORT}), or for viewers ({FOXGLOVE_PORT})"
    )


def run(args: argparse.Namespace) -> int:
    """Show until stopped; 2 for a wrong command line, 1 if the page's port is not to be had."""
    os.nice(NICENESS)
    try:
        target = _target(args)
        with Feed(target.endpoint, _keys(args, target)) as feed:
            view = View(target.endpoint, target.hand)
            if args.foxglove:
                return _foxglove(feed, args.port or FOXGLOVE_PORT)
            return _page(feed, view, args.port or PORT) if args.web else _terminal(feed, view)
    except (SceneError, KeysError, UsageError) as error:
        complain(error)
    except zmq.ZMQError as error:
        complain(f"{args.connect}: cannot connect there: {error.strerror}")
    return WRONG


def _port(text: str) -> int:
    if not text.isdecimal() or not 0 < int(text) < 65536:
        raise argparse.ArgumentTypeError(f"{text} is not a port of 1 to 65535")
    return int(text)


def _target(args: argparse.Namespace) -> Target:
    if args.scene is None:
        return Target(args.connect or ENDPOINT, None, args.server_key)
    wanted = scene.load(args.scene)
    server = args.server_key
    if server is None and wanted.curve is not None:
        server = wanted.curve.secret_key.with_suffix(".key")
    return Target(wanted.endpoint, wanted.hand.name, server)


def _keys(args: argparse.Namespace, target: Target) -> tuple[bytes, bytes, bytes] | None:
    if args.keys is None:
        return None
    if target.server_key is None:
        raise UsageError("--keys needs --server-key: the daemon's .key file")
    return load_keys(args.keys, target.server_key)


def _terminal(feed: Feed, view: View) -> int:
    if not sys.stdout.isatty():
        raise UsageError("watch draws on a terminal; see --web, or `graspd run --print` for a pipe")
    try:
        from daemon.watch.screen import can_draw, show
    except ModuleNotFoundError as error:
        advice = needs("watch", "watch", error)
        raise UsageError(f"{advice}; or watch --web, which needs none") from None
    if not can_draw():
        raise UsageError("watch cannot draw on this terminal (TERM); see --web")
    show(feed, view)
    return 0


def _page(feed: Feed, view: View, port: int) -> int:
    from daemon.watch.web import serve

    try:
        serve(feed, view, port)
    except OSError as error:
        complain(f"cannot serve a page on port {port}: {error.strerror}")
        return FAILED
    return 0


def _foxglove(feed: Feed, port: int) -> int:
    try:
        from daemon.record.live import LiveServer
    except ModuleNotFoundError as error:
        raise UsageError(needs("watch --foxglove", "foxglove", error)) from None
    try:
        server = LiveServer(port)
    except RuntimeError as error:
        complain(f"cannot serve viewers on port {port}: {error}")
        return FAILED
    with StopSignal() as stop, server:
        sys.stdout.write(f"ws://127.0.0.1:{server.port} (Ctrl-C ends)\n")
        sys.stdout.flush()
        while stop.received is None:
            for topic, payload in feed.take():
                server.send(topic, payload)
            select.select([stop.fileno()], [], [], TICK_S)
    return 0
