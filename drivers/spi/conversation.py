"""Host side of the protocol in `deploy/bridge/PROTOCOL.md`: bytes in, readings out. No I/O."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Final

from graspd.drivers.base import DeviceFault, Fact, LinkCause, Reading, TactileReading, sensor_rows
from graspd.drivers.link import Link, LinkState, longest_silence_ns
from graspd.drivers.spi.messages import (
    DELIMITER,
    DIGEST,
    FIRMWARE,
    VERSION,
    BridgeStatus,
    FrameParser,
    Hello,
    Ping,
    Start,
    Stop,
    Sweep,
    decode,
    encode,
    layout_of,
)
from graspd.drivers.spi.sweeps import BridgeCounters, ClockError, DeviceClock, SweepDecoder

NAME: Final = "spi"
GREETING_NS = 500_000_000
"""Timeout of a PING at the start, ns."""
GREETING_TRIES = 4
"""Number of PINGs at the start before the port is reopened. A board that resets needs 1 to 2 s. One
more is sent if the serial numbers of the last answer are not confirmed yet."""
PING_PERIOD_NS = 247_000_000
"""Time between PINGs, ns. Not a multiple of usual periods: sweeps may delay a PING."""
NONCES = 1 << 32
PINGS_OUT_MAX = 8
"""Most PINGs that may wait for an answer; the oldest is given up."""
PERIOD_MAX_NS = 1_000_000_000
"""Longest accepted time between sweeps, ns. A slower bridge's silence would show too late."""

_FROM_BRIDGE: Final = (Hello.TYPE, Sweep.TYPE, BridgeStatus.TYPE)


class LineEvent(IntEnum):
    """Kind of an event on a line, as passed to `SerialLine.tap` and written to a link log."""

    RECEIVED = 1
    SENT = 2
    OPENED = 3


