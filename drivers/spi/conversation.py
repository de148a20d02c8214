"""The host's side of the bridge's protocol: bytes in, readings and bytes out. No I/O.

The protocol is `deploy/bridge/PROTOCOL.md`, its messages are `drivers.spi.messages`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from drivers.base import (
    DeviceFault,
    Fact,
    LinkCause,
    Reading,
    TactileReading,
    sensor_rows,
)
from drivers.link import GREETING, WAITING, Link
from drivers.spi.framing import DELIMITER
from drivers.spi.messages import (
    DIGEST,
    FIRMWARE,
    VERSION,
    BridgeStatus,
    Hello,
    HelloHead,
    Message,
    Ping,
    Start,
    Stop,
    Sweep,
    decode,
    encode,
    frame_parser,
)
from drivers.spi.sweeps import BridgeCounters, SweepDecoder

NAME: Final = "spi"
GREETING_NS = 500_000_000
"""How long the bridge may take to answer a PING at the start."""
GREETING_TRIES = 4
"""PINGs at the start before the port is opened anew, and one more if the last answer needs another
that agrees: a board that resets when its port is opened needs a second or two."""
PING_PERIOD_NS = 1_000_000_000
PING_FIRST_NS = 50_000_000
PINGS_FIRST = 8
"""PINGs at the start that follow each other quickly, so that times are good from the start."""
NONCES = 1 << 32
PINGS_OUT_MAX = 8
"""PINGs that may wait for an answer; the oldest is given up."""
PERIOD_MAX_NS = 1_000_000_000
"""A bridge that sweeps less often is of no use, and its silence would not be noticed in time."""
SILENCE_PERIODS = 10
"""Sweeps that may be missing before the link is lost."""
SILENCE_MIN_NS = 100_000_000
"""Shortest silence that is one: above what a USB adapter or a busy host holds back."""

_FROM_BRIDGE: Final = (Hello.TYPE, Sweep.TYPE, BridgeStatus.TYPE)


class Conversation:
    """What is said on one port, however often it is opened. All times are monotonic ns.

    The owner of the port calls `opened`, then `receive` with what comes, then writes what `say`
    gives and calls `sent` right before. `link` says how it stands: when it is `WAITING`, the port
    is to be closed and opened again at `link.retry_ns`. A link log has no port and nothing to say:
    it calls `opened`, `receive` and `sent` with what it holds.
    """

    def __init__(
        self,
        port: str,
        fingers: Sequence[str],
        sensors: Sequence[str] | None = None,
        *,
        nonce: int = 0,
    ) -> None:
        """`port` names it for people; `nonce` is that of the PING before the first.

        `fingers`: the rows of a reading. `sensors`: the fingers in the order of the chip selects,
        the same unless given. Raises `ValueError` for fingers that are none or not wired.
        """
        self.link = Link(NAME)
        self.hello: Hello | None = None
        """The last HELLO of a bridge that fits, None before the first."""
        self.period_ns: int | None = None
        """Nominal time between sweeps by that HELLO, ns."""
        self._serials: dict[str, str] = {}
        self._believed: tuple[str, ...] = ()
        """Serial number of each sensor that has one, as two HELLOs in a row have told it."""
        self._doubted: tuple[str, ...] | None = None
        """Those of a HELLO that told others, until the next one."""
        self.status: BridgeStatus | None = None
        """The last STATUS, None before the first."""
        self._sensors = sensor_rows(fingers, sensors)
        self._fingers = tuple(fingers)
        self._port = port
        self._nonce = nonce
        self._counters = BridgeCounters()
        self._parser, self._sent = frame_parser(), frame_parser()
        self._next_seq = 0
        self._sweeps: SweepDecoder | None = None
        self._pings: dict[int, int] = {}
        """When the PINGs that wait for an answer were sent, by their nonce."""

    @property
    def counters(self) -> BridgeCounters:
        """What came, and every kind of drop and fault."""
        frames, counters = self._parser.counters, self._counters
        counters.bytes, counters.frames = frames.bytes, frames.frames
        counters.bad_cobs, counters.bad_crc = frames.bad_cobs, frames.bad_crc
        counters.too_long, counters.link_losses = frames.too_long, self.link.losses
        return counters

    @property
    def serials(self) -> dict[str, str]:
        """By finger, from the last HELLO; without the sensors that did not answer."""
        return self._serials

    @property
    def due_ns(self) -> int:
        """When to call `say`, though nothing has come."""
        if self._sweeps is None:
            return self._ping_due_ns
        return min(self._ping_due_ns, self._silent_at_ns)

    def describe(self) -> dict[str, Fact]:
        """Port, link, and what the bridge last said of itself."""
        known = {"port": Fact(self._port), **self.link.describe()}
        if self.hello is not None:
            known |= _about(self.hello)
            if self.hello.firmware < FIRMWARE:
                known["newer firmware"] = Fact(_version(FIRMWARE), DeviceFault.OLD_FIRMWARE)
        if self._sweeps is not None:
            known |= _about_time(self._sweeps)
        if self.hello is not None and self.status is not None:
            known["spi errors"] = _about_errors(self.status, self.hello)
        return known

    def opened(self, now_ns: int) -> None:
        """The port has just been opened: what was true of the bridge behind it is over."""
        self._parser.reset()
        self._sent.reset()
        self._sweeps = None
        self._starts = False
        self._pings.clear()
        self._pings_sent = 0
        self._ping_due_ns = self._silent_at_ns = now_ns
        self.link.greeting()

    def lost(self, cause: LinkCause, why: str, now_ns: int) -> None:
        """Nothing more can come until `opened`."""
        self._sweeps = None
        self._counters.link_failures += 1
        self._counters.unanswered_pings += len(self._pings)
        self._pings.clear()
        self.link.failed(cause, why, now_ns)

    def say(self, now_ns: int) -> list[bytes]:
        """What is to be sent now, frame by frame; may find that the link is lost instead."""
        if self.link.state is WAITING:
            return []
        said = [encode(Start())] if self._starts else []
        self._starts = False
        if self._sweeps is not None and now_ns >= self._silent_at_ns:
            self.lost(LinkCause.TIMEOUT, f"no sweep for {self._silence_ns / 1e6:.0f} ms", now_ns)
        elif now_ns < self._ping_due_ns:
            return said
        elif self._sweeps is not None:
            is_first = self._pings_sent + 1 < PINGS_FIRST
            self._ping_due_ns = now_ns + (PING_FIRST_NS if is_first else PING_PERIOD_NS)
            return [*said, self._next_ping()]
        elif self._pings_sent < GREETING_TRIES + (self._doubted is not None):
            self._ping_due_ns = now_ns + GREETING_NS
            # The zero byte ends whatever the line held before.
            return [DELIMITER + encode(Stop()), self._next_ping()]
        elif self._doubted is None:
            self.lost(LinkCause.NO_ANSWER, f"no answer from {self._port}", now_ns)
        else:
            others = f"{self._port}: the bridge names other sensors each time"
            self.lost(LinkCause.SERIALS, others, now_ns)
        return []

    def sent(self, data: bytes, t_ns: int) -> None:
        """Note what is sent: a PING is answered by a HELLO, which tells the bridge's time."""
        for kind, payload in self._sent.feed(data):
            message = decode(kind, payload)
            if isinstance(message, Ping):
                while len(self._pings) >= PINGS_OUT_MAX:
                    self._pings.pop(next(iter(self._pings)))
                    self._counters.unanswered_pings += 1
                self._pings[message.nonce] = t_ns
                self._pings_sent += 1

    def not_sent(self) -> None:
        """There was no room for a frame: it is given up."""
        self._counters.host_tx_dropped += 1

    def receive(self, chunk: bytes, arrival_ns: int, idle_ns: int) -> list[Reading]:
        """The readings that these bytes complete, oldest first; never raises.

        `idle_ns` is when nothing was waiting to be read for the last time before they came.
        """
        readings: list[Reading] = []
        for kind, payload in self._parser.feed(chunk):
            if self.link.state is WAITING:
                break  # lost because of a frame before this one
            if kind == Hello.TYPE and not self._speaks_our_language(payload, arrival_ns):
                continue
            message = decode(kind, payload)
            if message is None:
                self._counters.bad_frames += kind in _FROM_BRIDGE
                self._counters.unknown_frames += kind not in _FROM_BRIDGE
            elif isinstance(message, Sweep):
                reading = self._on_sweep(message, arrival_ns, idle_ns)
                if reading is not None:
                    readings.append(reading)
            else:
                self._on_message(message, arrival_ns)
        return readings

    def _next_ping(self) -> bytes:
        self._nonce = (self._nonce + 1) % NONCES or 1  # 0 is that of a reset
        return encode(Ping(self._nonce))

    def _speaks_our_language(self, payload: bytes, now_ns: int) -> bool:
        """Whether a HELLO is of our version and layout; if not the link is given up for now."""
        head = HelloHead.from_bytes(payload)
        if head is None or (head.version, head.digest) == (VERSION, DIGEST):
            return True
        if head.version != VERSION:
            why = f"speaks version {head.version}, this is version {VERSION}"
        else:
            layout = f"has layout 0x{head.digest:08X} of version {VERSION}"
            why = f"{layout}, this is 0x{DIGEST:08X}"
        self._refuse(LinkCause.VERSION, why, now_ns)
        return False

    def _refuse(self, cause: LinkCause, why: str, now_ns: int) -> None:
        self._counters.refused_bridges += 1
        self.lost(cause, f"{self._port}: the bridge {why}", now_ns)

    def _on_message(self, message: Message, arrival_ns: int) -> None:
        if isinstance(message, Hello):
            self._on_hello(message, arrival_ns)
        elif isinstance(message, BridgeStatus):
            self.status = message
            self._counters.bridge_overruns = message.overruns
            self._counters.bridge_tx_dropped = message.tx_dropped
            self._counters.bridge_rx_errors = message.rx_errors
        else:
            self._counters.unknown_frames += 1  # our own words: an echo

    def _on_hello(self, hello: Hello, arrival_ns: int) -> None:
        if hello.nonce == 0:
            self._on_reset(arrival_ns)
            return
        sent_ns = self._pings.pop(hello.nonce, None)
        if sent_ns is None:
            return  # an answer that came twice or too late says nothing about time
        if self._sweeps is None:
            self._greet(hello, arrival_ns)
        elif not self._sweeps.fits(hello):
            self.lost(LinkCause.SETTINGS, "the bridge changed what it samples", arrival_ns)
        elif not self._believes(hello.serials):
            # Misread or exchanged: at STOP it reads them again.
            self.lost(LinkCause.SERIALS, "the bridge names other sensors", arrival_ns)
        if self._sweeps is not None:
            self._take(hello)
            self._sweeps.round_trip(hello, sent_ns, arrival_ns)

    def _believes(self, told: tuple[str, ...]) -> bool:
        """Whether a HELLO tells the sensors that are known, or the same as the one before it."""
        before = self._believed if len(self._believed) == len(told) else ("",) * len(told)
        together = tuple(now or known for now, known in zip(told, before, strict=True))
        if together != before and told != self._doubted:
            self._doubted = told
            return False
        self._believed, self._doubted = together, None
        return True

    def _on_reset(self, now_ns: int) -> None:
        """The bridge says that it has just been reset."""
        if self._sweeps is not None:
            self._counters.restarts += 1
            self.lost(LinkCause.DISCONNECTED, "the bridge was reset", now_ns)
        elif self._pings_sent < GREETING_TRIES:
            self._ping_due_ns = now_ns

    def _greet(self, hello: Hello, now_ns: int) -> None:
        """Begin sweeping with a bridge that has just answered, if its sensors are believed."""
        needed = max(self._sensors) + 1
        if hello.sensors < needed:
            why = f"has {hello.sensors} sensors, the scene needs {needed}"
            self._refuse(LinkCause.SETTINGS, why, now_ns)
        elif hello.period_ns > PERIOD_MAX_NS:
            why = f"sweeps once in {hello.period_ns / 1e9:g} s only"
            self._refuse(LinkCause.SETTINGS, why, now_ns)
        elif not self._believes(hello.serials):
            if self._pings_sent <= GREETING_TRIES:
                self._ping_due_ns = now_ns
        else:
            self._take(hello)
            self._starts = True
            self._pings_sent = 1
            self._ping_due_ns = now_ns + PING_FIRST_NS
            self._silence_ns = max(SILENCE_PERIODS * hello.period_ns, SILENCE_MIN_NS)
            self._silent_at_ns = now_ns + self._silence_ns
            self._sweeps = SweepDecoder(hello, self._sensors, self._counters, self._next_seq)

    def _take(self, hello: Hello) -> None:
        self.hello = hello
        self.period_ns = hello.period_ns
        found = hello.serials
        known = zip(self._fingers, self._sensors, strict=True)
        self._serials = {finger: found[at] for finger, at in known if at < len(found) and found[at]}

    def _on_sweep(self, sweep: Sweep, arrival_ns: int, idle_ns: int) -> TactileReading | None:
        if self._sweeps is None:
            self._counters.stale_sweeps += 1
            return None
        reading = self._sweeps.reading(sweep, arrival_ns, idle_ns)
        if reading is None:
            return None
        self._next_seq = self._sweeps.next_seq
        self._silent_at_ns = arrival_ns + self._silence_ns
        if self.link.state is GREETING:
            about = _about(self._sweeps.hello).values()
            self.link.up(", ".join(fact.text for fact in about), arrival_ns)
        return reading


