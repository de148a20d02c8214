"""BioTac SPs behind a CAN bus: the driver. python-can opens the bus, any of its interfaces will do.

Where the bus has a descriptor (socketcan, slcan, udp_multicast and others) the loop waits on it.
Where it has none (virtual, some vendors' libraries) the loop polls every millisecond: that costs a
percent of a core and a reading at most a millisecond, and needs neither thread nor lock nor a
queue of our own.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import can

from drivers.base import DriverError, LinkError, Opened, Reading
from drivers.can.bus import STAMPED_INTERFACES, CanBus, Stamped
from drivers.can.decoders import CanCounters, make_decoder
from drivers.can.formats import SWEEP_BASE_ID, CanFormat
from drivers.can.frames import (
    ERROR,
    LOST,
    REMOTE,
    CanFrame,
    describe_error,
    is_bus_off,
    is_overflow,
)
from drivers.link import Link, LinkState

POLL_NS: Final = 1_000_000
"""How often a bus without a descriptor is asked for frames, ns."""
REST_MARGIN_NS: Final = 1_000_000
REST_MAX_NS: Final = 15_000_000
"""Where a reading takes many frames, waking for each costs more than the frames. The kernel keeps
them meanwhile: the loop rests until so long before the reading should be complete, and never longer
than a quarter of what the kernel's usual buffer holds, ns."""
SILENCE_PERIODS: Final = 10
"""Readings that may be missing before the link is down."""
SILENCE_MIN_NS: Final = 100_000_000
"""Shortest silence that is one, ns: above what an adapter or a busy host holds back."""
RATE_WINDOW_NS: Final = 1_000_000_000
"""Frames per second are counted over this time, ns."""
FD_CLOCK_HZ: Final = 80_000_000
"""Clock from which slcan adapters with CAN FD derive their bit times (CANable 2)."""


