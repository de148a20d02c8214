"""Serial ports without `select`, which fails for descriptors of 1024 and more. Nothing waits.

Importing this module lets pyserial open `polled://PATH`: pyserial finds it by its name.
"""

from __future__ import annotations

import errno
import os
from contextlib import suppress

import serial

from graspd.drivers.link import is_ready

SCHEME = "polled://"

_OF_NETWORK = frozenset({"rfc2217", "socket"})
"""Schemes of pyserial's network URLs, whose form can be checked without a device."""

serial.protocol_handler_packages.append(__package__)


class PolledSerial(serial.Serial):
    """A terminal that is read and written without waiting."""

    def read(self, size: int = 1, /) -> bytes:
        """Return the bytes that have arrived, at most `size`. Raises `OSError` after a hang-up."""
        try:
            data = os.read(self.fileno(), size)
            # A terminal that was hung up is always ready and has no data.
            if data or not is_ready(self.fileno()) or (data := os.read(self.fileno(), size)):
                return data
        except BlockingIOError:
            return b""
        raise serial.SerialException(errno.EIO, os.strerror(errno.EIO))

    def write(self, data: bytes, /) -> int:  # type: ignore[override]
        """Write all bytes. Raises `SerialTimeoutException` if not all find room, else `OSError`."""
        try:
            written = os.write(self.fileno(), data)
        except BlockingIOError:
            written = 0
        if written < len(data):
            raise serial.SerialTimeoutException("the port has no room")
        return written


def serial_class_for_url(url: str) -> tuple[str, type[PolledSerial]]:
    """Return the path in a URL, and the class that opens it."""
    return url.removeprefix(SCHEME), PolledSerial


def refuse_url(port: str) -> None:
    """Raise `ValueError` for a URL that pyserial can never open. Opens nothing."""
    scheme, is_url, _ = port.partition("://")
    if not is_url:
        return
    with suppress(serial.SerialException):  # a device that is not there yet
        handler = serial.serial_for_url(port, do_not_open=True)
        if scheme.lower() not in _OF_NETWORK:
            return
        try:
            handler.from_url(port)  # type: ignore[attr-defined]
        except (serial.SerialException, TypeError) as error:
            raise ValueError(f"not of the form {scheme}://HOST:PORT") from error
