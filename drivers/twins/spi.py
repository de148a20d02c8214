"""A twin of the SPI bridge, on a pseudo-terminal that a driver opens by its path."""

from __future__ import annotations

import dataclasses
import itertools
import os
import select
import time
import tty
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graspd.drivers.base import Opened
from graspd.drivers.biotac import E1, E24, SEQUENCES, encode_word, sample_command
from graspd.drivers.spi.messages import (
    DELIMITER,
    DIGEST,
    FIRMWARE,
    TEXT_BYTES,
    VERSION,
    BridgeStatus,
    FrameParser,
    Hello,
    Message,
    Ping,
    Start,
    Stop,
    Sweep,
    decode,
    encode,
)
from graspd.drivers.twins import NAP_MAX_NS
from graspd.drivers.twins.faults import LinkFaultInjector, LinkFaults
from graspd.drivers.twins.grasps.grasps import Counts

TICK_HZ = 1_000_000
SLOT_NS = 80_000
"""Time of one sample of three sensors at 4.4 MHz, ns (manual figure 14)."""
STATUS_PERIOD_NS = 1_000_000_000
REPLUG_NS = 50_000_000
"""Time that a broken link stays down, ns."""
UNSENT_MAX_BYTES = 4096
"""Most bytes that wait for the host; after that, whole frames are dropped."""
READ_BYTES = 4096
SWEEPS_AT_ONCE = 64
"""Most sweeps in a row before the host's bytes are read."""
UNDRIVEN_WORD = 0xFFFF
OTHER_COUNT = 2000
"""Count of all channels that are not electrodes."""

_WORDS = np.array([encode_word(count) for count in range(4096)], dtype=np.uint16)


