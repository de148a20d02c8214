"""A serial port that never blocks the loop: pyserial, with its many failures made one."""

from __future__ import annotations

import errno
import logging
import os
import select
import termios
import time
from collections.abc import Callable
from enum import IntEnum

import serial

from drivers.base import DriverError, LinkCause, LinkError

READ_BYTES = 4096
"""A terminal hands over no more than this at once."""
SHORT_BYTES = READ_BYTES // 2
"""A terminal that hands over less has no more: while more waits behind it, it is kept full."""
READS_MAX = 32
"""Reads in one go: more than a kernel buffers (64 KiB), so that a flood cannot hold the loop."""
DRAIN_TRIES, DRAIN_TRY_S = 10, 0.002
"""Patience with the last few bytes when a port is closed."""
WRITE_TIMEOUT_S = 0.05
"""Longest wait for room that was there a moment ago."""

_log = logging.getLogger(__name__)


class LineEvent(IntEnum):
    """What happened on a line."""

    RECEIVED = 1
    SENT = 2
    OPENED = 3
    """The port was opened: what came before is over."""


class SerialLine:
    """One port by device name (better `/dev/serial/by-id/...`) or URL as pyserial has them.

    `LinkError` means that the device is not there or went away. Opening and closing a `socket://`
    or `rfc2217://` port can take seconds: they are for trying things out.
    """

    def __init__(self, port: str, baud: int) -> None:
        """`baud` means nothing to a USB CDC device."""
        self.port = port
        self.drained = True
        """Whether the last `read` left nothing behind."""
        self.tap: Callable[[LineEvent, bytes], None] | None = None
        """Gets all bytes that are read, and those that are about to be written."""
        self._baud = baud
        self.descriptor: int | None = None
        """To wait on; None while closed, and for a kind of port that must be polled."""
        self._serial: serial.Serial | None = None
        self._terminal: int | None = None
        """Its descriptor, where the port is a terminal, which is read without pyserial."""

    def open(self) -> None:
        """Take the port for this process alone. Raises `LinkError`, or `DriverError` for ever."""
        self.close()
        try:
            self._serial = serial.serial_for_url(
                self.port,
                self._baud,
                timeout=0,
                write_timeout=WRITE_TIMEOUT_S,
                exclusive=True,
            )
        except (OSError, termios.error) as error:
            raise LinkError.from_errno(error, f"{self.port}: {_reason(error)}") from error
        except ValueError as error:
            raise DriverError(f"{self.port}: {error}") from error
        self.descriptor = self._find_descriptor()
        self._terminal = self.descriptor if type(self._serial) is serial.Serial else None
        self._lower_latency()
        if self.tap is not None:
            self.tap(LineEvent.OPENED, b"")

    def close(self) -> None:
        """Give the port back. May be called more than once; a device that is gone is no error."""
        port, self._serial, self.descriptor = self._serial, None, None
        if port is None:
            return
        try:
            for _ in range(DRAIN_TRIES):
                if not port.out_waiting:
                    break
                time.sleep(DRAIN_TRY_S)
            else:
                port.reset_output_buffer()  # closing would wait up to 30 s for it to drain
        except AttributeError:
            pass  # a port without a buffer of its own
        except (OSError, termios.error) as error:
            _log.debug("%s: %s", self.port, error)
        # pyserial lets go of a socket that was reset by its peer without closing it.
        held = getattr(port, "_socket", None)
        try:
            port.close()
        except (OSError, termios.error) as error:
            _log.debug("%s: %s", self.port, error)
        if held is not None:
            held.close()

    def read(self) -> bytes:
        """All bytes that are there, possibly none. Raises `LinkError`."""
        port, data = self._opened(), b""
        self.drained = False
        try:
            for _ in range(READS_MAX):
                chunk = b"" if self._terminal is None else os.read(self._terminal, READ_BYTES)
                self.drained = 0 < len(chunk) < SHORT_BYTES
                if not chunk:  # of a terminal pyserial tells whether it is still there
                    chunk = port.read(READ_BYTES)
                    self.drained = not chunk
                data += chunk
                if self.drained:
                    break
        except BlockingIOError:
            self.drained = True
        except (OSError, termios.error) as error:
            if not data:  # else the next call says so, after these bytes
                raise self._loss(error) from error
        if self.tap is not None and data:
            self.tap(LineEvent.RECEIVED, data)
        return data

    def write(self, data: bytes) -> bool:
        """Write a few bytes if there is room; False if not. Raises `LinkError`."""
        port = self._opened()
        try:
            if self.descriptor is not None and not select.select([], [self.descriptor], [], 0)[1]:
                return False
            if self.tap is not None:
                self.tap(LineEvent.SENT, data)
            port.write(data)
        except serial.SerialTimeoutException:
            return False
        except (OSError, termios.error) as error:
            raise self._loss(error) from error
        return True

    def _loss(self, error: Exception) -> LinkError:
        _log.debug("%s", error)
        return LinkError(LinkCause.DISCONNECTED, f"{self.port}: the device went away")

    def _opened(self) -> serial.Serial:
        if self._serial is None:
            raise RuntimeError(f"{self.port} is not open")
        return self._serial

    def _find_descriptor(self) -> int | None:
        try:
            return self._opened().fileno()
        except (OSError, AttributeError):
            return None

    def _lower_latency(self) -> None:
        """An FTDI adapter then hands over bytes every 1 ms, not 16; others do not know the call."""
        try:
            self._opened().set_low_latency_mode(True)
        except (OSError, ValueError, AttributeError) as error:
            _log.debug("%s: no low latency mode: %s", self.port, error)


def _reason(error: Exception) -> str:
    """One short line; pyserial's own say the port's name twice, or several things at once."""
    number = getattr(error, "errno", None)
    if number in (errno.EAGAIN, errno.EBUSY):
        return "another program has it open"
    if number is not None:
        return os.strerror(number).lower()
    return str(error).partition("\n")[0]
