"""The link log of a CAN bus: frames as `candump -L` writes and `canplayer` reads them.

`(1436509052.249713) can0 100#0D3A1F`: seconds, interface, id in three or eight digits, data. `##`
and a digit of flags begin the data of CAN FD, `R` stands for that of a remote frame, and bit 29 of
an id marks an error frame (can-utils, lib.c and linux/can.h).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, Unpack

from graspd.drivers.base import Reading
from graspd.drivers.can.decoders import BoardOptions
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
from graspd.drivers.can.stream import CanStream
from graspd.drivers.recordings.csv_rows import open_recording

LINE_MAX: Final = 256
"""A frame of CAN FD takes 170 characters."""
NS_PER_US: Final = 1000

_LINE: Final = re.compile(
    r"\(([0-9]{1,11})\.([0-9]{6})\) (\S{1,64}) ([0-9A-F]{3}|[0-9A-F]{8})#"
    r"(?:(#[0-9A-F])?((?:[0-9A-F]{2})*)|(R[0-9A-F]?))(?: [RT])?\s*",
    re.IGNORECASE | re.ASCII,
)


def line_of(frame: CanFrame, wall_ns: int, channel: str) -> str:
    """Return a line of `candump -L`. `wall_ns`: arrival, ns since 1970."""
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
    """Return frames as lines; `offset_ns`: from their time to wall time."""
    lines = [
        line_of(frame, max(until_ns + offset_ns, 0), channel)
        for frame, _, until_ns in frames
        if not frame.flags & LOST
    ]
    return "".join(lines).encode()


def frame_of(line: str) -> tuple[int, CanFrame] | None:
    """Return a line's time, ns since 1970, and frame, or None."""
    found = None if len(line) > LINE_MAX else _LINE.fullmatch(line)
    if found is None:
        return None
    wall_ns = int(found[1]) * 1_000_000_000 + int(found[2]) * NS_PER_US
    word, data = int(found[4], 16), bytes.fromhex(found[6] or "")
    flags = FD if found[5] else 0
    if len(data) > (FD_DATA_MAX if flags else CLASSIC_DATA_MAX):
        return None
    if found[7]:
        flags |= REMOTE
    if len(found[4]) == 3:
        return (wall_ns, CanFrame(word, data, flags)) if word <= STANDARD_ID_MAX else None
    flags |= ERROR if word & ERR_FLAG else EXTENDED
    return wall_ns, CanFrame(word & EXTENDED_ID_MAX, data, flags)


class CanLog:
    """Candump text through the stream that the driver has. A `LinkLog`."""

    def __init__(self, fingers: Sequence[str], **board: Unpack[BoardOptions]) -> None:
        """Arguments: those of a `CanStream`. Raises `ValueError`."""
        self._fingers, self._board = fingers, board
        self.begin()

    def records(self, path: Path) -> Iterator[tuple[int, CanFrame]]:
        with open_recording(path) as stream:
            while line := stream.readline(LINE_MAX + 1):
                found = frame_of(line.decode("ascii", "replace"))
                if found is not None:
                    yield found

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