class SpiTwin(Opened):
    """The bridge's side of the protocol. Call `serve`, or `run_once` repeatedly.

    `path` becomes a symbolic link to a new pseudo-terminal at each `plug`, which is a reset.
    `source`: counts of each sweep, shape (sensors, 24); after the last the twin only answers.
    """

    def __init__(
        self,
        path: Path,
        source: Iterable[Counts],
        *,
        rate_hz: float = 100.0,
        channels: Sequence[int] = SEQUENCES["electrodes"],
        faults: LinkFaults = LinkFaults(),  # noqa: B008 (immutable)
        clock: Callable[[], int] = time.monotonic_ns,
        tap: Callable[[bytes], None] | None = None,
    ) -> None:
        """`rate_hz`: sweeps/s. `channels`: those of each sweep, in order. `tap`: called with all
        bytes to the host; None: nothing. Raises `ValueError` for a source without counts, or an
        unknown channel."""
        counts = iter(source)
        first = next(counts, None)
        if first is None:
            raise ValueError("the source has no counts")
        self.path = path
        self.sweeps = 0
        """Sweeps made since the last `plug`."""
        self.sweeps_made = 0
        """Sweeps made since the twin was made."""
        self.tx_dropped = 0
        """Frames dropped because the host did not read, since the twin was made."""
        self.exhausted = False
        self._sensors = first.shape[0]
        self._source = itertools.chain([first], counts)
        self._period_ns = round(1e9 / rate_hz)
        self._commands = tuple(sample_command(channel) for channel in channels)
        self._slots = [slot for slot, channel in enumerate(channels) if E1 <= channel <= E24]
        self._electrodes = [channels[slot] - E1 for slot in self._slots]
        self._faults = faults
        self._injector = LinkFaultInjector(faults)
        self.injected = self._injector.injected
        self.injected_in_sweeps: Counter[str] = Counter()
        """Number of faults that hit sweeps, by name."""
        self._clock = clock
        self._tick_hz = TICK_HZ
        self._tap = tap
        self._parser = FrameParser(DIGEST)
        self._master: int | None = None
        self._slave: int | None = None
        self._replug_ns: int | None = None
        self._reset()

    def _reset(self) -> None:
        now_ns = self._clock()
        self._boot_ns = now_ns
        self._started = False
        self._seq = 0
        self.sweeps = 0
        self._sweep_due_ns = now_ns
        self._status_due_ns = now_ns + STATUS_PERIOD_NS
        self._unsent: deque[bytes] = deque()
        self._unsent_bytes = 0
        self._spi_errors = [0] * self._sensors
        self._parser.reset()

    def open(self) -> None:
        self.plug()

    def close(self) -> None:
        self.unplug()
        self._replug_ns = None

    def plug(self) -> None:
        """Link the path to a new pseudo-terminal, and send HELLO. Raises `FileExistsError`."""
        self.unplug()
        self._refuse_to_replace()
        self._replug_ns = None
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._reset()
        new = self.path.with_name(self.path.name + ".new")
        if new.is_symlink():
            new.unlink()
        new.symlink_to(os.ttyname(self._slave))
        new.replace(self.path)
        self._write(DELIMITER)
        self._send(self._hello(0), waits=False)

    def _refuse_to_replace(self) -> None:
        """Raise `FileExistsError` unless the path is free or a dead link."""
        if not self.path.exists():
            return
        if not self.path.is_symlink():
            raise FileExistsError(f"{self.path} is in the way: it is not a link of a twin's")
        raise FileExistsError(
            f"{self.path} is in the way: it leads to {self.path.readlink()}; if that is another"
            " twin, end it or give this one another path"
        )

    def unplug(self) -> None:
        ours = None if self._slave is None else os.ttyname(self._slave)
        if self.path.is_symlink() and str(self.path.readlink()) == ours:
            self.path.unlink()
        for descriptor in (self._master, self._slave):
            if descriptor is not None:
                os.close(descriptor)
        self._master = self._slave = None
        self._unsent.clear()
        self._unsent_bytes = 0

    def pull_fingers(self, *fingers: int) -> None:
        """Unplug the sensors of these fingers, numbered from 0, and of no others."""
        self._faults = dataclasses.replace(self._faults, unplugged_fingers=fingers)

    def due_ns(self) -> int | None:
        """Return the time of the next sweep, status or plugging in, ns; None: nothing is due."""
        if self._master is None:
            return self._replug_ns
        if self._sweeping() and not self._unsent:
            return min(self._sweep_due_ns, self._status_due_ns)
        return self._status_due_ns

    def serve(self, stop: Callable[[], bool]) -> None:
        """Run until `stop` returns True; it is called at least 50 times a second."""
        while not stop():
            due_ns = self.due_ns()
            wait_ns = NAP_MAX_NS if due_ns is None else max(due_ns - self._clock(), 0)
            self.run_once(min(wait_ns, NAP_MAX_NS) / 1e9)

    def run_once(self, timeout_s: float = 0.0) -> None:
        """Wait up to `timeout_s` for the host, then do what is due."""
        if self._master is None:
            if self._replug_ns is None or self._clock() < self._replug_ns:
                time.sleep(timeout_s)
                return
            self.plug()
        master = self._master
        if master is None:
            return
        poll = select.poll()
        poll.register(master, select.POLLIN | (select.POLLOUT if self._unsent else 0))
        if any(event & select.POLLIN for _, event in poll.poll(timeout_s * 1000)):
            self._hear(os.read(master, READ_BYTES))
        self._drain()
        self._do_what_is_due()

    def _hear(self, data: bytes) -> None:
        for kind, payload in self._parser.feed(data):
            message = decode(kind, payload)
            if isinstance(message, Ping):
                self._send(self._hello(message.nonce), waits=False)
            elif isinstance(message, Start) and not self._started:
                self._started = True
                self._seq = 0
                self._sweep_due_ns = self._clock() + self._period_ns
            elif isinstance(message, Stop):
                self._started = False

    def _sweeping(self) -> bool:
        return self._started and not self.exhausted

    def _do_what_is_due(self) -> None:
        now_ns = self._clock()
        for _ in range(SWEEPS_AT_ONCE):
            if self._master is None or not self._sweeping() or self._sweep_due_ns > now_ns:
                break
            end_ns = self._sweep_due_ns
            self._sweep_due_ns += self._period_ns
            self._sweep(end_ns)
        if self._master is not None and now_ns >= self._status_due_ns:
            self._status_due_ns += STATUS_PERIOD_NS
            self._send(self._status(), waits=False)

    def _sweep(self, end_ns: int) -> None:
        counts = next(self._source, None)
        if counts is None:
            self.exhausted = True
            for frame in self._injector.flush():
                self._write(frame)
            self._drain()
            return
        words = self._words(counts)
        length_ns = min(len(self._commands) * SLOT_NS, self._period_ns // 2)
        ticks = self._tick(end_ns - length_ns), self._tick(end_ns)
        present = sum(1 << i for i in range(self._sensors) if self._is_plugged(i))
        seq, self._seq = self._seq, (self._seq + 1) % (1 << 32)
        self.sweeps += 1
        self.sweeps_made += 1
        self._send(Sweep(seq, *ticks, present, words))

    def _words(self, counts: Counts) -> NDArray[np.uint16]:
        felt = counts.copy()
        for finger, electrode in self._faults.dead_electrodes:
            felt[finger, electrode] = 0
        words = np.full((len(self._commands), self._sensors), _WORDS[OTHER_COUNT], np.uint16)
        words[self._slots] = _WORDS[felt[:, self._electrodes].T]
        for finger in self._faults.unplugged_fingers:
            words[:, finger] = UNDRIVEN_WORD
            self._spi_errors[finger] = (self._spi_errors[finger] + len(words)) % (1 << 32)
        return words

    def _is_plugged(self, finger: int) -> bool:
        return finger not in self._faults.unplugged_fingers

    def _tick(self, host_ns: int) -> int:
        if self._faults.stuck_clock:
            return 0
        return max((host_ns - self._boot_ns) * self._tick_hz // 1_000_000_000, 0)

    def _hello(self, nonce: int) -> Hello:
        return Hello(
            nonce=nonce,
            tick=self._tick(self._clock()),
            tick_hz=TICK_HZ,
            period_ticks=max(self._period_ns * TICK_HZ // 1_000_000_000, 1),
            serials=tuple(
                f"BTSP-TWIN-{i}"[:TEXT_BYTES] if self._is_plugged(i) else ""
                for i in range(self._sensors)
            ),
            commands=self._commands,
            firmware=FIRMWARE,
            board="twin",
            version=VERSION + self._faults.wrong_version,
        )

    def _status(self) -> BridgeStatus:
        rx = self._parser.counters
        return BridgeStatus(
            tick=self._tick(self._clock()),
            sweeps=self.sweeps,
            overruns=0,
            tx_dropped=self.tx_dropped,
            rx_errors=rx.bad_cobs + rx.bad_crc + rx.too_long,
            spi_errors=tuple(self._spi_errors),
        )

    def _send(self, message: Message, *, waits: bool = True) -> None:
        frame = encode(message)
        if isinstance(message, Sweep) and self._injector.breaks_here():
            self._write(frame[: len(frame) // 2])
            self._drain()
            self.unplug()
            self._replug_ns = self._clock() + REPLUG_NS
            return
        before = Counter(self.injected)
        for outgoing in self._injector.spoil(frame, waits=waits):
            self._write(outgoing)
        if isinstance(message, Sweep):
            self.injected_in_sweeps += self.injected - before
        self._drain()

    def _write(self, data: bytes) -> None:
        """Queue a whole frame; drop it if too many bytes wait, as when the host does not read."""
        if self._unsent_bytes + len(data) > UNSENT_MAX_BYTES and self._unsent:
            self.tx_dropped += 1
            return
        if self._faults.one_byte_at_a_time:
            self._unsent.extend(data[at : at + 1] for at in range(len(data)))
        else:
            self._unsent.append(data)
        self._unsent_bytes += len(data)

    def _drain(self) -> None:
        while self._unsent and self._master is not None:
            piece = self._unsent[0]
            try:
                written = os.write(self._master, piece)
            except BlockingIOError:
                return
            if self._tap is not None:
                self._tap(piece[:written])
            self._unsent_bytes -= written
            if written < len(piece):
                self._unsent[0] = piece[written:]
                return
            self._unsent.popleft()