def _about(hello: Hello) -> dict[str, Fact]:
    """What a bridge says of itself."""
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
    """SPI errors by chip select, `-` for a chip select without a sensor, which always has some."""
    errors = [
        number if serial else None
        for number, serial in zip(status.spi_errors, hello.serials, strict=False)
    ]
    text = ", ".join("-" if number is None else str(number) for number in errors)
    return Fact(text, DeviceFault.SENSOR_WORDS if any(errors) else None)


def _about_time(sweeps: SweepDecoder) -> dict[str, Fact]:
    """What is known of a bridge's clock and of how long its sweeps take."""
    clock, tick_hz = sweeps.clock, sweeps.hello.tick_hz
    trust = Fact("trusted") if clock.trusted else Fact("not trusted", DeviceFault.CLOCK_NOT_TRUSTED)
    known = {"clock": trust, "clock rate": Fact(f"{tick_hz} Hz")}
    if clock.drift_ppm is not None:
        known["clock drift"] = Fact(f"{clock.drift_ppm:+.1f} ppm")
    elif clock.rate_limits_ppm is not None:
        known["clock drift"] = Fact("{:+.0f} to {:+.0f} ppm".format(*clock.rate_limits_ppm))
    if clock.round_trip_ns is not None:
        known["round trip"] = Fact(f"{clock.round_trip_ns / 1e6:.2f} ms")
    if sweeps.longest_ticks:
        longest_ms, period_ms = 1e3 * sweeps.longest_ticks / tick_hz, sweeps.hello.period_ns / 1e6
        fits, fault = "at most, of", None
        if longest_ms >= period_ms:
            fits, fault = "is too long for", DeviceFault.SWEEP_TOO_LONG
        known["sweep"] = Fact(f"{longest_ms:.2f} ms {fits} {period_ms:.2f} ms", fault)
    return known


def _version(firmware: int) -> str:
    return f"{firmware >> 8}.{firmware & 0xFF}"
