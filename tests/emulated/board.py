"""The bridge's board on an emulated chip, driven step by step, and events of its sensors' bus."""

from __future__ import annotations

import json
import struct
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tests.drivers.spi.bridge_c import HELLO, PING, START, STATUS, STOP, frame, unframe
from tests.emulated.build import EMULATOR, boot_rom, emulator_folder

MS = 1_000_000
BOARD_ID = "E66118604B2C3A17"
"""Unique number of the emulated flash, which is the board's id."""
BOOT_MS = 40
"""Time for reset, USB enumeration and the first search for sensors, ms: they take 13."""

EVENT = np.dtype(
    [("t_ns", "<f8"), ("hz", "<u4"), ("kind", "u1"), ("value", "u1"), ("miso", "u1"), ("", "u1")]
)
"""An event on the sensors' bus: of `kind` SELECT, `value` is the mask of the sensors whose chip
select is low from then on; `kind` BYTE begins a byte, with MOSI as `value`, and its clock, `hz`."""
SELECT, BYTE = 0, 1
Events = NDArray[np.void]


@dataclass(frozen=True)
class Frame:
    t_ns: float
    """Emulated time at which its last byte reached the host."""
    kind: int
    payload: bytes


@dataclass
class Status:
    """Counters of a STATUS frame."""

    tick: int
    sweeps: int
    overruns: int
    tx_dropped: int
    rx_errors: int
    spi_errors: list[int] = field(default_factory=list)

    @classmethod
    def of(cls, payload: bytes) -> Self:
        tick, sweeps, overruns, dropped, errors, sensors = struct.unpack_from("<QIIIIB", payload)
        spi_errors = struct.unpack_from(f"<{sensors}I", payload, 25)
        return cls(tick, sweeps, overruns, dropped, errors, list(spi_errors))


class Board:
    """An emulated board, in a process of node. Time stands at `now_ns` between the calls.

    Frames that reach the host are put into `frames`; a damaged one fails the test.
    """

    def __init__(self) -> None:
        self.now_ns = 0.0
        self.frames: list[Frame] = []
        self._torn = False
        self._held = b""
        command = ["node", str(EMULATOR / "main.cjs"), str(emulator_folder()), str(boot_rom())]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait(10)

    def do(self, name: str, /, **arguments: object) -> dict[str, Any]:
        """Send the command `name` with `arguments` to `emulator/main.cjs`; return its answer, and
        move `now_ns` on."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps({"do": name, **arguments}) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        assert line, f"the emulator ended: {self._process.wait(10)}"
        answer: dict[str, Any] = json.loads(line)
        assert "error" not in answer, answer["error"]
        self.now_ns = answer["now"]
        return answer

    # ---- power and cable ----

    def power(self, image: Path) -> Self:
        """Switch the board on with an image in its flash, open the port, and run `BOOT_MS`."""
        self.do("power", file=str(image))
        self.do("open")
        self.run(BOOT_MS)
        return self

    def cut(self, what: str) -> None:
        """Do the command `what`: `close`, `detach` or `stick`; one frame may be torn after it."""
        self._torn = True
        self.do(what)

    # ---- the line ----

    def run_until(self, t_ns: float, *, hand_over: bool = False) -> None:
        """Run the board up to emulated time `t_ns`; `hand_over`: stop when the host gets bytes."""
        packets = self.do("run", until=t_ns, hand_over=hand_over)["packets"]
        for at_ns, packet in packets:
            *whole, self._held = (self._held + bytes.fromhex(packet)).split(b"\0")
            for encoded in filter(None, whole):
                found = unframe(encoded)
                if found is None and self._torn:
                    self._torn = False
                    continue
                assert found is not None, encoded.hex()
                self.frames.append(Frame(at_ns, *found))

    def run(self, ms: float) -> None:
        self.run_until(self.now_ns + ms * MS)

    def send(self, *data: bytes) -> None:
        self.do("send", bytes=b"".join(data).hex())

    def hello(self, nonce: int = 99) -> bytes:
        """Greet the bridge by STOP and PING, as PROTOCOL.md says; return its HELLO's payload."""
        self.send(b"\0", frame(STOP), frame(PING, struct.pack("<I", nonce)))
        self.run(20)
        hellos = [one for one in self.take(HELLO) if struct.unpack_from("<I", one, 5)[0] == nonce]
        assert len(hellos) == 1, f"{len(hellos)} answers to a PING"
        return hellos[0]

    def start(self) -> None:
        """Send START, with row 0 of the sensors' counts for the first sweep."""
        self.do("rewind")
        self.send(frame(START))

    def take(self, kind: int) -> list[bytes]:
        """Return the payloads of a type that have come since `take` was last called for it."""
        found = [one.payload for one in self.frames if one.kind == kind]
        self.frames = [one for one in self.frames if one.kind != kind]
        return found

    def until(self, kind: int, count: int, within_ms: float) -> list[bytes]:
        """Run until `count` frames of a type have come; return their payloads, and drop more.

        Fails if that takes longer than `within_ms` of emulated time.
        """
        end_ns = self.now_ns + within_ms * MS
        while sum(one.kind == kind for one in self.frames) < count:
            assert self.now_ns < end_ns, f"{len(self.frames)} frames in {within_ms} ms"
            self.run_until(end_ns, hand_over=True)
        return self.take(kind)[:count]

    def status(self) -> Status:
        """Wait for the next STATUS, and return it."""
        self.take(STATUS)
        return Status.of(self.until(STATUS, 1, 1100.0)[0])

    # ---- the bus of the sensors ----

    @contextmanager
    def recording(self, folder: Path) -> Iterator[Callable[[], Events]]:
        """Record the sensors' bus during the block. Yields a function that returns the events, as
        `EVENT` in order, once the block has ended."""
        self.do("record")
        events: list[Events] = []
        yield lambda: events[0]
        file = folder / "events"
        self.do("recorded", file=str(file))
        events.append(np.fromfile(file, EVENT))

    def sensor(self, sensor: int, what: str, *values: float) -> None:
        """Change a simulated sensor, counted from 0.

        `what` and `values`: `unplug` 0 or 1, `settle` ns, `dead` mask, `force` electrode word.
        """
        self.do("sensor", sensor=sensor, what=what, values=values)


