"""Driver of the SPI bridge: a microcontroller that samples BioTac SPs and streams their words.

Its serial port never blocks; all failures of pyserial become `LinkError`.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import select
import termios
import time
from collections.abc import Callable, Sequence

import serial

from graspd.drivers.base import DriverError, Fact, LinkCause, LinkError, Opened, Reading
from graspd.drivers.link import LinkState, is_ready
from graspd.drivers.protocol_polled import SCHEME, PolledSerial, refuse_url
from graspd.drivers.spi.conversation import NAME, NONCES, Conversation, LineEvent
from graspd.drivers.spi.messages import Stop, encode
from graspd.drivers.spi.sweeps import BridgeCounters

BAUD = 921_600
"""Bits per second: 92 kB/s, three times what the longest sequence needs; 115200 is too slow."""
POLL_NS = 2_000_000
"""Time between reads of a port without a descriptor, ns."""
READ_BYTES = 4096
"""Bytes of one read: a terminal of Linux returns at most this many."""
SHORT_BYTES = READ_BYTES // 2
"""A read of fewer bytes has emptied the terminal; the kernel keeps it full while more waits."""
READS_MAX = 32
"""Most reads in one call: twice the kernel's buffer of 64 KiB. A flood cannot hold the loop."""
DRAIN_TRIES, DRAIN_TRY_S = 10, 0.002
"""Number and length, s, of the waits for the last bytes to leave before a port is closed."""
WRITE_TIMEOUT_S = 0.05
"""Longest wait of a URL's port for room in its buffer, s. If it has a descriptor, `poll` has just
reported room."""
FAILURES = (OSError, termios.error, ValueError)
"""Exceptions of an open port; `ValueError`: a URL's port has a descriptor too high for `select`."""

_log = logging.getLogger(__name__)


