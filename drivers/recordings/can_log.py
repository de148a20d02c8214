"""The link log of a CAN bus: text as `candump -L` writes and `canplayer` reads it.

A line is `(1436509052.249713) can0 100#0D3A1F`: seconds, interface, id of three or eight digits,
data. CAN FD has `##` and a digit of flags before its data. A remote frame has `R` instead of data.
Bit 29 of an id marks an error frame (can-utils, lib.c and linux/can.h).
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, Unpack

from graspd.drivers.base import Reading
from graspd.drivers.can.frames import (
    CLASSIC_DATA_MAX,
    ERR_FLAG,
    ERROR,
    EXTENDED,
    EXTENDED_ID_MAX,
    FD,
    FD_DATA_MAX,
    LOST,
    REMOTE,
    STANDARD_ID_MAX,
    CanFrame,
    Stamped,
)
from graspd.drivers.can.stream import BoardOptions, CanStream
from graspd.drivers.recordings.csv_rows import open_recording
from graspd.drivers.recordings.player import LinkLogDriver

LINE_MAX: Final = 256
"""Longest line, characters; a frame of CAN FD takes 170."""
NS_PER_US: Final = 1000

_LINE: Final = re.compile(
    r"\(([0-9]{1,11})\.([0-9]{6})\) (\S{1,64}) ([0-9A-F]{3}|[0-9A-F]{8})#"
    r"(?:(#[0-9A-F])?((?:[0-9A-F]{2})*)|(R[0-9A-F]?))(?: [RT])?\s*",
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
    if frame.flags & FD:
        data = f"#0{data}"
    return f"({seconds}.{rest_ns // NS_PER_US:06}) {channel} {identifier}#{data}\n"


def encode_frames(frames: Sequence[Stamped], offset_ns: int, channel: str) -> bytes:
    """Return frames as lines; `offset_ns`: wall time less their time."""
    lines = [
        line_of(frame, max(until_ns + offset_ns, 0), channel)
        for frame, _, until_ns in frames
        if not frame.flags & LOST
    ]
    return "".join(lines).encode()


def frame_of(line: str) -> tuple[int, CanFrame] | None:
    """Return a line's time, ns since 1970, and frame; None if it is no such line."""
    match = None if len(line) > LINE_MAX else _LINE.fullmatch(line)
    if match is None:
        return None
    wall_ns = int(match[1]) * 1_000_000_000 + int(match[2]) * NS_PER_US
    word, data = int(match[4], 16), bytes.fromhex(match[6] or "")
    flags = FD if match[5] else 0
    if len(data) > (FD_DATA_MAX if flags else CLASSIC_DATA_MAX):
        return None
    if match[7]:
        flags |= REMOTE
    if len(match[4]) == 3:
        return (wall_ns, CanFrame(word, data, flags)) if word <= STANDARD_ID_MAX else None
    flags |= ERROR if word & ERR_FLAG else EXTENDED
    return wall_ns, CanFrame(word & EXTENDED_ID_MAX, data, flags)


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
        self.begin()

    def records(self, path: Path) -> Iterator[tuple[int, CanFrame]]:
        with open_recording(path) as stream:
            while line := stream.readline(LINE_MAX + 1):
                timed_frame = frame_of(line.decode("ascii", "replace"))
                if timed_frame is not None:
                    yield timed_frame

    def begin(self) -> None:
        self.stream = CanStream("link log", self._fingers, **self._board)
        self.stream.link.greeting()

    def feed(self, t_ns: int, record: CanFrame) -> Sequence[Reading]:
        self.stream.watch(t_ns)
        readings, trouble = self.stream.receive([(record, t_ns, t_ns)])
        self.stream.counters.frames += 1
        self.stream.watch(t_ns)
        if trouble is not None:
            self.stream.interrupt()
        return readings