class Conversation:
    """State of the protocol on one port, kept when the port is reopened. Times: monotonic ns.

    The owner of the port calls `opened`, then `receive` with each chunk of bytes. It writes the
    frames that `say` returns, and calls `sent` right before each. While `link` is `WAITING`, the
    port must be closed; reopen it at `link.retry_ns`. A link log is played by the same calls.
    """

    def __init__(
        self,
        port: str,
        fingers: Sequence[str],
        sensors: Sequence[str] | None = None,
        *,
        nonce: int = 0,
    ) -> None:
        """`port`: its name in messages. `fingers`: the rows of a reading. `sensors`: fingers in the
        order of the chip selects; None: `fingers`. `nonce`: the first PING has `nonce` + 1."""
        self.link = Link(NAME)
        self.hello: Hello | None = None
        """Last HELLO of an accepted bridge; None before the first."""
        self.period_ns: int | None = None
        """Time between two sweeps according to `hello`, ns; None before it."""
        self.serials: dict[str, str] = {}
        """Serial numbers in `hello` by finger; silent sensors are left out."""
        self.status: BridgeStatus | None = None
        self._confirmed: tuple[str, ...] = ()
        """Serial numbers that two HELLOs in a row agreed on."""
        self._unconfirmed: tuple[str, ...] | None = None
        """Serial numbers of the last HELLO if they differ from the confirmed ones."""
        self._sensors = sensor_rows(fingers, sensors)
        self._fingers = tuple(fingers)
        self._port = port
        self._nonce = nonce
        self.counters = BridgeCounters()
        self._parser, self._sent = FrameParser(DIGEST, self.counters), FrameParser(DIGEST)
        self._sweeps: SweepDecoder | None = None
        self._pings: dict[int, int] = {}
        """Time, ns, when each unanswered PING was sent, by nonce."""

    @property
    def due_ns(self) -> int:
        if self._sweeps is None:
            return self._ping_due_ns
        return min(self._ping_due_ns, self._silent_at_ns)

    def describe(self) -> dict[str, Fact]:
        facts = {"port": Fact(self._port), **self.link.describe()}
        if self.hello is not None:
            facts |= _about(self.hello)
            if self.hello.firmware < FIRMWARE:
                facts["newer firmware"] = Fact(_version(FIRMWARE), DeviceFault.OLD_FIRMWARE)
        if self._sweeps is not None:
            facts |= _about_time(self._sweeps)
        if self.hello is not None and self.status is not None:
            facts["spi errors"] = _about_errors(self.status, self.hello)
        return facts

    def opened(self, now_ns: int) -> None:
        """Call right after the port was opened: starts the greeting."""
        self._parser.reset()
        self._sent.reset()
        self._sweeps = None
        self._starts = False
        self._pings.clear()
        self._pings_sent = 0
        self._ping_due_ns = self._silent_at_ns = now_ns
        self.link.greeting()

    def lost(self, cause: LinkCause, why: str, now_ns: int) -> None:
        """Close the link until the next `opened`. `why`: the text of `cause` for people."""
        self._sweeps = None
        self.counters.link_failures += 1
        self.counters.unanswered_pings += len(self._pings)
        self._pings.clear()
        self.link.failed(cause, why, now_ns)
        self.counters.link_losses = self.link.losses

    def say(self, now_ns: int) -> list[bytes]:
        """Return the frames to send now. A timeout that has passed closes the link instead."""
        if self.link.state is LinkState.WAITING:
            return []
        frames = [encode(Start())] if self._starts else []
        self._starts = False
        if self._sweeps is not None and now_ns >= self._silent_at_ns:
            self.lost(LinkCause.TIMEOUT, f"no sweep for {self._silence_ns / 1e6:.0f} ms", now_ns)
        elif now_ns < self._ping_due_ns:
            return frames
        elif self._sweeps is not None:
            self._ping_due_ns = now_ns + PING_PERIOD_NS
            return [*frames, self._next_ping()]
        elif self._pings_sent < GREETING_TRIES + (self._unconfirmed is not None):
            self._ping_due_ns = now_ns + GREETING_NS
            # The zero byte ends an unfinished frame.
            return [DELIMITER + encode(Stop()), self._next_ping()]
        elif self._unconfirmed is None:
            self.lost(LinkCause.NO_ANSWER, f"no answer from {self._port}", now_ns)
        else:
            why = f"{self._port}: the bridge names other sensors each time"
            self.lost(LinkCause.SERIALS, why, now_ns)
        return []

    def sent(self, data: bytes, t_ns: int) -> None:
        """Record when each PING in `data` is sent. Call right before writing `data`."""
        for kind, payload in self._sent.feed(data):
            message = decode(kind, payload)
            if isinstance(message, Ping):
                while len(self._pings) >= PINGS_OUT_MAX:
                    self._pings.pop(next(iter(self._pings)))
                    self.counters.unanswered_pings += 1
                self._pings[message.nonce] = t_ns
                self._pings_sent += 1

    def receive(self, chunk: bytes, arrival_ns: int) -> list[Reading]:
        """Return the readings that `chunk`, read at `arrival_ns`, completes, oldest first.

        Never raises.
        """
        readings: list[Reading] = []
        for kind, payload in self._parser.feed(chunk):
            if self.link.state is LinkState.WAITING:
                break  # an earlier frame of this chunk has closed the link
            if kind == Hello.TYPE and not self._has_our_layout(payload, arrival_ns):
                continue
            message = decode(kind, payload)
            if message is None:
                self.counters.bad_frames += kind in _FROM_BRIDGE
                self.counters.unknown_frames += kind not in _FROM_BRIDGE
            elif isinstance(message, Sweep):
                reading = self._on_sweep(message, arrival_ns)
                if reading is not None:
                    readings.append(reading)
            elif isinstance(message, Hello):
                self._on_hello(message, arrival_ns)
            elif isinstance(message, BridgeStatus):
                self.status = message
                self.counters.bridge_overruns = message.overruns
                self.counters.bridge_tx_dropped = message.tx_dropped
                self.counters.bridge_rx_errors = message.rx_errors
            else:
                self.counters.unknown_frames += 1  # an echo of our own frame
        return readings

    def _next_ping(self) -> bytes:
        self._nonce = (self._nonce + 1) % NONCES or 1  # 0 means a reset
        return encode(Ping(self._nonce))

    def _has_our_layout(self, payload: bytes, now_ns: int) -> bool:
        """Return False and close the link if `payload` is a HELLO of another version or layout."""
        layout = layout_of(payload)
        if layout is None or layout == (VERSION, DIGEST):
            return True
        version, digest = layout
        if version != VERSION:
            why = f"speaks version {version}, this is version {VERSION}"
        else:
            why = f"has layout 0x{digest:08X} of version {VERSION}, this is 0x{DIGEST:08X}"
        self._refuse(LinkCause.VERSION, why, now_ns)
        return False

    def _refuse(self, cause: LinkCause, why: str, now_ns: int) -> None:
        self.counters.refused_bridges += 1
        self.lost(cause, f"{self._port}: the bridge {why}", now_ns)

    def _on_hello(self, hello: Hello, arrival_ns: int) -> None:
        if hello.nonce == 0:
            self._on_reset(arrival_ns)
            return
        sent_ns = self._pings.pop(hello.nonce, None)
        if sent_ns is None:
            return  # an answer that came twice or too late
        if self._sweeps is None:
            self._greet(hello, sent_ns, arrival_ns)
        elif self._sweeps.hello.sampling != hello.sampling:
            self.lost(LinkCause.SETTINGS, "the bridge changed what it samples", arrival_ns)
        elif not self._is_confirmed(hello.serials):
            # A serial number was misread, or a sensor exchanged. After STOP the bridge reads them
            # again.
            self.lost(LinkCause.SERIALS, "the bridge names other sensors", arrival_ns)
        else:
            self._take(hello)
            clock = self._sweeps.clock
            clock.round_trip(hello.tick, sent_ns, arrival_ns)
            self.counters.clock_faults += clock.is_doubted

    def _is_confirmed(self, serials: tuple[str, ...]) -> bool:
        """Return True if two HELLOs in a row had these serial numbers, or they are confirmed ones.

        An empty number, of a silent sensor, counts as unchanged.
        """
        before = self._confirmed if len(self._confirmed) == len(serials) else ("",) * len(serials)
        merged = tuple(new or old for new, old in zip(serials, before, strict=True))
        if merged != before and serials != self._unconfirmed:
            self._unconfirmed = serials
            return False
        self._confirmed, self._unconfirmed = merged, None
        return True

    def _on_reset(self, now_ns: int) -> None:
        if self._sweeps is not None:
            self.counters.restarts += 1
            self.lost(LinkCause.DISCONNECTED, "the bridge was reset", now_ns)
        elif self._pings_sent < GREETING_TRIES:
            self._ping_due_ns = now_ns

    def _greet(self, hello: Hello, sent_ns: int, now_ns: int) -> None:
        """Start the sweeps; refuse a bridge that does not fit the scene; PING again if its serial
        numbers are not confirmed. `sent_ns`: when the answered PING was sent."""
        needed = max(self._sensors) + 1
        if hello.sensors < needed:
            why = f"has {hello.sensors} sensors, the scene needs {needed}"
            self._refuse(LinkCause.SETTINGS, why, now_ns)
        elif hello.period_ns > PERIOD_MAX_NS:
            why = f"sweeps once in {hello.period_ns / 1e9:g} s only"
            self._refuse(LinkCause.SETTINGS, why, now_ns)
        elif not self._is_confirmed(hello.serials):
            if self._pings_sent <= GREETING_TRIES:
                self._ping_due_ns = now_ns
        else:
            self._take(hello)
            self._starts = True
            self._ping_due_ns = now_ns + PING_PERIOD_NS
            self._silence_ns = longest_silence_ns(hello.period_ns)
            self._silent_at_ns = now_ns + self._silence_ns
            clock = DeviceClock(hello.tick_hz, hello.tick, sent_ns, now_ns)
            self._sweeps = SweepDecoder(hello, self._sensors, self.counters, clock)

    def _take(self, hello: Hello) -> None:
        self.hello, self.period_ns = hello, hello.period_ns
        serials = {
            finger: hello.serials[sensor]
            for finger, sensor in zip(self._fingers, self._sensors, strict=True)
        }
        self.serials = {finger: serial for finger, serial in serials.items() if serial}

    def _on_sweep(self, sweep: Sweep, arrival_ns: int) -> TactileReading | None:
        if self._sweeps is None:
            self.counters.stale_sweeps += 1
            return None
        try:
            reading = self._sweeps.reading(sweep, arrival_ns)
        except ClockError as error:
            # The next greeting starts another clock.
            self.counters.clock_faults += 1
            self.lost(LinkCause.CLOCK, f"the bridge's clock {error}", arrival_ns)
            return None
        if reading is None:
            return None
        self._silent_at_ns = arrival_ns + self._silence_ns
        if self.link.state is LinkState.GREETING:
            about = _about(self._sweeps.hello).values()
            self.link.up(", ".join(fact.text for fact in about), arrival_ns)
        return reading


