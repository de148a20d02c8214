"""BioTac SPs behind a CAN bus of any interface that python-can has.

The loop waits on the descriptor of the bus. A bus without one (virtual, some vendors' libraries) is
polled every millisecond, which costs a percent of a core.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from typing import Any, Final, Unpack

import can

from graspd.drivers.base import DriverError, Fact, LinkError, Opened, Reading
from graspd.drivers.can.bus import STAMPED_INTERFACES, CanBus
from graspd.drivers.can.decoders import BoardOptions
from graspd.drivers.can.formats import CanFormat
from graspd.drivers.can.frames import LOST, Stamped
from graspd.drivers.can.readings import CanCounters
from graspd.drivers.can.stream import NAME, CanStream
from graspd.drivers.link import CLOSED, UP, WAITING, LinkState

POLL_NS: Final = 1_000_000
"""Time between reads of a bus without a descriptor, ns."""
REST_MARGIN_NS: Final = 1_000_000
REST_MAX_NS: Final = 15_000_000
"""Waking for each of a reading's many frames costs more than the frames. The loop rests until this
margin before the reading should be complete, and at most a quarter of what the kernel's usual
buffer holds, ns."""
RATE_WINDOW_NS: Final = 1_000_000_000
"""Frames per second are counted over this time, ns."""
FD_CLOCK_HZ: Final = 80_000_000
"""Clock from which slcan adapters with CAN FD derive their bit times (CANable 2)."""


class CanBridgeDriver(Opened):
    """Readings from a CAN bus. See `deploy/can/PROTOCOL.md` for the two formats.

    The constructor raises `ValueError`; `open` and `read_ready` `DriverError` only if no later
    try can succeed. A bus that fails is closed and opened again, and its current sweep dropped. A
    bus without a frame of ours for ten periods, 100 ms at least, is `GREETING` until one comes.
    """

    name = NAME
    exhausted = False
    live = True

    def __init__(
        self,
        interface: str,
        channel: str,
        fingers: Sequence[str] = ("ff", "mf", "th"),
        *,
        bitrate: int | None = None,
        data_bitrate: int | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        wall_clock: Callable[[], int] = time.time_ns,
        **board: Unpack[BoardOptions],
    ) -> None:
        """`fingers` and `board`: see `graspd.drivers.can.decoders.make_decoder`.
        `bitrate` and `data_bitrate`, bit/s: not with socketcan, where `ip link` sets them."""
        self._stamped = interface in STAMPED_INTERFACES
        self._make_stream = functools.partial(CanStream, f"{interface} {channel}", fingers, **board)
        self.stream = self._make_stream()
        frame_format = CanFormat(board.get("format", CanFormat.SYNTOUCH))
        options = _bus_options(interface, frame_format, bitrate, data_bitrate)
        self._bus = CanBus(interface, channel, options, clock, wall_clock)
        self._clock = clock
        self._resting_until_ns: int | None = None

    @property
    def counters(self) -> CanCounters:
        return self.stream.counters

    @property
    def link_state(self) -> LinkState:
        """`GREETING` while the bus is open and no frame of ours comes."""
        return self.stream.link.state

    @property
    def frames_per_s(self) -> float:
        """Frames of every kind per second, over the last full second."""
        silent = self._clock() - self._window_start_ns > 2 * RATE_WINDOW_NS
        return 0.0 if silent else self._frames_per_s

    @property
    def period_ns(self) -> int | None:
        return self.stream.period_ns

    @property
    def serials(self) -> dict[str, str]:
        """Empty: no CAN frame carries a sensor's serial number."""
        return {}

    def describe(self) -> dict[str, Fact]:
        facts = self.stream.describe()
        if self.link_state is UP:
            facts["frames"] = Fact(f"{self.frames_per_s:.0f} /s")
        return facts

    def open(self) -> None:
        """Try once to take the bus. Raises `DriverError` if no try can ever succeed."""
        self.close()
        self.stream = self._make_stream()
        self._bus.counters = self.counters
        self._resting_until_ns = None
        self._window_start_ns = now_ns = self._clock()
        self._window_frames = 0
        self._frames_per_s = 0.0
        self.stream.link.start(now_ns)
        self._try_to_open()

    def tap(self, sink: Callable[[list[Stamped]], None]) -> None:
        """Pass all frames that come from now on to `sink` too."""
        self._bus.tap = sink

    def close(self) -> None:
        self._bus.close()
        self.stream.link.close()

    def fileno(self) -> int | None:
        """Descriptor to wait on; None while there is none or no reading is near."""
        return None if self._resting_until_ns is not None else self._bus.descriptor

    def due_ns(self) -> int | None:
        """Time to reopen the bus, to notice silence, or to poll without a descriptor, ns."""
        link = self.stream.link
        if link.state in (CLOSED, WAITING):
            return link.retry_ns
        if self._resting_until_ns is not None:
            return self._resting_until_ns
        if self._bus.more or self._bus.descriptor is None:
            return self._poll_due_ns
        return self.stream.silent_at_ns

    def read_ready(self) -> Sequence[Reading]:
        if self.link_state is CLOSED:
            raise RuntimeError("the CAN bridge is not open")
        if self.link_state is WAITING and self.stream.link.is_due(self._clock()):
            self._try_to_open()
        if self.link_state is WAITING:
            return ()
        frames = self._bus.drain()
        readings, trouble = self.stream.receive(frames)
        self._count(frames)
        self.stream.watch(self._clock(), more=self._bus.more)
        trouble = self._bus.failure or trouble
        if trouble is not None:
            self._lose(trouble)
        return readings

    def _try_to_open(self) -> None:
        try:
            self._bus.open()
        except LinkError as error:
            self._lose(error)
        except DriverError:
            self.stream.link.close()
            raise
        else:
            self.stream.link.greeting()
            self._poll_due_ns = self._clock()

    def _lose(self, error: LinkError) -> None:
        self._resting_until_ns = None
        self._bus.close()
        self.stream.lost(error, self._clock())

    def _count(self, stamped: Sequence[Stamped]) -> None:
        frames = sum(frame.flags != LOST for frame, _, _ in stamped)
        now_ns = self._clock()
        self._poll_due_ns = now_ns + (0 if self._bus.more else POLL_NS)
        self._resting_until_ns = self._rest(now_ns)
        self.counters.frames += frames
        self._window_frames += frames
        elapsed_ns = now_ns - self._window_start_ns
        if elapsed_ns >= RATE_WINDOW_NS:
            self._frames_per_s = self._window_frames * 1e9 / elapsed_ns
            self._window_start_ns, self._window_frames = now_ns, 0

    def _rest(self, now_ns: int) -> int | None:
        """Return the time, ns, until which the kernel may stamp and keep frames, or None."""
        if not self._stamped or self._bus.more or self._bus.descriptor is None:
            return None
        expected_ns = self.stream.expected_ns
        if expected_ns is None or expected_ns - REST_MARGIN_NS <= now_ns:
            return None
        return min(expected_ns - REST_MARGIN_NS, now_ns + REST_MAX_NS)


