"""The standard streams, which may be closed, full, broken or not UTF-8."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

FAILED = 1


def guarded(command: Callable[[], int]) -> int:
    """Run a command whose standard output may fail; return its exit code.

    The code is 0 if the reader has closed the pipe, as in `graspd replay | head`, and 1, with a
    line on stderr, if writing fails otherwise. Characters that the encoding lacks are escaped.
    """
    raw = _take_over()
    try:
        try:
            code = command()
        except (SystemExit, KeyboardInterrupt):
            sys.stdout.flush()
            raise
        sys.stdout.flush()
    except OSError as error:
        if error is not raw.failure:
            raise
        _discard(raw)
        if isinstance(error, BrokenPipeError):
            return 0
        sys.stderr.write(f"graspd: cannot write to standard output: {error.strerror}\n")
        return FAILED
    return code


class _Raw(io.FileIO):
    """A raw stream that keeps the error of a failed write."""

    failure: OSError | None = None

    def write(self, data: ReadableBuffer, /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            self.failure = error
            raise


class _Lossy(io.FileIO):
    """A raw stream that drops what it cannot write."""

    def write(self, data: ReadableBuffer, /) -> int:
        try:
            return super().write(data)
        except OSError:
            return memoryview(data).nbytes


def _take_over() -> _Raw:
    """Replace `sys.stdout` and `sys.stderr`, which drops what it cannot write; return the raw
    stream of stdout."""
    former = sys.stdout
    if isinstance(former, io.TextIOWrapper):
        descriptor = former.fileno()
        encoding, at_once = former.encoding, former.line_buffering or former.write_through
    else:
        # It is closed: no other file may get its descriptor, and writing must fail.
        descriptor = os.open(os.devnull, os.O_RDONLY)
        encoding, at_once = "utf-8", False
    raw = _Raw(descriptor, "wb", closefd=False)
    sys.stdout = io.TextIOWrapper(
        io.BufferedWriter(raw), encoding, "backslashreplace", line_buffering=at_once
    )
    if isinstance(sys.stderr, io.TextIOWrapper):
        descriptor, encoding = sys.stderr.fileno(), sys.stderr.encoding
    else:
        descriptor, encoding = os.open(os.devnull, os.O_WRONLY), "utf-8"
    errors = io.BufferedWriter(_Lossy(descriptor, "wb", closefd=False))
    sys.stderr = io.TextIOWrapper(errors, encoding, "backslashreplace", line_buffering=True)
    return raw


def _discard(raw: _Raw) -> None:
    """Direct the stream to /dev/null, so that the interpreter's flush at its end cannot fail."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, raw.fileno())
    os.close(nowhere)
