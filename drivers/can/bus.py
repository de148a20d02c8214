"""One bus of python-can, read without waiting; all its exceptions become link failures.

The sockets of `socketcan` and `udp_multicast` are read directly, because python-can's `recv` is
several times slower, and fails for descriptors of 1024 and more. Stamps are wall time, which can
step. They are converted to monotonic time by the difference of the two clocks when a frame is read,
so only a step between arrival and reading makes them wrong.
A frame without a stamp arrived after the last time at which the bus was empty. A socketcand server
stamps frames by its own clock, from which the age of a frame follows.
"""

from __future__ import annotations

import contextlib
import os
import socket
import stat
from collections.abc import Callable
from types import MappingProxyType
from typing import Annotated, Final

import can
import msgspec

from graspd.drivers.base import LinkCause, LinkError
from graspd.drivers.can.frames import (
    CAN_FRAME,
    CLASSIC_DATA_MAX,
    ERROR,
    EXTENDED,
    EXTENDED_ID_MAX,
    LOST,
    REMOTE,
    STANDARD_ID_MAX,
    CanCounters,
    CanFrame,
    Stamped,
    unpack_frame,
)
from graspd.drivers.can.interfaces import OWN_OPTIONS, Options, open_bus, refuse_unusable
from graspd.drivers.kernel_stamps import ANCILLARY_BYTES, SO_RXQ_OVFL, read_stamps
from graspd.drivers.link import BROKEN, SenderClock, is_ready

FRAMES_PER_DRAIN: Final = 512
"""Most frames of one `drain`: about 100 ms of a full bus. The loop must get its turn."""
RECEIVE_BUFFER_BYTES: Final = 1 << 20
"""Receive buffer asked of the kernel, bytes; the usual 208 KiB hold 60 ms at 4400 frames/s."""
DATAGRAM_BYTES_MAX: Final = 4096
"""Longest datagram of `udp_multicast` that is read, bytes, as in python-can."""
QUIET_NS: Final = 2_000_000_000
"""Longest silence of a socketcand server, ns; after it the bus is reopened, because python-can does
not notice a lost server."""
UNFRAMED_BYTES_MAX: Final = 1024
"""Most bytes without a frame, after which the bus is reopened: they are not frames, and slcan and
robotell keep them all. The longest frame has 139, of CAN FD."""
STAMPED_INTERFACES: Final = frozenset({"socketcan", "udp_multicast", "virtual"})
"""Interfaces of python-can whose stamps are the wall time of arrival on this computer."""
WAITING_INTERFACES: Final = frozenset({"seeedstudio", "serial"})
"""Interfaces of python-can whose `recv` waits, whatever its timeout, and keeps no bytes."""