def serials(hello: bytes) -> Iterator[bytes]:
    """Yield the serial numbers of a HELLO's sensors, without padding; empty for a missing one."""
    for start in range(45, 45 + 16 * hello[43], 16):
        yield hello[start : start + 16].rstrip(b"\0")


@dataclass
class Transaction:
    """A transaction on the bus, from chip select low to high; times in emulated ns."""

    sensors: int
    """Mask of the sensors whose chip select was low."""
    low_ns: float
    high_ns: float = float("inf")
    byte_ns: list[float] = field(default_factory=list)
    """Time of each byte's first bit."""
    hz: list[int] = field(default_factory=list)
    """SPI clock of each byte, Hz."""
    mosi: bytes = b""

    @property
    def is_command(self) -> bool:
        """True if it is a command that makes sensors sample."""
        return len(self.mosi) == 2 and self.mosi[0] & 0x80 != 0


def transactions(events: Events) -> list[Transaction]:
    """Return the whole transactions, in order; pins that change at the same time are one edge."""
    selects = events["kind"] == SELECT
    same = selects[:-1] & selects[1:] & (events["t_ns"][:-1] == events["t_ns"][1:])
    found: list[Transaction] = []
    open_: Transaction | None = None
    for event in events[~np.append(same, False)]:
        t_ns = float(event["t_ns"])
        if event["kind"] == SELECT:
            if open_ is not None:
                open_.high_ns = t_ns
                found.append(open_)
            open_ = Transaction(int(event["value"]), t_ns) if event["value"] else None
        elif open_ is not None:
            open_.byte_ns.append(t_ns)
            open_.hz.append(int(event["hz"]))
            open_.mosi += bytes([event["value"]])
    return found


def sweeps(found: Sequence[Transaction], slots: int, sensors: int) -> list[list[Transaction]]:
    """Return the transactions of each whole sweep: in each slot a command, and an answer of each
    sensor."""
    starts = [at for at, one in enumerate(found) if one.is_command]
    size = slots * (1 + sensors)
    first = [starts[n] for n in range(0, len(starts) - slots + 1, slots)]
    return [list(found[at : at + size]) for at in first if at + size <= len(found)]


@dataclass(frozen=True)
class Timing:
    """Clock and times of recorded sweeps, from the bus alone."""

    spi_hz: int
    settle_us: float
    """Shortest time from the end of a command to the chip select of an answer."""
    gap_us: float
    """Shortest time from the end of an answer to the next chip select."""
    duration_us: tuple[float, float]
    """Shortest and longest sweep, from the first chip select to the last."""
    late_us: float
    """Largest less smallest time from a grid of periods to a sweep's begin."""


def timing(whole: Sequence[Sequence[Transaction]], period_us: float) -> Timing:
    """Return clock and times of consecutive sweeps."""
    settles: list[float] = []
    gaps: list[float] = []
    for sweep in whole:
        for before, after in pairwise(sweep):
            (settles if before.is_command else gaps).append(after.low_ns - before.high_ns)
    durations = [sweep[-1].high_ns - sweep[0].low_ns for sweep in whole]
    starts = np.array([sweep[0].low_ns for sweep in whole]) / 1e3
    grid = starts - period_us * np.arange(len(starts))
    return Timing(
        spi_hz=max(max(one.hz) for sweep in whole for one in sweep),
        settle_us=min(settles) / 1e3,
        gap_us=min(gaps) / 1e3,
        duration_us=(min(durations) / 1e3, max(durations) / 1e3),
        late_us=float(np.ptp(grid)),
    )
