"""Lines of candump, as it writes them to a file (`-L`, `-l`) or shows them on a terminal.

In a file: `(1436509052.249713) can0 100#0D3A1F`: seconds, bus, id of three or eight digits, data.
graspd writes the scene's channel as the bus, so it may be a path (PATH_MAX of linux/limits.h).
On a terminal: ` (1436509052.249713)  can0  100   [3]  0D 3A 1F   '.:.'`. The time has any number
of decimals. It counts from 1970 with `-ta` and `-tA`, from the first frame with `-tz`, and from the
frame before with `-td`. A remote frame has `R` or `remote request` instead of data, a frame of
CAN FD `##` or a length of two digits. Bit 29 of an id marks an error frame (can-utils: candump.c,
lib.c; linux/can.h). python-can's own reader drops the classes of error frames, reads most of these
as data, reads half a byte as a whole one, and ends at the first line that is not a frame.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from typing import Final, NamedTuple

from graspd.drivers.can.frames import (
    ERR_FLAG,
    ERROR,
    EXTENDED,
    EXTENDED_ID_MAX,
    LOST,
    REMOTE,
    STANDARD_ID_MAX,
    CanFrame,
)

NS_PER_S: Final = 1_000_000_000
_LINE: Final = re.compile(
    r"""\s*
    \((?P<date>\d{4}-\d\d-\d\d\ \d\d:\d\d:)?(?P<seconds>\d{1,11})(?:\.(?P<decimals>\d{1,18}))?\)
    \s+(?P<bus>\S{1,4096}+)\s+
    (?:
        (?P<id>[0-9A-F]{3}|[0-9A-F]{8})\#
        (?:(?P<data>(?:[0-9A-F]{2}){0,8})|(?P<remote>R[0-9A-F]?)|(?P<fd>\#[0-9A-F]+))
        (?:_[9A-F])?(?:\s[RT])?
    |
        (?:[RT]X\ [-B]\ [-E]\s+)?(?P<shown_id>[0-9A-F]{1,8})\s+
        (?:
            \[\s?(?P<length>[0-8])\](?:
                (?P<shown>(?:\s+[0-9A-F]{2}){0,8})(?:\s+(?:ERRORFRAME.*|'.*'))?
                |\s+(?P<shown_remote>remote\ request)
            )
            |(?P<shown_fd>\[\d\d\](?:\s[\s0-9A-F]*)?)
        )
    )\s*""",
    re.IGNORECASE | re.ASCII | re.VERBOSE,
)
_DROPS: Final = re.compile(
    r"DROPCOUNT: dropped \d+ CAN frames? on '([^',]*)[^']*' socket.*", re.ASCII
)
"""Line that `candump -d` writes where the kernel dropped frames."""
_COLOUR: Final = re.compile(r"\x1b\[[0-9;]*m")
ANY_BUS: Final = "any"
"""Name of the bus for a loss on all buses."""
NO_BUS: Final = ""
"""Name of the bus for a line that has no frame, but a time that later ones count from."""


class Logged(NamedTuple):
    """A frame of a CAN log with its time and bus."""

    t_ns: int | None
    """Time by the log's clock, ns; None: the same as that of the frame before."""
    bus: str
    frame: CanFrame | None
    """Classic frame; None: a CAN FD frame, or on `NO_BUS` no frame."""
    may_be_step: bool = False
    """True if the time may count from the frame before."""


Line = tuple[int, str, Logged | None]
"""Number and text of a line, and the frame in it; None: not understood."""


def read_candump(lines: Iterable[str]) -> Iterator[Line]:
    """Yield the lines, parsed, that are not blank and not comments (`#`)."""
    for number, text in enumerate(lines, 1):
        if text.strip() and not text.startswith("#"):
            yield number, text, parse(text)


def parse(text: str) -> Logged | None:
    """Return the frame in a line, `LOST` for a line of drops; None: no valid frame with a time."""
    if "\x1b" in text:
        text = _COLOUR.sub("", text)
    found = _LINE.fullmatch(text)
    if found is None:
        drops = _DROPS.fullmatch(text.rstrip())
        return None if drops is None else Logged(None, drops[1], CanFrame(0, b"", LOST))
    t_ns, frame, is_fd = _time_of(found), _frame_of(found), found["fd"] or found["shown_fd"]
    if t_ns is None or (frame is None and not is_fd):
        return None
    may_be_step = found["shown_id"] is not None and found["date"] is None
    return Logged(t_ns, found["bus"], None if is_fd else frame, may_be_step)


def _time_of(found: re.Match[str]) -> int | None:
    decimals = (found["decimals"] or "")[:9].ljust(9, "0")
    seconds = int(found["seconds"])
    if found["date"]:
        try:
            date = datetime.fromisoformat(f"{found['date']}{seconds:02}")
        except ValueError:
            return None
        seconds = round(date.replace(tzinfo=UTC).timestamp())
    return seconds * NS_PER_S + int(decimals)


def _frame_of(found: re.Match[str]) -> CanFrame | None:
    """Return the frame of a line; None for an impossible id or length."""
    digits = found["id"] or found["shown_id"]
    data = bytes.fromhex(found["data"] or found["shown"] or "")
    is_remote = bool(found["remote"] or found["shown_remote"])
    if found["length"] and not is_remote and len(data) != int(found["length"]):
        return None
    return frame_of(int(digits, 16), data, is_long=len(digits) > 3, is_remote=is_remote)


def frame_of(word: int, data: bytes, *, is_long: bool, is_remote: bool) -> CanFrame | None:
    """Return the frame of `word`, id and flags; None for an impossible id.

    `is_long`: the id has 29 bits.
    """
    flags = REMOTE if is_remote else 0
    if is_long:
        flags |= ERROR if word & ERR_FLAG else EXTENDED
    elif word > STANDARD_ID_MAX:
        return None
    return CanFrame(word & EXTENDED_ID_MAX, data, flags)