class CanBridgeDriver(Opened):
    """Readings from a CAN bus. See `deploy/can/PROTOCOL.md` for the two formats.

    The constructor raises `ValueError` for an argument out of range. `open` raises `DriverError`
    only where no later try can succeed, such as an interface that python-can does not have;
    otherwise the driver tries again until the bus is there. A bus that fails is closed, opened
    again, and counted; a sweep that was cut through by that is dropped. A bus without a frame of
    ours for ten periods, 100 ms at least, is `GREETING` until one comes.
    """

    name = "can"
    exhausted = False
    """A live link never is."""
    live = True

    def __init__(
        self,
        interface: str,
        channel: str,
        fingers: Sequence[str] = ("ff", "mf", "th"),
        *,
        sensors: Sequence[str] | None = None,
        format: str = CanFormat.SYNTOUCH,  # noqa: A002 (the key of the scene)
        arbitration_id: int | None = None,
        sequence: str = "interleaved",
        data_length: int | None = None,
        bitrate: int | None = None,
        data_bitrate: int | None = None,
        bus_options: Mapping[str, Any] | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        wall_clock: Callable[[], int] = time.time_ns,
    ) -> None:
        """Describe the bus; nothing is opened yet.

        `fingers`: the rows of a reading. `sensors`: the fingers in the order of the board's words,
        three at most, the same unless given; a board may have more sensors than fingers are wanted
        (`syntouch` only: sweep frames say whose they are). `format`: a `CanFormat`.
        `arbitration_id`: of the samples, or of finger 0 (`ff`) of the sweep frames; above 0x7FF it
        has 29 bits. None takes the id of the first sound sample until the link is lost, which is
        for bring-up only, except with `sweep_fd`, where it stands for 0x5B0. `sequence`: a key of
        `drivers.can.samples.SEQUENCES` (`syntouch` only). `data_length`: bytes of a sample frame
        where the board pads it. `bitrate` and `data_bitrate`, bit/s: not with socketcan, where they
        belong to `ip link`. `bus_options`: further arguments of python-can's bus.
        """
        self._format = CanFormat(format)
        if self._format is CanFormat.SWEEP_FD and arbitration_id is None:
            arbitration_id = SWEEP_BASE_ID
        self._stamped = interface in STAMPED_INTERFACES
        self.counters = CanCounters()
        self._make_decoder = functools.partial(
            make_decoder,
            self._format,
            fingers,
            sensors=sensors,
            arbitration_id=arbitration_id,
            sequence=sequence,
            data_length=data_length,
        )
        self._decoder = self._make_decoder(counters=self.counters)
        options = _bus_options(interface, self._format, bitrate, data_bitrate)
        self._bus = CanBus(
            interface, channel, {**options, **(bus_options or {})}, clock, wall_clock
        )
        self._clock = clock
        self._where = f"{interface} {channel}, {self._format}"
        self._link = Link(self.name, clock)
        self._accepted = 0
        self._silent_at_ns = 0
        self._poll_due_ns = 0
        self._resting_until_ns: int | None = None
        self._window_start_ns = 0
        self._window_frames = 0
        self._frames_per_s = 0.0
        self.last_error: str | None = None
        """The last failure of the bus or error frame, for people; None before the first."""

    @property
    def link_state(self) -> LinkState:
        """What the link is doing. `GREETING`: the bus is open, no frame of ours has come yet."""
        return self._link.state

    @property
    def frames_per_s(self) -> float:
        """Frames of every kind per second, over the last full second."""
        silent = self._clock() - self._window_start_ns > 2 * RATE_WINDOW_NS
        return 0.0 if silent else self._frames_per_s

    @property
    def period_ns(self) -> int | None:
        """Time between readings, ns, as measured; None until it is known."""
        return self._decoder.period_ns

    @property
    def serials(self) -> dict[str, str]:
        """No frame carries them."""
        return {}

    def describe(self) -> dict[str, str]:
        """Bus, link, and how much it brings, for people."""
        known = {"bus": self._where, "link": str(self._link.state)}
        if self.last_error is not None:
            known["last error"] = self.last_error
        if self._decoder.arbitration_id is not None:
            known["arbitration id"] = f"{self._decoder.arbitration_id:#x}"
        if self._link.state is LinkState.UP:
            known["frames"] = f"{self.frames_per_s:.0f} /s"
        return known

    def open(self) -> None:
        """Take the bus, or begin to try. Raises `DriverError` if no try can ever succeed."""
        self.close()
        self.counters = CanCounters()
        self._decoder = self._make_decoder(counters=self.counters)
        self._accepted = 0
        self._resting_until_ns = None
        self._link = Link(self.name, self._clock)
        self.last_error = None
        self._window_start_ns = self._clock()
        self._window_frames = 0
        self._frames_per_s = 0.0
        self._link.start()
        self._try_to_open()

    def tap(self, taker: Callable[[list[Stamped]], None]) -> None:
        """Hand all frames that come from now on to `taker` too."""
        self._bus.tap = taker

    def close(self) -> None:
        """Let go of the bus."""
        self._bus.close()
        self._link.close()

    def fileno(self) -> int | None:
        """Descriptor to wait on, None while there is none or no reading is near."""
        return None if self._resting_until_ns is not None else self._bus.fileno()

    def due_ns(self) -> int | None:
        """When to open again, to notice silence, or to poll a bus without a descriptor."""
        if self._link.state is LinkState.CLOSED:
            return None
        if self._link.state is LinkState.WAITING:
            return self._link.retry_ns
        if self._resting_until_ns is not None:
            return self._resting_until_ns
        if self._bus.more or self._bus.fileno() is None:
            return self._poll_due_ns
        return self._silent_at_ns if self._link.state is LinkState.UP else None

    def read_ready(self) -> Sequence[Reading]:
        """Readings that are complete now. Raises `DriverError` only if no try can ever succeed."""
        if self._link.state is LinkState.CLOSED:
            raise RuntimeError("the CAN bridge is not open")
        if self._link.state is LinkState.WAITING and not self._is_time_to_open():
            return ()
        frames = self._bus.drain()
        readings, trouble = self._take(frames)
        self._count(frames)
        self._mind_silence()
        trouble = self._bus.failure or trouble
        if trouble is not None:
            self._lose(trouble)
        return readings

    def _take(self, frames: Sequence[Stamped]) -> tuple[list[Reading], str | None]:
        """The readings that frames complete, and why the link is lost, if it is."""
        readings: list[Reading] = []
        trouble = None
        for frame, t_ns, until_ns in frames:
            if not frame.flags & (ERROR | REMOTE | LOST):
                readings += self._decoder.push(frame, t_ns, until_ns)
                continue
            trouble = self._take_special(frame) or trouble
            if frame.flags & LOST or is_overflow(frame):
                readings += self._decoder.cut()
        return readings, trouble

    def _mind_silence(self) -> None:
        """Up with the first frame of ours, and down when there was none for too long."""
        now_ns = self._clock()
        if self.counters.accepted_frames > self._accepted:
            self._accepted = self.counters.accepted_frames
            self._silent_at_ns = now_ns + self._silence_ns()
            if self._link.state is LinkState.GREETING:
                self._link.up(self._where)
        elif (
            self._link.state is LinkState.UP and now_ns >= self._silent_at_ns and not self._bus.more
        ):
            self.last_error = f"nothing from the board for {self._silence_ns() / 1e6:.0f} ms"
            self._decoder.interrupt()
            self._link.failed(f"{self._where}: {self.last_error}")
            self._link.greeting()
            self.counters.link_losses = self._link.losses

    def _silence_ns(self) -> int:
        return max(SILENCE_PERIODS * (self._decoder.period_ns or 0), SILENCE_MIN_NS)

    def _is_time_to_open(self) -> bool:
        """Whether the link is open after a try that was due."""
        retry_ns = self._link.retry_ns
        if retry_ns is not None and self._clock() < retry_ns:
            return False
        self._try_to_open()
        return self._link.state is not LinkState.WAITING

    def _try_to_open(self) -> None:
        try:
            self._bus.open()
        except LinkError as error:
            self._lose(str(error))
        except DriverError:
            self._link.close()
            raise
        else:
            self._link.greeting()
            self._poll_due_ns = self._clock()

    def _lose(self, why: str) -> None:
        self.last_error = why
        self._resting_until_ns = None
        self.counters.bus_faults += 1
        self._bus.close()
        self._decoder.interrupt()
        self._link.failed(f"{self._where}: {why}")
        self.counters.link_losses = self._link.losses

    def _take_special(self, frame: CanFrame) -> str | None:
        """Count a remote or error frame; why the link is lost, if it is."""
        if frame.flags & (REMOTE | LOST):
            self.counters.remote_frames += bool(frame.flags & REMOTE)
            return None
        self.counters.error_frames += 1
        self.counters.controller_overflows += is_overflow(frame)
        self.last_error = describe_error(frame)
        if not is_bus_off(frame):
            return None
        self.counters.bus_off += 1
        return "bus-off"

    def _count(self, stamped: Sequence[Stamped]) -> None:
        frames = sum(not frame.flags & LOST for frame, _, _ in stamped)
        now_ns = self._clock()
        self._poll_due_ns = now_ns + (0 if self._bus.more else POLL_NS)
        self._resting_until_ns = self._rest(now_ns)
        self.counters.frames += frames
        self.counters.malformed_frames += self._bus.take_malformed()
        self.counters.kernel_drops += self._bus.take_kernel_drops()
        self._window_frames += frames
        elapsed_ns = now_ns - self._window_start_ns
        if elapsed_ns >= RATE_WINDOW_NS:
            self._frames_per_s = self._window_frames * 1e9 / elapsed_ns
            self._window_start_ns, self._window_frames = now_ns, 0

    def _rest(self, now_ns: int) -> int | None:
        """Until when the frames may wait in the kernel, None for not at all.

        Only where the kernel stamps them, so that waiting does not make them look fresher.
        """
        if not self._stamped or self._bus.more or self._bus.fileno() is None:
            return None
        expected_ns = self._decoder.expected_ns
        if expected_ns is None or expected_ns - REST_MARGIN_NS <= now_ns:
            return None
        return min(expected_ns - REST_MARGIN_NS, now_ns + REST_MAX_NS)


def _bus_options(
    interface: str, frame_format: CanFormat, bitrate: int | None, data_bitrate: int | None
) -> dict[str, Any]:
    """Arguments of python-can's bus. Raises `ValueError` where it would drop them silently."""
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
