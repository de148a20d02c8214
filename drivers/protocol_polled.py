"""Serial ports without `select`, which fails for descriptors of 1024 and more.

The module's name makes it pyserial's handler of `polled://PATH`.
"""

from __future__ import annotations

import errno
import os
from typing import TYPE_CHECKING

import serial

from graspd.drivers.link import is_ready

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer as Buffer

SCHEME = "polled://"

serial.protocol_handler_packages.append(__package__)


class PolledSerial(serial.Serial):
    """A terminal that is read and written without waiting."""

    def read(self, size: int = 1, /) -> bytes:
        """Return the bytes that have arrived, at most `size`. Raises `OSError` after a hang-up."""
        try:
            data = os.read(self.fileno(), size)
            if not data and is_ready(self.fileno()):
                data = os.read(self.fileno(), size)
                if not data:  # a terminal that was hung up is always ready and has nothing
                    raise serial.SerialException(errno.EIO, os.strerror(errno.EIO))
        except BlockingIOError:
            return b""
        return data

    def write(self, data: Buffer, /) -> int:
        """Write all bytes. Raises `SerialTimeoutException` if there is no room, else `OSError`."""
        try:
            written = os.write(self.fileno(), data)
        except BlockingIOError:
            written = 0
        if written < memoryview(data).nbytes:
            raise serial.SerialTimeoutException("the port has no room")
        return written


def serial_class_for_url(url: str) -> tuple[str, type[PolledSerial]]:
    """Return the path in a URL, and the class that opens it."""
    return url.removeprefix(SCHEME), PolledSerial
