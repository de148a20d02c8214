"""A process with more descriptors open than `select` can wait on."""

from __future__ import annotations

import contextlib
import os
import resource
from collections.abc import Iterator

import pytest

DESCRIPTORS = 2000
SELECT_MAX = 1024
"""Descriptors from this number on fail in `select` (FD_SETSIZE of Linux)."""


@contextlib.contextmanager
def crowded() -> Iterator[None]:
    """Hold `DESCRIPTORS` descriptors, so that a new one is above `SELECT_MAX`.

    Skips the test if the system allows fewer than twice `DESCRIPTORS`.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if 0 <= hard < 2 * DESCRIPTORS:
        pytest.skip(f"at most {hard} descriptors are allowed here")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 2 * DESCRIPTORS), hard))
    with contextlib.ExitStack() as stack:
        stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        for _ in range(DESCRIPTORS):
            stack.callback(os.close, os.open(os.devnull, os.O_RDONLY))
        yield
