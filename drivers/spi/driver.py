"""BioTac SPs behind a microcontroller that samples them over SPI and streams over a serial port.

The protocol is `deploy/bridge/PROTOCOL.md`, its messages are `drivers.spi.messages`.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence

from drivers.base import FINGERS, LinkError, Opened, Reading, TactileReading
from drivers.link import Link, LinkState
from drivers.recordings.serial_file import Way
from drivers.spi.clock import DeviceClock
from drivers.spi.conversation import BridgeCounters, BridgeSession, about
from drivers.spi.framing import DELIMITER
from drivers.spi.line import SerialLine
from drivers.spi.messages import (
    DIGEST,
    SENSORS_MAX,
    VERSION,
    Hello,
    HelloHead,
    Message,
    Ping,
    Start,
    Status,
    Stop,
    Sweep,
    decode,
    encode,
    frame_parser,
)

BAUD = 921_600
"""Carries 92 kB/s, three times the longest sequence; 115200 is too slow for any."""
GREETING_NS = 500_000_000
"""How long the bridge may take to answer a PING at the start."""
GREETING_TRIES = 4
"""PINGs at the start before the port is opened anew: a board that resets when its port is opened
needs a second or two."""
PING_PERIOD_NS = 1_000_000_000
PING_FIRST_NS = 50_000_000
PINGS_FIRST = 8
"""So many PINGs at the start follow each other quickly, so that times are good from the start."""
NONCES = 1 << 32
PINGS_OUT_MAX = 8
"""PINGs that may wait for an answer; the oldest is given up."""
PERIOD_MAX_NS = 1_000_000_000
"""A bridge that sweeps less often is of no use, and its silence would not be noticed in time."""
SILENCE_PERIODS = 10
"""Sweeps that may be missing before the link is lost."""
SILENCE_MIN_NS = 100_000_000
"""Shortest silence that is one: above what a USB adapter or a busy host holds back."""
POLL_NS = 2_000_000
"""How often a port without a descriptor is read."""


class SpiBridgeDriver(Opened):
    """Readings of the sensors behind one bridge; finds the bridge again whenever it was lost.

    `fingers` are the rows of a reading. `sensors` are the fingers in the order of the chip selects,
    the same unless given; a board may have more sensors than fingers are wanted. `t_ns` of a
    reading is when the bridge finished the sweep, by `drivers.spi.clock`; `seq` goes on across
    losses of the link. An electrode that the bridge's sequence leaves out, and every one of an
    absent sensor, is `MISSING`.

    `baud` means nothing to a USB device. Ports without a descriptor (`rfc2217://`, `loop://`) are
    polled. The constructor raises `ValueError`. `open` raises `DriverError` for a port name that
    can never work; a device that is not there, now or later, raises nothing: `link_state` and
    `failure` say so.
    """

    name = "spi"
    exhausted = False
    """False: a link may always come back."""
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
        sensors = fingers if sensors is None else sensors
        for names in (fingers, sensors):
            if not 1 <= len(names) <= SENSORS_MAX or len(set(names)) != len(names):
                raise ValueError(f"fingers {list(names)} are not 1 to {SENSORS_MAX} different ones")
        if not set(fingers) <= set(sensors) <= set(FINGERS):
            raise ValueError(f"fingers {list(fingers)} are not all of {list(sensors)}")
        if baud < 1:
            raise ValueError(f"baud is {baud}, must be positive")
        self._sensors = tuple(map(list(sensors).index, fingers))
        self._fingers = tuple(fingers)
        self._clock = clock
        self._line = SerialLine(port, baud)
        self._nonce = clock() % NONCES
        self._reset()

    def _reset(self) -> None:
        self._link = Link(self.name, self._clock)
        self._parser = frame_parser()
        self._counters = BridgeCounters()
        self.period_ns: int | None = None
        """Nominal time between sweeps by the last HELLO, ns; None before the first."""
        self.hello: Hello | None = None
        """The last HELLO of a bridge that fits, None before the first."""
        self.status: Status | None = None
        """The last STATUS, None before the first."""
        self._next_seq = 0
        self._session: BridgeSession | None = None
        self._forget_session()

    def _forget_session(self) -> None:
        """What is only true from one opening of the port to the next."""
        now_ns = self._clock()
        self._parser.reset()
        self._session = None
        self._pings: dict[int, int] = {}
        self._pings_sent = 0
        self._ping_due_ns = self._silent_at_ns = self._idle_ns = self._poll_due_ns = now_ns

    @property
    def link_state(self) -> LinkState:
        """What the link is doing; readings come while it is `UP`."""
        return self._link.state

    @property
    def failure(self) -> str | None:
        """Why the link is not up, one line; None while it is or has not failed."""
        return self._link.reason

    @property
    def bridge_clock(self) -> DeviceClock | None:
        """The bridge's clock: drift, round trip, trust. None while not greeted."""
        return None if self._session is None else self._session.clock

    @property
    def counters(self) -> BridgeCounters:
        """Counters since `open`."""
        frames, counters = self._parser.counters, self._counters
        counters.bytes, counters.frames = frames.bytes, frames.frames
        counters.bad_cobs, counters.bad_crc = frames.bad_cobs, frames.bad_crc
        counters.too_long, counters.link_losses = frames.too_long, self._link.losses
        return counters

    @property
    def serials(self) -> dict[str, str]:
        """By finger, from the last HELLO; without the sensors that did not answer."""
        if self.hello is None:
            return {}
        found = self.hello.serials
        known = zip(self._fingers, self._sensors, strict=True)
        return {finger: found[at] for finger, at in known if at < len(found) and found[at]}

    def describe(self) -> dict[str, str]:
        """Port, link, and what the bridge last said of itself, for people."""
        known = {"port": self._line.port, "link": str(self._link.state)}
        if self.failure is not None:
            known["why"] = self.failure
        if self.hello is not None:
            known.update(about(self.hello))
        clock = self.bridge_clock
        if clock is not None:
            known["clock"] = "trusted" if clock.trusted else "not trusted"
            if clock.round_trip_ns is not None:
                known["round trip"] = f"{clock.round_trip_ns / 1e6:.2f} ms"
            if clock.drift_ppm is not None:
                known["clock drift"] = f"{clock.drift_ppm:+.1f} ppm"
        return known

    def open(self) -> None:
        """Begin anew and try the port at once. Raises `DriverError` if that is hopeless."""
        self.close()
        self._reset()
        self._link.start()
        self._connect()

    def tap(self, taker: Callable[[Way, bytes], None]) -> None:
        """Hand all bytes that come and go from now on to `taker` too."""
        self._line.tap = taker

    def close(self) -> None:
        """Stop the bridge and give the port back."""
        if self._link.state in (LinkState.GREETING, LinkState.UP):
            with contextlib.suppress(LinkError):  # one that is gone has stopped in its own way
                self._line.write(encode(Stop()))
        self._line.close()
        self._link.close()

    def fileno(self) -> int | None:
        """Descriptor of the port, or None: no port, or one that must be polled."""
        return self._line.fileno()

    def due_ns(self) -> int | None:
        """When the next try, PING or deadline is due, or None while closed."""
        if self._link.state is LinkState.CLOSED:
            return None
        if self._link.state is LinkState.WAITING:
            return self._link.retry_ns
        due_ns = self._ping_due_ns
        if self._session is not None:
            due_ns = min(due_ns, self._silent_at_ns)
        return due_ns if self._line.fileno() is not None else min(due_ns, self._poll_due_ns)

    def read_ready(self) -> Sequence[Reading]:
        """Readings of the sweeps that have arrived. Never raises for anything a bridge does."""
        if self._link.state is LinkState.CLOSED:
            raise RuntimeError("the bridge is not open")
        began_ns = self._clock()
        if self._link.state is LinkState.WAITING:
            if self._link.retry_ns is None or began_ns >= self._link.retry_ns:
                self._connect()
            return ()
        self._poll_due_ns = began_ns + POLL_NS
        try:
            chunk = self._line.read()
        except LinkError as error:
            self._lose(str(error))
            return ()
        readings = self._take(chunk, self._clock())
        if self._line.drained:
            self._idle_ns = began_ns
        self._mind_time()
        return readings

    def _connect(self) -> None:
        self._forget_session()
        try:
            self._line.open()
        except LinkError as error:
            self._lose(str(error))
            return
        self._link.greeting()
        self._greet()

    def _greet(self) -> None:
        """Ask for a HELLO. A zero byte ends whatever the line held before."""
        if self._send(DELIMITER + encode(Stop())):
            self._ping()
        self._ping_due_ns = self._clock() + GREETING_NS

    def _ping(self) -> None:
        while len(self._pings) >= PINGS_OUT_MAX:
            self._pings.pop(next(iter(self._pings)))
            self._counters.unanswered_pings += 1
        self._nonce = (self._nonce + 1) % NONCES or 1  # 0 is that of a reset
        now_ns = self._clock()
        self._pings[self._nonce] = now_ns
        self._pings_sent += 1
        is_first = self._pings_sent < PINGS_FIRST
        self._ping_due_ns = now_ns + (PING_FIRST_NS if is_first else PING_PERIOD_NS)
        self._send(encode(Ping(self._nonce)))

    def _send(self, data: bytes) -> bool:
        """Whether the link is still there."""
        try:
            self._counters.host_tx_dropped += not self._line.write(data)
        except LinkError as error:
            self._lose(str(error))
            return False
        return True

    def _lose(self, why: str) -> None:
        self._line.close()
        self._session = None
        self._counters.link_failures += 1
        self._counters.unanswered_pings += len(self._pings)
        self._pings.clear()
        self._link.failed(why)

    def _mind_time(self) -> None:
        """PINGs and deadlines, after everything that has arrived was taken in."""
        if self._link.state not in (LinkState.GREETING, LinkState.UP):
            return
        now_ns = self._clock()
        if self._session is not None and now_ns >= self._silent_at_ns:
            self._lose(f"no sweep for {self._silence_ns() / 1e6:.0f} ms")
        elif now_ns < self._ping_due_ns:
            return
        elif self._session is not None:
            self._ping()
        elif self._pings_sent < GREETING_TRIES:
            self._greet()
        else:
            self._lose(f"no answer from {self._line.port}")

    def _silence_ns(self) -> int:
        return max(SILENCE_PERIODS * (self.period_ns or 0), SILENCE_MIN_NS)

    def _take(self, chunk: bytes, arrival_ns: int) -> list[Reading]:
        readings: list[Reading] = []
        for kind, payload in self._parser.feed(chunk):
            if self._link.state is LinkState.WAITING:
                break  # lost because of a frame before this one
            if kind == Hello.TYPE and not self._speaks_our_language(payload):
                continue
            message = decode(kind, payload)
            if message is None:
                self._counters.bad_frames += kind in (Hello.TYPE, Sweep.TYPE, Status.TYPE)
                self._counters.unknown_frames += kind not in (Hello.TYPE, Sweep.TYPE, Status.TYPE)
                continue
            reading = self._handle(message, arrival_ns)
            if reading is not None:
                readings.append(reading)
        return readings

    def _speaks_our_language(self, payload: bytes) -> bool:
        """Whether a HELLO is of our version and layout; if not the link is given up for now."""
        head = HelloHead.from_bytes(payload)
        if head is None or (head.version, head.digest) == (VERSION, DIGEST):
            return True
        if head.version != VERSION:
            why = f"the bridge speaks version {head.version}, this is version {VERSION}"
        else:
            why = f"the bridge has layout 0x{head.digest:08X} of version {VERSION}"
            why += f", this is 0x{DIGEST:08X}"
        self._counters.refused_bridges += 1
        self._lose(f"{self._line.port}: {why}")
        return False

    def _handle(self, message: Message, arrival_ns: int) -> TactileReading | None:
        if isinstance(message, Sweep):
            return self._on_sweep(message, arrival_ns)
        if isinstance(message, Hello):
            self._on_hello(message, arrival_ns)
        elif isinstance(message, Status):
            self.status = message
            self._counters.bridge_overruns = message.overruns
            self._counters.bridge_tx_dropped = message.tx_dropped
            self._counters.bridge_rx_errors = message.rx_errors
        else:
            self._counters.unknown_frames += 1  # our own words: an echo
        return None

    def _on_hello(self, hello: Hello, arrival_ns: int) -> None:
        if hello.nonce == 0:
            self._on_reset()
            return
        sent_ns = self._pings.pop(hello.nonce, None)
        if sent_ns is None:
            return  # an answer that came twice or too late says nothing about time
        if self._session is None:
            self._session = self._begin(hello)
            if self._session is None:
                return
        elif not self._session.fits(hello):
            self._lose("the bridge changed what it samples")
            return
        self.hello = hello
        self._session.round_trip(hello, sent_ns, arrival_ns)

    def _on_reset(self) -> None:
        """The bridge says that it has just been reset."""
        if self._session is None:
            if self._pings_sent < GREETING_TRIES:
                self._greet()
        else:
            self._counters.restarts += 1
            self._lose("the bridge was reset")

    def _begin(self, hello: Hello) -> BridgeSession | None:
        """Begin sweeping with a bridge that has just answered for the first time."""
        if hello.sensors <= max(self._sensors):
            self._counters.refused_bridges += 1
            named = f"the scene needs {max(self._sensors) + 1}"
            self._lose(f"{self._line.port}: the bridge has {hello.sensors} sensors, {named}")
            return None
        if hello.period_ns > PERIOD_MAX_NS:
            self._counters.refused_bridges += 1
            period_s = hello.period_ns / 1e9
            self._lose(f"{self._line.port}: the bridge sweeps once in {period_s:g} s only")
            return None
        if not self._send(encode(Start())):
            return None
        now_ns = self._clock()
        self.period_ns = hello.period_ns
        self._ping_due_ns = now_ns + PING_FIRST_NS
        self._silent_at_ns = now_ns + self._silence_ns()
        return BridgeSession(hello, self._sensors, self._counters, self._next_seq)

    def _on_sweep(self, sweep: Sweep, arrival_ns: int) -> TactileReading | None:
        session = self._session
        if session is None:
            self._counters.stale_sweeps += 1
            return None
        reading = session.reading(sweep, arrival_ns, self._idle_ns)
        if reading is None:
            return None
        self._next_seq = session.next_seq
        self._silent_at_ns = arrival_ns + self._silence_ns()
        if self._link.state is LinkState.GREETING:
            self._link.up(", ".join(about(session.hello).values()))
        return reading
