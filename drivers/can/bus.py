"""One bus of python-can, read without waiting; all its exceptions become link failures.

The sockets of `socketcan` and `udp_multicast` are read directly, because python-can's `recv` is
several times slower, and fails for descriptors of 1024 and more. Stamps are wall time, which can
step. The difference of the two clocks when a frame is read turns them into monotonic time, so only
a step between arrival and reading makes them wrong.
A frame without a stamp arrived after the last time at which the bus was empty.
"""

from __future__ import annotations

import contextlib
import os
import socket
import stat
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, Final

import can

from graspd.drivers.base import DriverError, LinkCause, LinkError
from graspd.drivers.can.frames import (
    CAN_FRAME,
    ERROR,
    EXTENDED,
    LOST,
    REMOTE,
    CanCounters,
    CanFrame,
    Stamped,
    unpack_frame,
)
from graspd.drivers.kernel_stamps import ANCILLARY_BYTES, SO_RXQ_OVFL, read_stamps
from graspd.drivers.link import is_ready
from graspd.extras import installer

FRAMES_PER_DRAIN: Final = 512
"""Most frames of one call: about 100 ms of a full bus. The loop must get its turn."""
RECEIVE_BUFFER_BYTES: Final = 1 << 20
"""Receive buffer asked of the kernel, bytes; the usual 208 KiB hold 60 ms at 4400 frames/s."""
DATAGRAM_BYTES_MAX: Final = 4096
"""Longest datagram of `udp_multicast` that is read, bytes, as in python-can."""
STAMPED_INTERFACES: Final = frozenset({"socketcan", "udp_multicast", "virtual"})
"""Interfaces of python-can whose stamps are the wall time of arrival on this computer."""

_OPTIONS: Final[dict[str, dict[str, Any]]] = {
    # The defaults wait: 2 s after opening, 1 ms in every read.
    "slcan": {"sleep_after_open": 0.0, "timeout": 0.0},
    # The default queue has no bound; this one holds about 4 s of a full bus.
    "virtual": {"rx_queue_size": 16384},
}

_EXTRAS: Final[dict[str, tuple[str, str]]] = {
    **dict.fromkeys(("slcan", "serial", "robotell", "seeedstudio"), ("serial", "serial")),
    "udp_multicast": ("msgpack", "multicast"),
    "gs_usb": ("gs_usb", "gs-usb"),
    "canalystii": ("canalystii", "canalystii"),
    "cantact": ("cantact", "cantact"),
    "neovi": ("ics", "neovi"),
}
"""Module that an interface needs, and the extra of python-can that brings it."""
_WINDOWS: Final = ("etas", "ixxat", "nican", "nixnet", "systec", "usb2can", "vector")
_UNUSABLE: Final = {
    "socketcand": "needs host and port, which a scene cannot give",
    **dict.fromkeys(_WINDOWS, "is for Windows alone"),
}


def refuse_unusable(interface: str) -> None:
    """Raise `ValueError` for an interface that can never be opened on this computer."""
    if interface not in can.VALID_INTERFACES:
        common = "socketcan, slcan, udp_multicast, virtual"
        why = f"python-can has no interface {interface!r}; it has {common} and others"
    elif interface in _UNUSABLE:
        why = f"python-can's interface {interface!r} {_UNUSABLE[interface]}"
    elif interface in _EXTRAS and find_spec(_EXTRAS[interface][0]) is None:
        why = _what_is_missing(interface)
    else:
        return
    raise ValueError(f"interface: {why}")


