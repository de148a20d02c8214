"""A disk that hangs until a test lets it continue."""

from __future__ import annotations

import os
import stat
import threading
from typing import Literal

import pytest


class Disk:
    """Makes each `call` that syncs a file set the event `asked`, then wait for `goes_on` (set at
    first; up to 100 s). `written`: number of calls that have waited."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, call: Literal["fsync", "fdatasync"]
    ) -> None:
        self.goes_on, self.asked = threading.Event(), threading.Event()
        self.goes_on.set()
        self.written = 0
        real = getattr(os, call)

        def sync(descriptor: int) -> None:
            if stat.S_ISREG(os.fstat(descriptor).st_mode):  # and not the folder, after the file
                self.asked.set()
                self.goes_on.wait(100)
                self.written += 1
            real(descriptor)

        monkeypatch.setattr(os, call, sync)
