"""The link log of a CAN bus: text as `candump -L` writes and `canplayer` reads it.

A line is `(1436509052.249713) can0 100#0D3A1F`: seconds, bus, id of three or eight digits, data. A
remote frame has `R` instead of data. Bit 29 of an id marks an error frame (can-utils, lib.c and
linux/can.h). python-can's own reader drops the classes of an error frame, reads most as data, takes
half a byte for a whole one, and ends at the first line that is none.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, Unpack

from graspd.drivers.base import Reading, RecordingError
from graspd.drivers.can.frames import (
    ERR_FLAG,
    ERROR,
    EXTENDED,
    EXTENDED_ID_MAX,
    LOST,
    REMOTE,
    STANDARD_ID_MAX,
    CanFrame,
    Stamped,
)
from graspd.drivers.can.stream import BoardOptions, CanStream
from graspd.drivers.recordings.kinds import open_recording, read_lines
from graspd.drivers.recordings.player import LinkLogDriver

NS_PER_US: Final = 1000

_LINE: Final = re.compile(
    r"\(([0-9]{1,11})\.([0-9]{6})\) (\S{1,64}) ([0-9A-F]{3}|[0-9A-F]{8})#"
    r"(?:((?:[0-9A-F]{2}){0,8})|(R[0-9A-F]?))(?: [RT])?\s*",
    re.IGNORECASE | re.ASCII,
)


def line_of(frame: CanFrame, wall_ns: int, channel: str) -> str:
    """Return a frame as a line of `candump -L`. `wall_ns`: arrival, ns since 1970."""
    seconds, rest_ns = divmod(wall_ns, 1_000_000_000)
    word = frame.arbitration_id
    if frame.flags & ERROR:
        identifier = f"{word | ERR_FLAG:08X}"
    else:
        identifier = f"{word:08X}" if frame.flags & EXTENDED else f"{word:03X}"
    data = "R" if frame.flags & REMOTE else frame.data.hex().upper()
    return f"({seconds}.{rest_ns // NS_PER_US:06}) {channel} {identifier}#{data}\n"


def encode_frames(frames: Sequence[Stamped], offset_ns: int, channel: str) -> bytes:
    """Return frames as lines; `offset_ns`: wall time less their time."""
    lines = [
        line_of(frame, max(until_ns + offset_ns, 0), channel)
        for frame, _, until_ns in frames
        if not frame.flags & LOST
    ]
    return "".join(lines).encode()


def frame_of(line: str) -> tuple[int, str, CanFrame] | None:
    """Return a line's time, ns since 1970, bus and frame; None if it is no such line."""
    match = _LINE.fullmatch(line)
    if match is None:
        return None
    wall_ns = int(match[1]) * 1_000_000_000 + int(match[2]) * NS_PER_US
    word, data = int(match[4], 16), bytes.fromhex(match[5] or "")
    flags = REMOTE if match[6] else 0
    if len(match[4]) == 8:
        flags |= ERROR if word & ERR_FLAG else EXTENDED
    elif word > STANDARD_ID_MAX:
        return None
    return wall_ns, match[3], CanFrame(word & EXTENDED_ID_MAX, data, flags)


class CanLog(LinkLogDriver[CanFrame]):
    """Play candump text through the driver's `CanStream`."""

    stream: CanStream

    def __init__(
        self,
        paths: Sequence[Path],
        fingers: Sequence[str],
        *,
        speed: float | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        **board: Unpack[BoardOptions],
    ) -> None:
        """Take the arguments of `RecordedDriver` and `CanStream`. Raises `ValueError`."""
        super().__init__(paths, speed, clock)
        self._fingers, self._board = fingers, board
        self._bus: str | None = None
        self.begin()

    def records(self, path: Path) -> Iterator[tuple[int, CanFrame]]:
        with open_recording(path) as stream:
            for number, line in enumerate(read_lines(path, stream), 1):
                timed_frame = frame_of(line.decode("ascii", "replace"))
                if timed_frame is None:
                    continue
                wall_ns, bus, frame = timed_frame
                if bus != self._bus and self._bus is not None:
                    problem = f"is of bus {bus!r}, those before of {self._bus!r}; play one alone"
                    raise RecordingError(path, problem, line=number)
                self._bus = bus
                yield wall_ns, frame

    def begin(self) -> None:
        self._bus = None
        self.stream = CanStream("link log", self._fingers, **self._board)
        self.stream.link.greeting()

    def feed(self, t_ns: int, record: CanFrame) -> Sequence[Reading]:
        self.stream.watch(t_ns)
        readings, trouble = self.stream.receive([(record, t_ns, t_ns)])
        self.stream.watch(t_ns)
        if trouble is not None:
            self.stream.interrupt()
        return readings
