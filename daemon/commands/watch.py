"""`graspd watch`: see what the daemon says, in a terminal or in a browser."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from pathlib import Path

import zmq

from graspd.daemon import scene
from graspd.daemon.commands.arguments import UsageError
from graspd.daemon.process.files import is_linux
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.process.text import complain
from graspd.daemon.watch.feed import Feed, load_keys
from graspd.daemon.watch.view import TICK_S, HandFeed, View
from graspd.extras import needs

ENDPOINT = "ipc:///run/graspd/right.ipc"
"""Default endpoint of the daemon."""
PORT = 8377
FOXGLOVE_PORT = 8765
"""Default port of Foxglove's viewers."""
NICENESS = 10
"""Niceness of the viewer, so that a daemon comes first. Drawing takes a tenth of a processor."""
HANDS_MAX = 8
"""Most hands in one page or terminal."""
FAILED = 1

SCENES, SOCKETS = Path("/etc/graspd"), Path("/run/graspd")
"""Folders of the service's scenes and sockets (deploy/systemd)."""


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
    """Show until stopped; return 1 if the port is not available. Raises `UsageError`."""
    if args.server_key is not None and args.keys is None:
        raise UsageError("--server-key is for a daemon with [curve]: it needs --keys")
    if args.port is not None and not (args.web or args.foxglove):
        raise UsageError("--port needs --web or --foxglove")
    if hasattr(os, "nice"):
        os.nice(NICENESS)
    with contextlib.ExitStack() as stack:
        hands = _hands(args, stack)
        if args.foxglove:
            return _foxglove(hands, args.port or FOXGLOVE_PORT)
        return _page(hands, args.port or PORT) if args.web else _terminal(hands)


def _port(text: str) -> int:
    if not text.isdecimal() or not 0 < int(text) < 65536:
        raise argparse.ArgumentTypeError(f"{text} is not a port of 1 to 65535")
    return int(text)


def _hands(args: argparse.Namespace, stack: contextlib.ExitStack) -> list[HandFeed]:
    """Connect to the daemons, until `stack` closes."""
    if args.connect and args.scenes:
        raise UsageError("--connect takes the place of scenes: give one or the other")
    number = len(args.connect or args.scenes)
    if number > HANDS_MAX:
        raise UsageError(f"{number} hands are more than the {HANDS_MAX} that can be watched")
    if not args.scenes:
        endpoints = args.connect or [ENDPOINT]
        return [_hand(args, stack, endpoint, args.server_key) for endpoint in endpoints]
    hands = []
    for path in args.scenes:
        wanted = scene.load(path)
        server = args.server_key
        if server is None and wanted.curve is not None:
            server = wanted.curve.secret_key.with_suffix(".key")
        hands.append(_hand(args, stack, wanted.endpoint, server, path, wanted.hand.name))
    return hands


def _hand(
    args: argparse.Namespace,
    stack: contextlib.ExitStack,
    endpoint: str,
    server_key: Path | None,
    scene_path: Path | None = None,
    name: str | None = None,
) -> HandFeed:
    """Connect to one daemon. Raises `UsageError` or `KeysError`.

    `server_key`: its public key, needed with `--keys`. `name`: of the hand; None: not known.
    """
    keys = None
    if args.keys is not None:
        if server_key is None:
            raise UsageError("--keys needs --server-key: the daemon's .key file")
        keys = load_keys(args.keys, server_key)
    try:
        feed = stack.enter_context(Feed(endpoint, keys))
    except zmq.ZMQError as error:
        raise UsageError(f"{endpoint}: cannot connect there: {error.strerror}") from error
    return HandFeed(feed, View(endpoint, name, *where_to_look(endpoint, scene_path)))


def where_to_look(endpoint: str, scene_path: Path | None = None) -> tuple[str, str]:
    """Return advice for two cases: the daemon of an endpoint is silent, or has no readings.

    `scene_path` None: the service's scene, if the endpoint is in its folder of sockets.
    """
    socket, where = Path(endpoint.removeprefix("ipc://")), ""
    if scene_path is None and socket.parent == SOCKETS:
        scene_path = SCENES / f"{socket.stem}.toml"
    name = "SCENE" if scene_path is None else str(scene_path)
    if scene_path is not None and scene_path.absolute().parent == SCENES:
        service = f"graspd@{scene_path.stem}"
        look = f"systemctl status {service}; journalctl -u {service}"
    elif scene_path is None and endpoint.startswith("tcp://"):
        where = "on the daemon's computer: "
        look = f"{where}systemctl status 'graspd@*'"
    else:
        look = f"is it started? graspd run {name}"
    return look, f"{where}graspd doctor {name}; the daemon's log says why"


def _terminal(hands: list[HandFeed]) -> int:
    if not is_linux():
        raise UsageError("watch draws on a terminal of Linux alone; see --web")
    if not sys.stdout.isatty():
        raise UsageError("watch draws on a terminal; see --web")
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
