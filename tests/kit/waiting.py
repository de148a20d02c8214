"""Waiting for what another thread or process does."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 100.0
"""Longest wait, s: a computer that runs many tests is slow."""


def wait_until(
    condition: Callable[[], object], step_s: float = 0.002, says: str = "it did not happen"
) -> None:
    """Call `condition` every `step_s` until it is true; fail with `says` after `PATIENCE_S`."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, says
        time.sleep(step_s)
