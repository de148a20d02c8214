"""The C++ client in a process of its own, driven by the orders of probe.cpp."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class Probe:
    """A running probe."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def tell(self, *words: object) -> None:
        """Give it an order, which it reads after the next `flush`."""
        assert self._process.stdin is not None
        self._process.stdin.write(" ".join(map(str, words)) + "\n")

    def ask(self, *words: object) -> str:
        """Give it an order; return the first line of its answer."""
        self.tell(*words)
        self.flush()
        return self.line()

    def flush(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.flush()

    def line(self) -> str:
        """Return the next line that it writes."""
        assert self._process.stdout is not None
        return self._process.stdout.readline().rstrip("\n")

    def send_signal(self, number: signal.Signals) -> None:
        self._process.send_signal(number)


@contextmanager
def probing(binary: Path) -> Iterator[Probe]:
    """Run the probe; fail if its sanitizers find something."""
    with subprocess.Popen(
        [binary], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield Probe(process)
        process.communicate(timeout=200)
        assert process.returncode == 0, "the sanitizers found something"