def _bus_options(
    interface: str, frame_format: CanFormat, bitrate: int | None, data_bitrate: int | None
) -> dict[str, Any]:
    """Return arguments of python-can's bus. Raises `ValueError` for those that it would drop."""
    if interface == "socketcan" and (bitrate is not None or data_bitrate is not None):
        raise ValueError("bit rates of socketcan are set by `ip link set CHANNEL type can bitrate`")
    wants_fd = frame_format is CanFormat.SWEEP_FD
    if data_bitrate is not None and (bitrate is None or not wants_fd):
        raise ValueError("data_bitrate needs a bitrate and the format sweep_fd")
    options: dict[str, Any] = {}
    if interface == "slcan" and data_bitrate is not None and bitrate is not None:
        options["timing"] = can.BitTimingFd.from_sample_point(
            FD_CLOCK_HZ, bitrate, 80.0, data_bitrate, 80.0
        )
        return options
    if bitrate is not None:
        options["bitrate"] = bitrate
    if data_bitrate is not None:
        options["data_bitrate"] = data_bitrate
    if interface == "virtual":
        options["protocol"] = can.CanProtocol.CAN_FD if wants_fd else can.CanProtocol.CAN_20
    elif wants_fd and interface != "slcan":
        options["fd"] = True
    return options
