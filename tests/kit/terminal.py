"""A terminal of its own for a command of graspd."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import re
import struct
import subprocess
import termios
from typing import Self

from tests.daemon.processes import GRASPD
from tests.kit.waiting import wait_until


class Terminal:
    """A pseudo-terminal in which graspd runs."""

    def __init__(self, *arguments: str, **environment: str) -> None:
        """`environment`: variables that are added to those of the test."""
        self._arguments = arguments
        self._environment = environment
        self.output = b""

    def __enter__(self) -> Self:
        self._ours, theirs = pty.openpty()
        self.resize(80, 24)
        os.set_blocking(self._ours, False)
        self.former = termios.tcgetattr(self._ours)
        self.process = subprocess.Popen(
            ["setsid", "--ctty", *GRASPD, *self._arguments],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            env={**os.environ, "TERM": "xterm-256color", **self._environment},
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