class SpiBridgeDriver(Opened):
    """Readings of the sensors behind one bridge; reconnects after every loss.

    `t_ns` of a reading: when the bridge finished the sweep. `seq` continues after a lost link.
    Electrodes that are not sampled, and those of an absent sensor, are `MISSING`. Ports without a
    descriptor (`rfc2217://`, `loop://`) are polled. A missing device raises nothing; `describe`
    reports it.
    """

    name = NAME
    exhausted = False
    live = True

    def __init__(
        self,
        port: str,
        fingers: Sequence[str],
        *,
        sensors: Sequence[str] | None = None,
        baud: int = BAUD,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._fingers, self._sensors = fingers, sensors
        self._clock = clock
        try:
            refuse_url(port)
        except ValueError as error:
            raise ValueError(f"port {port}: {error}") from error
        self._line = SerialLine(port, baud)
        self.conversation = self._begin()

    def _begin(self) -> Conversation:
        nonce = self._clock() % NONCES
        return Conversation(self._line.port, self._fingers, self._sensors, nonce=nonce)

    @property
    def counters(self) -> BridgeCounters:
        return self.conversation.counters

    @property
    def period_ns(self) -> int | None:
        return self.conversation.period_ns

    @property
    def serials(self) -> dict[str, str]:
        return self.conversation.serials

    def describe(self) -> dict[str, Fact]:
        return self.conversation.describe()

    def open(self) -> None:
        """Reset all state and try the port once. Raises `DriverError` if no try can succeed."""
        self.close()
        self.conversation = self._begin()
        self.conversation.link.start(self._clock())
        self._connect()

    def tap(self, sink: Callable[[LineEvent, bytes], None]) -> None:
        """Pass all bytes read or written from now on, and each opening, to `sink` too."""
        self._line.tap = sink

    def close(self) -> None:
        if self.conversation.link.state in (LinkState.GREETING, LinkState.UP):
            with contextlib.suppress(LinkError):  # a bridge that is unplugged needs no STOP
                self._line.write(encode(Stop()))
        self._line.close()
        self.conversation.link.close()

    def fileno(self) -> int | None:
        """Return the port's descriptor; None if it is closed or must be polled."""
        return self._line.descriptor

    def due_ns(self) -> int | None:
        """Return the time of the next try, PING, timeout or poll, ns; None while closed."""
        link = self.conversation.link
        if link.state in (LinkState.CLOSED, LinkState.WAITING):
            return link.retry_ns
        due_ns = self.conversation.due_ns
        return due_ns if self._line.descriptor is not None else min(due_ns, self._poll_due_ns)

    def read_ready(self) -> Sequence[Reading]:
        """Return the readings that have arrived, oldest first. No fault of a bridge raises."""
        link = self.conversation.link
        began_ns = self._clock()
        if link.state is LinkState.WAITING:
            if link.is_due(began_ns):
                self._connect()
            return ()
        self._poll_due_ns = began_ns + POLL_NS
        try:
            chunk = self._line.read()
        except LinkError as error:
            self._lose(error)
            return ()
        conversation = self.conversation
        readings = conversation.receive(chunk, self._clock())
        frames = conversation.say(self._clock())
        if frames or conversation.link.state is LinkState.WAITING:
            self._send(frames)
        return readings

    def _connect(self) -> None:
        try:
            self._line.open()
        except LinkError as error:
            self._lose(error)
            return
        self._poll_due_ns = now_ns = self._clock()
        self.conversation.opened(now_ns)
        self._send(self.conversation.say(now_ns))

    def _send(self, frames: Sequence[bytes]) -> None:
        """Write frames of the conversation; close the port if the link is lost."""
        try:
            for frame in frames:
                self.conversation.sent(frame, self._clock())
                if not self._line.write(frame):
                    self.counters.host_tx_dropped += 1
        except LinkError as error:
            self._lose(error)
        if self.conversation.link.state is LinkState.WAITING:
            self._line.close()

    def _lose(self, error: LinkError) -> None:
        self._line.close()
        self.conversation.lost(error.cause, str(error), self._clock())


class SerialLine:
    """One port, by device name (better `/dev/serial/by-id/...`) or URL of pyserial.

    Methods raise `LinkError` if the device is missing or went away. Use `socket://` and
    `rfc2217://` only to try things out: opening and closing them can take seconds.
    """

    def __init__(self, port: str, baud: int) -> None:
        self.port = port
        self.tap: Callable[[LineEvent, bytes], None] | None = None
        """Called with the bytes of each read, and before each write with its bytes."""
        self.descriptor: int | None = None
        """Descriptor to wait on; None while closed, or if the port must be polled."""
        self._baud = baud
        self._serial: serial.Serial | None = None

    def open(self) -> None:
        """Open the port exclusively. Raises `LinkError`; `DriverError` if no retry can help."""
        self.close()
        try:
            try:
                port = serial.serial_for_url(
                    self.port if "://" in self.port else SCHEME + self.port,
                    self._baud,
                    timeout=0,
                    write_timeout=WRITE_TIMEOUT_S,
                    exclusive=True,
                    do_not_open=True,
                )
            except ValueError as error:
                raise DriverError(f"{self.port}: {error}") from error
            port.open()
        except FAILURES as error:
            raise LinkError.from_errno(error, f"{self.port}: {_reason(error)}") from error
        self._serial = port
        with contextlib.suppress(OSError, AttributeError):
            self.descriptor = port.fileno()
        try:  # makes an FTDI adapter send every 1 ms, not every 16
            port.set_low_latency_mode(True)
        except (OSError, ValueError, AttributeError) as error:
            _log.debug("%s: no low latency mode: %s", self.port, error)
        if self.tap is not None:
            self.tap(LineEvent.OPENED, b"")

    def close(self) -> None:
        """Release the port; does nothing if it is closed. The device may be gone."""
        port, self._serial, self.descriptor = self._serial, None, None
        if port is None:
            return
        try:
            for _ in range(DRAIN_TRIES):
                if not port.out_waiting:
                    break
                time.sleep(DRAIN_TRY_S)
            else:
                port.reset_output_buffer()  # with bytes left, closing would wait up to 30 s
        except AttributeError:
            pass  # the port has no buffer of its own
        except FAILURES as error:
            _log.debug("%s: %s", self.port, error)
        # pyserial drops a socket that its peer has reset, but does not close it.
        held = getattr(port, "_socket", None)
        try:
            port.close()
        except FAILURES as error:
            _log.debug("%s: %s", self.port, error)
        if held is not None:
            held.close()

    def read(self) -> bytes:
        """Return the bytes that have arrived, of at most `READS_MAX` reads. Raises `LinkError`."""
        port, data = self._opened(), b""
        least = SHORT_BYTES if isinstance(port, PolledSerial) else 1
        try:
            for _ in range(READS_MAX):
                chunk = port.read(READ_BYTES)
                data += chunk
                if len(chunk) < least:
                    break
        except FAILURES as error:
            if not data:  # after some bytes the next call raises
                raise self._loss(error) from error
        if self.tap is not None and data:
            self.tap(LineEvent.RECEIVED, data)
        return data

    def write(self, data: bytes) -> bool:
        """Write a frame and return True, or return False if there is no room."""
        port = self._opened()
        try:
            if self.descriptor is not None and not is_ready(self.descriptor, select.POLLOUT):
                return False
            if self.tap is not None:
                self.tap(LineEvent.SENT, data)
            port.write(data)
        except serial.SerialTimeoutException:
            return False
        except FAILURES as error:
            raise self._loss(error) from error
        return True

    def _loss(self, error: Exception) -> LinkError:
        _log.debug("%s", error)
        return LinkError(LinkCause.DISCONNECTED, f"{self.port}: the device went away")

    def _opened(self) -> serial.Serial:
        if self._serial is None:
            raise RuntimeError(f"{self.port} is not open")
        return self._serial


def _reason(error: Exception) -> str:
    """Return the error in one short line; pyserial's own texts repeat the port's name."""
    code = getattr(error, "errno", None)
    if code in (errno.EAGAIN, errno.EBUSY):
        return "another program has it open"
    if code is not None:
        return os.strerror(code).lower()
    return str(error).partition("\n")[0]