def open_bus(interface: str, channel: str, **options: Any) -> can.BusABC:  # noqa: ANN401
    """Open a bus of python-can. Raises `LinkError`; `DriverError` if no retry can succeed."""
    where = f"cannot open {interface} {channel}"
    if interface == "socketcan":
        try:
            socket.if_nametoindex(channel)
        except OSError as error:
            raise LinkError(LinkCause.NO_INTERFACE, f"{where}: {error}") from error
    try:
        if interface == "slcan" and "://" not in channel:
            from graspd.drivers.protocol_polled import SCHEME  # needs pyserial

            channel = SCHEME + channel
        return can.Bus(channel=channel, interface=interface, ignore_config=True, **options)
    except (NotImplementedError, ImportError) as error:
        raise DriverError(_what_is_missing(interface, error)) from error
    except Exception as error:
        raise LinkError.from_errno(error, f"{where}: {error}") from error


def _what_is_missing(interface: str, error: Exception | None = None) -> str:
    if interface not in _EXTRAS:
        return f"python-can's interface {interface!r} does not work here: {error}"
    return (
        f"python-can's interface {interface!r} needs more packages: run {installer()} "
        f"'python-can[{_EXTRAS[interface][1]}]'"
    )


class CanBus:
    """One bus of python-can, read without waiting."""

    def __init__(
        self,
        interface: str,
        channel: str,
        bitrate: int | None,
        clock: Callable[[], int],
        wall_clock: Callable[[], int],
    ) -> None:
        """`bitrate`: bit/s; None: that of the interface.

        Raises `ValueError` for a rate of socketcan, and for an interface that cannot be used.
        """
        refuse_unusable(interface)
        if interface == "socketcan" and bitrate is not None:
            raise ValueError(
                "bit rates of socketcan are set by `ip link set CHANNEL type can bitrate`"
            )
        self.failure: LinkError | None = None
        """Why the bus broke; None while it works."""
        self.more = False
        """True if the last `drain` left frames behind."""
        self.tap: Callable[[list[Stamped]], None] | None = None
        """Called with the frames of each `drain` that returns some."""
        self.counters = CanCounters()
        self._interface = interface
        self._channel = channel
        self._options = dict(_OPTIONS.get(interface, {}))
        if bitrate is not None:
            self._options["bitrate"] = bitrate
        self._stamped = interface in STAMPED_INTERFACES
        self._clock = clock
        self._wall_clock = wall_clock
        self._bus: can.BusABC | None = None
        self._socket: socket.socket | None = None
        self.descriptor: int | None = None
        """Descriptor to wait on; None while closed, or if the interface has none."""

    def open(self) -> None:
        self.close()
        self.failure = None
        self._idle_ns = self._clock()
        self._bus = bus = open_bus(self._interface, self._channel, **self._options)
        self.descriptor = _fileno(bus)
        if self.descriptor is not None:
            _enlarge_buffer(self.descriptor)
        raw = getattr(bus, "socket", None)
        if self._interface == "udp_multicast" and self.descriptor is not None:
            raw = socket.socket(fileno=os.dup(self.descriptor))
        if self._interface in _UNPACK and isinstance(raw, socket.socket):
            self._drops_seen = 0
            with contextlib.suppress(OSError):
                raw.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, True)
            self._socket = raw

    def close(self) -> None:
        bus, self._bus = self._bus, None
        if self._socket is not None:
            self._socket.close()
        self._socket = self.descriptor = None
        if bus is None:
            return
        with contextlib.suppress(Exception):
            bus.shutdown()
        # slcan's shutdown first talks to the adapter; if that fails, it leaves the port open.
        port = getattr(bus, "serialPortOrig", None)
        if port is not None:
            with contextlib.suppress(Exception):
                port.close()

    def drain(self) -> list[Stamped]:
        """Return the next frames, oldest first. Never raises; a broken bus sets `failure`."""
        frames: list[Stamped] = []
        self.more = False
        try:
            if self._socket is not None:
                self._drain_socket(self._socket, frames)
            elif self._bus is not None:
                self._drain_bus(self._bus, frames)
        except BlockingIOError:
            pass
        except Exception as error:  # noqa: BLE001 (python-can lets any exception through)
            self.failure = LinkError.from_errno(error, f"{type(error).__name__}: {error}")
        else:
            self.more = len(frames) >= FRAMES_PER_DRAIN
        if self.tap is not None and frames:
            self.tap(frames)
        return frames

    def _drain_socket(self, raw: socket.socket, frames: list[Stamped]) -> None:
        now_ns = self._clock()
        ahead_ns = now_ns - self._wall_clock()
        receive, flags = raw.recvmsg, int(socket.MSG_DONTWAIT)
        unpack, record_bytes = _UNPACK[self._interface]
        for _ in range(FRAMES_PER_DRAIN):
            record, ancillary, _, _ = receive(record_bytes, ANCILLARY_BYTES, flags)
            wall_ns, drops = read_stamps(ancillary)
            t_ns = now_ns if wall_ns is None else min(wall_ns + ahead_ns, now_ns)
            if drops is not None:
                self._count_drops(drops, frames)
            frame = unpack(record)
            if frame is None:
                self.counters.malformed_frames += 1
            else:
                frames.append((frame, t_ns, t_ns))

    def _count_drops(self, total: int, frames: list[Stamped]) -> None:
        """Count new drops. `total`: the kernel's running sum of 32 bits.

        The sum rises with the frame after a loss, so `LOST` goes in front of that frame.
        """
        dropped = (total - self._drops_seen) % (1 << 32)
        if dropped:
            now_ns = self._clock()
            frames.append((CanFrame(0, b"", LOST), now_ns, now_ns))
        self.counters.kernel_drops += dropped
        self._drops_seen = total

    def _drain_bus(self, bus: can.BusABC, frames: list[Stamped]) -> None:
        now_ns, since_ns = self._clock(), self._idle_ns
        ahead_ns = now_ns - self._wall_clock()
        for _ in range(FRAMES_PER_DRAIN):
            before_ns = self._clock()
            message = bus.recv(timeout=0)
            if message is None:
                # slcan returns no frame for an adapter's answer, although frames wait behind it.
                if self.descriptor is None or not is_ready(self.descriptor):
                    self._idle_ns = before_ns
                    return
                continue
            frame = _frame_of(message)
            if frame is None:
                self.counters.malformed_frames += 1
            elif self._stamped:
                t_ns = min(round(message.timestamp * 1e9) + ahead_ns, now_ns)
                frames.append((frame, t_ns, t_ns))
            else:
                frames.append((frame, since_ns, self._clock()))


