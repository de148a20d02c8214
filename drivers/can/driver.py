"""Driver of BioTac SPs on a CAN bus, by any interface of python-can.

The loop waits on the descriptor of the bus. A bus without one (virtual, some vendors' libraries) is
polled every millisecond, which costs 1 % of a core.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from types import MappingProxyType
from typing import Final, Unpack

from graspd.drivers.base import DriverError, Fact, LinkError, Opened, Reading
from graspd.drivers.can.bus import STAMPED_INTERFACES, CanBus
from graspd.drivers.can.frames import CanCounters, Stamped
from graspd.drivers.can.interfaces import Options
from graspd.drivers.can.stream import NAME, BoardOptions, CanStream
from graspd.drivers.link import LinkState

POLL_NS: Final = 1_000_000
"""Time between reads of a bus without a descriptor, ns."""
REST_MARGIN_NS: Final = 1_000_000
REST_MAX_NS: Final = 15_000_000
"""Longest time for which frames are left in the kernel, ns: a quarter of what its buffer holds.

Waking for each frame costs more than the frame, so the loop rests until shortly before the reading
should be complete.
"""


class CanBridgeDriver(Opened):
    """Readings from a CAN bus. See `deploy/can/PROTOCOL.md` for its frames.

    The constructor raises `ValueError`. `open` and `read_ready` raise `DriverError` only if no
    retry can succeed. If the bus fails, the current sweep is dropped and the bus is reopened. After
    ten periods (at least 100 ms) without a frame of the board, the link is `GREETING` again.
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
        options: Options = MappingProxyType({}),
        clock: Callable[[], int] = time.monotonic_ns,
        wall_clock: Callable[[], int] = time.time_ns,
        **board: Unpack[BoardOptions],
    ) -> None:
        """`fingers`: the rows of a reading. `board`: the options of `CanStream` for the board.

        `bitrate`: bit/s; None for socketcan, where `ip link` sets it, or the interface's default.
        `options`: more arguments of python-can's interface. `clock`: monotonic ns.
        `wall_clock`: ns since 1970.
        """
        self._stamped = interface in STAMPED_INTERFACES
        self._make_stream = functools.partial(CanStream, f"{interface} {channel}", fingers, **board)
        self.stream = self._make_stream()
        self._bus = CanBus(interface, channel, bitrate, clock, wall_clock, options)
        self._clock = clock
        self._resting_until_ns: int | None = None

    @property
    def counters(self) -> CanCounters:
        return self.stream.counters

    @property
    def period_ns(self) -> int | None:
        return self.stream.period_ns

    @property
    def serials(self) -> dict[str, str]:
        """Empty: no CAN frame carries a sensor's serial number."""
        return {}

    def describe(self) -> dict[str, Fact]:
        return self.stream.describe()

    def open(self) -> None:
        """Try once to open the bus; `read_ready` tries again. Raises `DriverError` if no try can
        ever succeed."""
        self.close()
        self.stream = self._make_stream()
        self._bus.counters = self.counters
        self._resting_until_ns = None
        self.stream.link.start(self._clock())
        self._try_to_open()

    def tap(self, sink: Callable[[list[Stamped]], None]) -> None:
        """Pass all frames that arrive from now on to `sink` too, instead of an earlier sink."""
        self._bus.tap = sink

    def close(self) -> None:
        self._bus.close()
        self.stream.link.close()

    def fileno(self) -> int | None:
        """Return the descriptor to wait on; None if there is none, or no reading is due soon."""
        return None if self._resting_until_ns is not None else self._bus.descriptor

    def due_ns(self) -> int | None:
        link = self.stream.link
        if link.state in (LinkState.CLOSED, LinkState.WAITING):
            return link.retry_ns
        if self._resting_until_ns is not None:
            return self._resting_until_ns
        if self._bus.more or self._bus.descriptor is None:
            return self._poll_due_ns
        return self.stream.silent_at_ns

    def read_ready(self) -> Sequence[Reading]:
        if self.stream.link.state is LinkState.CLOSED:
            raise RuntimeError("the CAN bridge is not open")
        if self.stream.link.state is LinkState.WAITING and self.stream.link.is_due(self._clock()):
            self._try_to_open()
        if self.stream.link.state is LinkState.WAITING:
            return ()
        readings, trouble = self.stream.receive(self._bus.drain())
        now_ns = self._clock()
        self._poll_due_ns = now_ns + (0 if self._bus.more else POLL_NS)
        self._resting_until_ns = self._rest(now_ns)
        self.stream.watch(now_ns, more=self._bus.more)
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

    def _rest(self, now_ns: int) -> int | None:
        """Return the time, ns, until which frames may wait in the kernel; None: read now."""
        if not self._stamped or self._bus.more or self._bus.descriptor is None:
            return None
        expected_ns = self.stream.expected_ns
        if expected_ns is None or expected_ns - REST_MARGIN_NS <= now_ns:
            return None
        return min(expected_ns - REST_MARGIN_NS, now_ns + REST_MAX_NS)