def _about(hello: Hello) -> dict[str, Fact]:
    sensors = ", ".join(serial or "none" for serial in hello.serials)
    return {
        "board": Fact(hello.board or "unnamed"),
        "firmware": Fact(_version(hello.firmware)),
        "sequence": Fact(f"{hello.slots} samples at {hello.tick_hz / hello.period_ticks:.1f} Hz"),
        "sensors": Fact(sensors, _sensor_fault(hello.serials)),
    }


def _sensor_fault(serials: Sequence[str]) -> DeviceFault | None:
    present = [serial for serial in serials if serial]
    if not present:
        return DeviceFault.NO_SENSOR
    if len(set(present)) < len(present):
        return DeviceFault.SENSOR_TWICE
    return DeviceFault.SENSOR_ABSENT if len(present) < len(serials) else None


def _about_errors(status: BridgeStatus, hello: Hello) -> Fact:
    """Return a fact with the SPI errors of each chip select; `-` where no sensor answers."""
    errors = [
        count if serial else None
        for count, serial in zip(status.spi_errors, hello.serials, strict=False)
    ]
    text = ", ".join("-" if count is None else str(count) for count in errors)
    return Fact(text, DeviceFault.SENSOR_WORDS if any(errors) else None)


def _about_time(sweeps: SweepDecoder) -> dict[str, Fact]:
    clock, tick_hz = sweeps.clock, sweeps.hello.tick_hz
    facts = {
        "clock rate": Fact(f"{tick_hz} Hz"),
        "round trip": Fact(f"{clock.round_trip_ns / 1e6:.2f} ms"),
    }
    if sweeps.longest_ticks:
        longest_ms, period_ms = 1e3 * sweeps.longest_ticks / tick_hz, sweeps.hello.period_ns / 1e6
        fits, fault = "at most, of", None
        if longest_ms >= period_ms:
            fits, fault = "is too long for", DeviceFault.SWEEP_TOO_LONG
        facts["sweep"] = Fact(f"{longest_ms:.2f} ms {fits} {period_ms:.2f} ms", fault)
    return facts


def _version(firmware: int) -> str:
    return f"{firmware >> 8}.{firmware & 0xFF}"
