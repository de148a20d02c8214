"""`graspd watch`: see what the daemon says, in a terminal or in a browser."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from pathlib import Path
from typing import NamedTuple

import zmq

from graspd.daemon import scene
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.process.text import complain
from graspd.daemon.publish.keys import KeysError
from graspd.daemon.scene import SceneError
from graspd.daemon.watch.feed import Feed, load_keys
from graspd.daemon.watch.view import TICK_S, HandFeed, View
from graspd.extras import needs

ENDPOINT = "ipc:///run/graspd/right.ipc"
"""Default endpoint of the daemon."""
PORT = 8377
FOXGLOVE_PORT = 8765
"""Default port of Foxglove's viewers."""
NICENESS = 10
"""A daemon on the same processor comes first: drawing takes a tenth of one."""
HANDS_MAX = 8
"""Most hands in one page or terminal."""
FAILED, WRONG = 1, 2

SCENES, SOCKETS = Path("/etc/graspd"), Path("/run/graspd")
"""Folders of the service's scenes and sockets (deploy/systemd)."""


class Target(NamedTuple):
    """One daemon to watch."""

    endpoint: str
    hand: str | None
    server_key: Path | None
    look: str
    """Place to look at if it is silent, for people."""
    doctor: str
    """Place to look at if it has no readings, for people."""


class UsageError(Exception):
    """The command line is wrong; the message says how."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "scenes",
        type=Path,
        nargs="*",
        default=[],
        metavar="scene",
        help="scene file of a daemon (TOML); with several, all their hands are seen",
    )
    parser.add_argument(
        "--connect",
        action="append",
        default=[],
        metavar="ENDPOINT",
        help=f"where a daemon publishes, instead of scenes; may be repeated (default: {ENDPOINT})",
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
    """Show until stopped; 2 for a wrong command line, 1 if the port cannot be had."""
    os.nice(NICENESS)
    try:
        with contextlib.ExitStack() as stack:
            hands = []
            for target in _targets(args):
                keys = _keys(args, target.server_key)
                feed = stack.enter_context(_feed(target.endpoint, keys))
                view = View(target.endpoint, target.hand, target.look, target.doctor)
                hands.append(HandFeed(feed, view))
            if args.foxglove:
                return _foxglove(hands, args.port or FOXGLOVE_PORT)
            return _page(hands, args.port or PORT) if args.web else _terminal(hands)
    except (SceneError, KeysError, UsageError) as error:
        complain(error)
    return WRONG


def _feed(endpoint: str, keys: tuple[bytes, bytes, bytes] | None) -> Feed:
    try:
        return Feed(endpoint, keys)
    except zmq.ZMQError as error:
        problem = f"{endpoint}: cannot connect there: {error.strerror}"
        raise UsageError(problem) from error


def _port(text: str) -> int:
    if not text.isdecimal() or not 0 < int(text) < 65536:
        raise argparse.ArgumentTypeError(f"{text} is not a port of 1 to 65535")
    return int(text)


def _targets(args: argparse.Namespace) -> list[Target]:
    if args.connect and args.scenes:
        raise UsageError("--connect takes the place of scenes: give one or the other")
    endpoints = args.connect or ([] if args.scenes else [ENDPOINT])
    targets = [
        Target(endpoint, None, args.server_key, where_to_look(endpoint), where_to_examine(endpoint))
        for endpoint in endpoints
    ]
    for path in args.scenes:
        wanted = scene.load(path)
        server = args.server_key
        if server is None and wanted.curve is not None:
            server = wanted.curve.secret_key.with_suffix(".key")
        look, doctor = where_to_look(wanted.endpoint, path), where_to_examine(wanted.endpoint, path)
        targets.append(Target(wanted.endpoint, wanted.hand.name, server, look, doctor))
    if len(targets) > HANDS_MAX:
        raise UsageError(f"{len(targets)} hands are more than the {HANDS_MAX} that can be watched")
    return targets


def where_to_look(endpoint: str, scene_path: Path | None = None) -> str:
    """Return the commands that show why the daemon of an endpoint is silent."""
    socket = Path(endpoint.removeprefix("ipc://"))
    if scene_path is not None and scene_path.absolute().parent == SCENES:
        name = scene_path.stem
    elif scene_path is not None:
        return f"is it started? graspd run {scene_path}"
    elif socket.parent == SOCKETS:
        name = socket.stem
    elif endpoint.startswith("tcp://"):
        return "on the daemon's computer: systemctl status 'graspd@*'"
    else:
        return "is it started? graspd run SCENE"
    return f"systemctl status graspd@{name}; journalctl -u graspd@{name}"


def where_to_examine(endpoint: str, scene_path: Path | None = None) -> str:
    """Return the command that shows why the daemon of an endpoint has no readings."""
    socket = Path(endpoint.removeprefix("ipc://"))
    if scene_path is None and socket.parent == SOCKETS:
        scene_path = SCENES / f"{socket.stem}.toml"
    is_far = scene_path is None and endpoint.startswith("tcp://")
    where = "on the daemon's computer: " if is_far else ""
    return f"{where}graspd doctor {scene_path or 'SCENE'}; the daemon's log says why"


def _keys(args: argparse.Namespace, server_key: Path | None) -> tuple[bytes, bytes, bytes] | None:
    if args.keys is None:
        return None
    if server_key is None:
        raise UsageError("--keys needs --server-key: the daemon's .key file")
    return load_keys(args.keys, server_key)


def _terminal(hands: list[HandFeed]) -> int:
    if not sys.stdout.isatty():
        raise UsageError("watch draws on a terminal; see --web, or `graspd run --print` for a pipe")
    try:
        from graspd.daemon.watch.terminal import can_draw, show
    except ModuleNotFoundError as error:
        advice = needs("watch", "watch", error)
        raise UsageError(f"{advice}; or watch --web, which needs none") from None
    if not can_draw():
        raise UsageError("watch cannot draw on this terminal (TERM); see --web")
    show(hands)
    return 0


def _page(hands: list[HandFeed], port: int) -> int:
    from graspd.daemon.watch.web import serve

    try:
        serve(hands, port)
    except OSError as error:
        complain(f"cannot serve a page on port {port}: {error.strerror}; --port takes another")
        return FAILED
    return 0


def _foxglove(hands: list[HandFeed], port: int) -> int:
    try:
        from graspd.daemon.record.live import LiveServer
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
        while not stop.wait(TICK_S):
            for hand in hands:
                for topic, payload in hand.feed.take():
                    server.send(topic, payload)
    return 0