def _fileno(bus: can.BusABC) -> int | None:
    try:
        descriptor = bus.fileno()
    except Exception:  # noqa: BLE001 (python-can lets any exception through)
        return None
    return descriptor if descriptor >= 0 else None


def _unpack_datagram(data: bytes) -> CanFrame | None:
    """Return the frame in a datagram of `udp_multicast`; None if it is malformed."""
    from can.interfaces.udp_multicast.utils import unpack_message

    try:
        return _frame_of(unpack_message(data, check=True))
    except (TypeError, ValueError, OverflowError):
        return None


_UNPACK: Final[dict[str, tuple[Callable[[bytes], CanFrame | None], int]]] = {
    "socketcan": (unpack_frame, CAN_FRAME.size + 1),
    "udp_multicast": (_unpack_datagram, DATAGRAM_BYTES_MAX),
}
"""Interfaces whose socket is read directly: what unpacks a record, and the bytes read of it.

One byte more than a frame's, so that a longer record is not read as a frame.
"""


def _enlarge_buffer(descriptor: int) -> None:
    if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
        return
    with socket.socket(fileno=os.dup(descriptor)) as same, contextlib.suppress(OSError):
        same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)


def _frame_of(message: can.Message) -> CanFrame | None:
    """Return a classic frame; None for one of CAN FD."""
    if message.is_fd:
        return None
    flags = EXTENDED if message.is_extended_id else 0
    flags |= REMOTE if message.is_remote_frame else 0
    flags |= ERROR if message.is_error_frame else 0
    return CanFrame(message.arbitration_id, bytes(message.data or b""), flags)
