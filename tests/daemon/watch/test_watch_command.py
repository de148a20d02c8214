"""`graspd watch` as a process: in a terminal of its own, on a port, with keys, and used wrongly."""

from __future__ import annotations

import json
import re
import signal
import socket
from pathlib import Path

from graspd.daemon.judge.reasons import Decision
from tests.daemon.processes import start
from tests.daemon.watch.watch_fakes import Talker
from tests.kit.terminal import Terminal
from tests.kit.waiting import PATIENCE_S
from tests.ports import free_port

ENTER, LEAVE = b"\x1b[?1049h", b"\x1b[?1049l"
"""Codes that enter and leave the alternate screen (xterm)."""


def test_watch_in_a_terminal_shows_verdicts_and_ends_cleanly(endpoint: str) -> None:
    with Talker(endpoint) as talker, Terminal("watch", "--connect", endpoint) as terminal:
        terminal.read_until(re.escape(ENTER))
        talker.decision = Decision.SLIP
        terminal.read_until(rb"do not lift")
        assert b"75 %" in terminal.output
        talker.decision = None
        terminal.read_until(rb"no message for [0-9]+ ms")
        talker.decision = Decision.STABLE
        terminal.read_until(rb"judged to hold")
        terminal.type(b"\x1a")  # no old verdict stays behind
        talker.decision = Decision.SLIP
        terminal.read_until(rb"do not lift")
        assert LEAVE not in terminal.output
        terminal.resize(200, 60)
        terminal.read_until(rb"latency")
        terminal.resize(20, 5)
        terminal.read_until(rb"details")
        terminal.output = b""
        terminal.type(b"\x03")
        assert terminal.end() == 0
        assert LEAVE in terminal.output
        assert terminal.settings() == terminal.former


def two_scenes(tmp_path: Path) -> list[str]:
    paths = []
    for hand in ("left", "right"):
        path = tmp_path / f"{hand}.toml"
        path.write_text(
            f'[hand]\nname = "{hand}"\n[tactile]\ndriver = "palm"\n'
            'source = "udp://127.0.0.1:9870"\n'
            f'[publish]\nendpoint = "ipc://{tmp_path}/{hand}"\n'
        )
        paths.append(str(path))
    return paths


def test_several_scenes_are_one_page_of_one_process(tmp_path: Path) -> None:
    port = free_port()
    with (
        Talker(f"ipc://{tmp_path}/right") as talker,
        start("watch", "--web", *two_scenes(tmp_path), "--port", port) as page,
    ):
        talker.decision = Decision.STABLE
        assert page.stdout is not None
        assert page.stdout.readline() == f"http://127.0.0.1:{port}/ (Ctrl-C ends)\n"
        with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as link:
            link.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
            with link.makefile("rb") as lines:
                for line in lines:
                    if b'"stable"' not in line:
                        continue
                    first, second = json.loads(line.removeprefix(b"data: "))
                    if second["tone"] == "stable":
                        break
            page.send_signal(signal.SIGTERM)
            assert page.wait(PATIENCE_S) == 0  # with a page open
        assert (first["tone"], first["headline"]) == ("silent", "no verdict yet")
        assert (second["hand"], second["endpoint"]) == ("right", f"ipc://{tmp_path}/right")
        assert page.stderr is not None
        assert page.stderr.read() == ""