class CanBus:
    """One bus of python-can, read without waiting."""

    def __init__(
        self,
        interface: str,
        channel: str,
        bitrate: int | None,
        clock: Callable[[], int],
        wall_clock: Callable[[], int],
        options: Options = MappingProxyType({}),
    ) -> None:
        """`interface`, `channel`: python-can's names. `bitrate`: bit/s; None: the interface's
        default. `clock`: monotonic ns. `wall_clock`: ns since 1970. `options`: other arguments of
        the interface. Raises `ValueError` for arguments with which no bus can ever be opened."""
        refuse_unusable(interface, channel, bitrate, options)
        self.failure: LinkError | None = None
        """Error that broke the bus; None while it works."""
        self.more = False
        """True if the last `drain` returned as many as it may, so that others may wait."""
        self.tap: Callable[[list[Stamped]], None] | None = None
        """Function called with the frames of each `drain` that returns some; None: none."""
        self.counters = CanCounters()
        self._interface = interface
        self._channel = channel
        self._options = {**OWN_OPTIONS.get(interface, {}), **options}
        if bitrate is not None:
            self._options["bitrate"] = bitrate
        self._stamped = interface in STAMPED_INTERFACES
        self._is_remote = interface == "socketcand"
        self._waits = interface in WAITING_INTERFACES
        self._clock = clock
        self._wall_clock = wall_clock
        self._bus: can.BusABC | None = None
        self._socket: socket.socket | None = None
        self.descriptor: int | None = None
        """Descriptor to wait on; None while closed, or if the interface has none."""

    def open(self) -> None:
        self.close()
        self.failure = None
        self._idle_ns = self._received_ns = self._clock()
        self._server, self._stamp_s = SenderClock(), 0.0
        self._newest_ns: int | None = None
        self._unframed_bytes = 0
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
        # slcan's shutdown first writes to the adapter. If that fails, it leaves the port open.
        port = getattr(bus, "serialPortOrig", None)
        if port is not None:
            with contextlib.suppress(Exception):
                port.close()

    def drain(self) -> list[Stamped]:
        """Return the frames that wait, `FRAMES_PER_DRAIN` at most, and markers `LOST`, in order.
        Never raises; a broken bus sets `failure`."""
        frames: list[Stamped] = []
        self.more = False
        try:
            if self._socket is not None:
                self._drain_socket(self._socket, frames)
            elif self._bus is not None:
                self._unframed_bytes += _waiting_bytes(self._bus)
                self._drain_bus(self._bus, frames)
                if self._unframed_bytes > UNFRAMED_BYTES_MAX:
                    text = "bytes come, but no CAN frame: another device, or another baud rate"
                    self.failure = LinkError(LinkCause.UNKNOWN, text)
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
            t_ns = now_ns if wall_ns is None else self._in_order(wall_ns + ahead_ns, now_ns)
            if drops is not None:
                self._count_drops(drops, frames)
            frame = unpack(record)
            if frame is None:
                self.counters.malformed_frames += 1
            else:
                frames.append((frame, t_ns, t_ns))

    def _count_drops(self, total: int, frames: list[Stamped]) -> None:
        """Count new drops, and append `LOST` to `frames` if there are any.

        `total`: the kernel's running sum of drops, 32 bits, that came with the next frame.
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
            would_wait = self._waits and self._is_empty()
            message = None if would_wait else bus.recv(timeout=0)
            if message is None:
                # slcan returns no frame for an adapter's answer, although frames wait behind it.
                if self.descriptor is None or self._is_empty():
                    self._idle_ns = before_ns
                    if self._is_remote:
                        self._notice_quiet(before_ns, bool(frames))
                    return
                # seeedstudio returns no frame after a hang-up either.
                if is_ready(self.descriptor, BROKEN):
                    self.failure = LinkError(LinkCause.DISCONNECTED, "the adapter was unplugged")
                    return
                continue
            self._unframed_bytes = 0
            frame = _frame_of(message)
            if frame is None:
                self.counters.malformed_frames += 1
            elif self._stamped:
                t_ns = self._in_order(round(message.timestamp * 1e9) + ahead_ns, now_ns)
                frames.append((frame, t_ns, t_ns))
            else:
                frames.append((frame, *self._arrived(message.timestamp, since_ns)))

    def _is_empty(self) -> bool:
        """Return True if there is a descriptor, and it has nothing to read."""
        return self.descriptor is not None and not is_ready(self.descriptor)

    def _in_order(self, stamp_ns: int, now_ns: int) -> int:
        """Return `stamp_ns`, limited to the range from the last frame's time to now. The clocks
        cannot be read at the same instant; a pause between makes stamps seem older."""
        if self._newest_ns is not None:
            stamp_ns = max(stamp_ns, self._newest_ns)
        self._newest_ns = min(stamp_ns, now_ns)
        return self._newest_ns

    def _arrived(self, stamp_s: float, since_ns: int) -> tuple[int, int]:
        """Return the earliest and latest time at which a frame can have arrived, ns.

        `stamp_s`: its stamp, used for socketcand only. `since_ns`: when the bus was last empty.
        """
        now_ns, before_s = self._clock(), self._stamp_s
        if not self._is_remote:
            return since_ns, now_ns
        self._stamp_s = stamp_s
        if stamp_s < before_s:
            self._server = SenderClock()
        if stamp_s <= before_s:  # the wall clock was set, or is too coarse
            return since_ns, now_ns
        t_ns = self._server.made_ns(stamp_s, now_ns)
        return t_ns, t_ns

    def _notice_quiet(self, now_ns: int, received: bool) -> None:
        """Set `failure`, so that the bus is reopened, after `QUIET_NS` without a frame.

        `received`: True if this `drain` received frames.
        """
        if received:
            self._received_ns = now_ns
        elif now_ns - self._received_ns > QUIET_NS:
            text = f"no frame from the server for {QUIET_NS / 1e9:g} s"
            self.failure = LinkError(LinkCause.TIMEOUT, text)


def _fileno(bus: can.BusABC) -> int | None:
    try:
        descriptor = bus.fileno()
    except Exception:  # noqa: BLE001 (python-can lets any exception through)
        return None
    return descriptor if descriptor >= 0 else None


def _waiting_bytes(bus: can.BusABC) -> int:
    """Return how many bytes wait in the port of an slcan or robotell adapter; 0 for others."""
    port = getattr(bus, "serialPortOrig", None)
    with contextlib.suppress(OSError):
        return 0 if port is None else port.in_waiting
    return 0


class _Datagram(msgspec.Struct):
    """Fields of a datagram of `udp_multicast` that are read; names and defaults are python-can's.

    python-can itself takes any type, and makes as many bytes as an integer `data` says.
    """

    arbitration_id: Annotated[int, msgspec.Meta(ge=0, le=EXTENDED_ID_MAX)]
    data: Annotated[bytes, msgspec.Meta(max_length=CLASSIC_DATA_MAX)]
    is_extended_id: bool = True
    is_remote_frame: bool = False
    is_error_frame: bool = False
    is_fd: bool = False


_DATAGRAMS: Final = msgspec.msgpack.Decoder(_Datagram)


def _unpack_datagram(data: bytes) -> CanFrame | None:
    """Return the frame in a datagram of `udp_multicast`; None if it is malformed."""
    try:
        sent = _DATAGRAMS.decode(data)
    except (ValueError, RecursionError):
        return None
    is_sound = sent.is_extended_id or sent.arbitration_id <= STANDARD_ID_MAX
    return _frame_of(sent) if is_sound else None


_UNPACK: Final[dict[str, tuple[Callable[[bytes], CanFrame | None], int]]] = {
    "socketcan": (unpack_frame, CAN_FRAME.size + 1),
    "udp_multicast": (_unpack_datagram, DATAGRAM_BYTES_MAX),
}
"""By interface read from its socket: function that unpacks a record, and bytes to read of it. For
socketcan, one byte more than a frame, so that a longer record is not mistaken for a frame."""


def _enlarge_buffer(descriptor: int) -> None:
    if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
        return
    with socket.socket(fileno=os.dup(descriptor)) as same, contextlib.suppress(OSError):
        same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)


def _frame_of(message: can.Message | _Datagram) -> CanFrame | None:
    """Return a message of python-can as a frame; None for one of CAN FD."""
    if message.is_fd:
        return None
    flags = EXTENDED if message.is_extended_id else 0
    flags |= REMOTE if message.is_remote_frame else 0
    flags |= ERROR if message.is_error_frame else 0
    return CanFrame(message.arbitration_id, bytes(message.data or b""), flags)
