"""Streams that repeat exactly: recordings, and twins whose bytes go through the drivers' parsers.

No socket, no port, no sleep: each stream has a clock of its own that moves from reading to reading.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np

from graspd.biotac import Finger
from graspd.drivers.base import Reading
from graspd.drivers.biotac import SEQUENCES, encode_word, sample_command
from graspd.drivers.can.frames import CanFrame
from graspd.drivers.can.stream import CanStream
from graspd.drivers.link import LinkState
from graspd.drivers.palm.stream import PalmStream
from graspd.drivers.recordings.can_log import line_of
from graspd.drivers.recordings.csv_player import DEMO_RECORDING, ReplayDriver
from graspd.drivers.recordings.serial_log import encode_records
from graspd.drivers.spi.conversation import Conversation, LineEvent
from graspd.drivers.spi.messages import (
    DIGEST,
    FrameParser,
    Hello,
    Message,
    Ping,
    Sweep,
    decode,
    encode,
)
from graspd.drivers.twins.can import CanTwin
from graspd.drivers.twins.datagrams import PalmTwin
from graspd.drivers.twins.faults import LinkFaultInjector, LinkFaults
from graspd.drivers.twins.grasps.grasps import Counts, recorded_counts
from tests.kit.clock import Clock

CHECKOUT: Final = Path(__file__).parents[2]
FINGERS: Final[tuple[Finger, ...]] = ("ff", "mf", "th")
WIRED: Final[tuple[Finger, ...]] = ("mf", "th", "ff")
"""Fingers in the order of the SPI bridge's chip selects."""
START_NS: Final = 10**12
PERIOD_NS: Final = 10_000_000
MS: Final = 1_000_000
FAULTS: Final = LinkFaults(
    bit_flip_probability=2e-4,
    drop_probability=2e-4,
    duplicate_probability=2e-4,
    dead_electrodes=((0, 6), (2, 15)),
    seed=7,
)
"""Two dead electrodes, and at times a frame that is damaged, missing or sent twice."""
FRAME_FAULTS: Final = LinkFaults(
    bit_flip_probability=3e-3, drop_probability=3e-3, duplicate_probability=3e-3, seed=7
)
"""Damaged, missing and repeated frames, more often: for links with few frames in each reading."""
PAUSES: Final = (range(700, 730),)
"""Sweeps during which the SPI bridge is silent: the link is lost and found again."""


def recording(path: Path, fingers: Sequence[str] = FINGERS) -> Iterator[Reading]:
    """Yield the readings of a CSV recording at its own times, with joints if it has them."""
    clock = Clock(START_NS)
    with ReplayDriver([path], fingers, clock=clock) as driver:
        while not driver.exhausted:
            clock.now_ns = max(clock.now_ns, driver.due_ns() or 0)
            yield from driver.read_ready()


def demo() -> Iterator[Reading]:
    """Return the readings of the synthetic demo recording, with joints."""
    return recording(DEMO_RECORDING)


def can(log: BinaryIO | None = None) -> Iterator[Reading]:
    """Yield the demo's readings over a CAN twin with `FAULTS`; write its frames to `log`, as
    candump text."""
    clock = Clock(START_NS)
    twin = CanTwin("virtual", "none", _counts(), FINGERS, faults=FAULTS, clock=clock)
    injector = LinkFaultInjector(FAULTS)
    stream = CanStream("virtual", FINGERS)
    stream.link.greeting()
    while frames := twin.next_frames():
        for number, (arbitration_id, data) in enumerate(frames):
            t_ns = clock.now_ns + PERIOD_NS * (number + 1) // len(frames)
            for spoilt in injector.spoil(data):
                frame = CanFrame(arbitration_id, spoilt)
                if log is not None:
                    log.write(line_of(frame, t_ns, "can0").encode())
                readings, _ = stream.receive([(frame, t_ns, t_ns)])
                yield from readings
        clock.now_ns += PERIOD_NS


def palm() -> Iterator[Reading]:
    """Yield the demo's readings over a palm twin, a packet a millisecond, and calibrated joints."""
    calibration = CHECKOUT / "deploy" / "calibration" / "example_hand.toml"
    stream = PalmStream(FINGERS, calibration=calibration)
    t_ns = START_NS
    for datagrams in PalmTwin(_counts(), FINGERS, faults=FRAME_FAULTS).cycles():
        t_ns += MS
        for data in datagrams:
            yield from stream.receive(data, t_ns) or ()


def spi(log: BinaryIO | None = None) -> Iterator[Reading]:
    """Yield the demo's readings over an SPI bridge; write its bytes to `log`, a serial link log."""
    line = _Line(log)
    for sequence, counts in enumerate(_counts()):
        now_ns = START_NS + PERIOD_NS * sequence
        line.say(now_ns)
        if not any(sequence in pause for pause in PAUSES):
            yield from line.hear(now_ns + MS, sequence, counts)


class _Line:
    """A serial line: the conversation of the host on one end, a simple bridge on the other."""

    def __init__(self, log: BinaryIO | None) -> None:
        self._log = log
        self._host = Conversation("bridge", FINGERS, WIRED)
        self._injector = LinkFaultInjector(FRAME_FAULTS)
        self._parser = FrameParser(DIGEST)
        self._answers: list[Message] = []
        self._open(START_NS)

    def _open(self, now_ns: int) -> None:
        self._host.opened(now_ns)
        self._write(LineEvent.OPENED, now_ns, b"")

    def _write(self, event: LineEvent, t_ns: int, data: bytes) -> None:
        if self._log is not None:
            self._log.write(encode_records(event, t_ns, data))

    def say(self, now_ns: int) -> None:
        """Send what the host has to send now, open the link if due, and queue the answers."""
        link = self._host.link
        if link.state is LinkState.WAITING and now_ns >= (link.retry_ns or 0):
            self._open(now_ns)
        for data in self._host.say(now_ns):
            self._host.sent(data, now_ns)
            self._write(LineEvent.SENT, now_ns, data)
            for kind, payload in self._parser.feed(data):
                message = decode(kind, payload)
                if isinstance(message, Ping):
                    self._answers.append(_hello(message.nonce, now_ns))

    def hear(self, now_ns: int, sequence: int, counts: Counts) -> Iterator[Reading]:
        """Send the bridge's queued answers and a sweep; yield the host's readings of them."""
        words = np.array(
            [[encode_word(int(count)) for count in row] for row in counts.T], dtype=np.uint16
        )[:, [FINGERS.index(finger) for finger in WIRED]]
        sweep = Sweep(sequence, _tick(now_ns) - 2000, _tick(now_ns), 7, words)
        pieces = [encode(answer) for answer in self._answers]
        self._answers.clear()
        pieces += self._injector.spoil(encode(sweep))
        for piece in pieces:
            self._write(LineEvent.RECEIVED, now_ns, piece)
            if self._host.link.state is not LinkState.WAITING:
                yield from self._host.receive(piece, now_ns)


def _hello(nonce: int, now_ns: int) -> Hello:
    return Hello(
        nonce=nonce,
        tick=_tick(now_ns),
        tick_hz=1_000_000,
        period_ticks=PERIOD_NS // 1000,
        serials=tuple(f"BTSP-{finger}" for finger in WIRED),
        commands=tuple(sample_command(channel) for channel in SEQUENCES["electrodes"]),
        board="replayed",
    )


def _tick(now_ns: int) -> int:
    """Return the time of the bridge's clock, us, which runs 50 ppm too fast."""
    return (now_ns - START_NS // 2) // 1000 * 20_001 // 20_000


def _counts() -> Iterator[Counts]:
    return recorded_counts(DEMO_RECORDING)
