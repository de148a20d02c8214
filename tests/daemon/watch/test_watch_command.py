"""`graspd watch` as a process: in a terminal of its own, on a port, with keys, and used wrongly."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pty
import re
import signal
import socket
import struct
import subprocess
import termios
from pathlib import Path
from typing import Self

import pytest

from graspd.daemon.judge.reasons import Decision
from tests.daemon.processes import GRASPD, start
from tests.daemon.watch.watch_fakes import Talker
from tests.kit.waiting import PATIENCE_S, wait_until
from tests.ports import free_port

ENTER, LEAVE = b"\x1b[?1049h", b"\x1b[?1049l"
"""Codes that enter and leave the alternate screen (xterm)."""


@pytest.fixture
def port() -> int:
    return free_port()


class Terminal:
    """A pseudo-terminal in which `graspd watch` runs."""

    def __init__(self, *arguments: str, columns: int = 80, lines: int = 24) -> None:
        self._arguments = arguments
        self._size = struct.pack("HHHH", lines, columns, 0, 0)
        self.output = b""

    def __enter__(self) -> Self:
        self._ours, theirs = pty.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, self._size)
        self.former = termios.tcgetattr(self._ours)
        self.process = subprocess.Popen(
            ["setsid", "--ctty", *GRASPD, "watch", *self._arguments],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            env={**os.environ, "TERM": "xterm-256color"},
        )
        os.close(theirs)
        return self

    def __exit__(self, *_details: object) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._ours)

    def read_until(self, pattern: bytes) -> None:
        """Wait until what the command writes from now on matches `pattern`."""
        self.output = b""
        os.set_blocking(self._ours, False)
        wait_until(lambda: self.read() or re.search(pattern, self.output, re.DOTALL), 0.02)

    def read(self) -> bool:
        """Add what the command has written to `output`; always return False."""
        with contextlib.suppress(BlockingIOError, OSError):
            while part := os.read(self._ours, 1 << 16):
                self.output += part
        return False

    def type(self, keys: bytes) -> None:
        os.write(self._ours, keys)

    def resize(self, columns: int, lines: int) -> None:
        fcntl.ioctl(self._ours, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))

    def end(self) -> int:
        """Wait until the command ends; return its exit code."""
        wait_until(lambda: self.read() or self.process.poll() is not None, 0.02)
        self.read()
        return self.process.returncode

    def settings(self) -> list[object]:
        return termios.tcgetattr(self._ours)


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return f"ipc://{tmp_path}/v"


def test_watch_in_a_terminal_shows_verdicts_and_ends_cleanly(endpoint: str) -> None:
    with Talker(endpoint) as talker, Terminal("--connect", endpoint) as terminal:
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


def test_several_scenes_are_one_page_of_one_process(tmp_path: Path, port: int) -> None:
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
