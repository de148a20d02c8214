"""Driver that plays logs of CAN buses; frames of a live link written as lines of `candump -L`."""

from __future__ import annotations

import io
import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path
from typing import BinaryIO, Final, Unpack

from graspd.drivers.base import Reading, RecordingError
from graspd.drivers.can.frames import ERR_FLAG, ERROR, EXTENDED, LOST, REMOTE, CanFrame, Stamped
from graspd.drivers.can.stream import BoardOptions, CanStream
from graspd.drivers.link import LinkState
from graspd.drivers.recordings.can_files import read_asc, read_blf, read_csv, read_trc
from graspd.drivers.recordings.candump import ANY_BUS, NO_BUS, NS_PER_S, Line, parse, read_candump
from graspd.drivers.recordings.kinds import (
    CAN_LOGS,
    HEAD_BYTES,
    LINE_LENGTH_MAX,
    PAGE,
    Kind,
    encoding_of,
    kind_of,
    open_recording,
    reason,
)
from graspd.drivers.recordings.player import LinkLogDriver, within_limits

NS_PER_US: Final = 1000
FIRST_LINES: Final = 20_000
"""Number of first lines by which the bus is chosen: 5 s of a full bus."""
IDS_MAX: Final = 4096
"""Most pairs of bus and id that are counted; standard frames of one bus have half as many."""
SHOWN_MAX: Final = 8
"""Most buses or ids named in a message for people."""
SHOWN_LENGTH_MAX: Final = 80
"""Most characters of a line shown in a message for people."""
SET_BACK_NS: Final = 1_000_000_000
"""Fall of the time from which on the clock was set or another log begins, ns."""
STEPS_SHARE: Final = 0.5
"""Falls of the time as a share of its rises, from which on times count from the line before."""

_TEXTS: Final = {
    Kind.CANDUMP: read_candump,
    Kind.ASC: read_asc,
    Kind.TRC: read_trc,
    Kind.CSV: read_csv,
}

_log = logging.getLogger(__name__)


def line_of(frame: CanFrame, wall_ns: int, channel: str) -> str:
    """Return a frame as a line of `candump -L`. `wall_ns`: arrival, ns since 1970."""
    seconds, rest_ns = divmod(wall_ns, NS_PER_S)
    word = frame.arbitration_id
    if frame.flags & ERROR:
        identifier = f"{word | ERR_FLAG:08X}"
    else:
        identifier = f"{word:08X}" if frame.flags & EXTENDED else f"{word:03X}"
    data = "R" if frame.flags & REMOTE else frame.data.hex().upper()
    return f"({seconds}.{rest_ns // NS_PER_US:06}) {channel} {identifier}#{data}\n"


def encode_frames(frames: Sequence[Stamped], offset_ns: int, channel: str) -> bytes:
    """Return all but `LOST` frames as `candump -L` lines; `offset_ns`: wall less monotonic time."""
    lines = [
        line_of(frame, max(until_ns + offset_ns, 0), channel)
        for frame, _, until_ns in frames
        if not frame.flags & LOST
    ]
    return "".join(lines).encode()


def bus_name(channel: str) -> str:
    """Return the name of a scene's channel in a log: `_` in place of each space."""
    return channel.replace(" ", "_")


def read_log(path: Path) -> Iterator[Line]:
    """Yield the lines of a CAN log of any kind, those that are not understood too. Raises
    `RecordingError` if the file is of another kind or cannot be read."""
    kind = kind_of(path)
    if kind not in CAN_LOGS:
        raise RecordingError(path, f"is {kind.value}, not a CAN log; {PAGE} lists those")
    with open_recording(path) as stream:
        try:
            yield from read_blf(stream) if kind is Kind.BLF else _TEXTS[kind](_lines(stream))
        except OSError as error:
            raise RecordingError(path, reason(error)) from error


def _lines(stream: BinaryIO) -> Iterator[str]:
    """Yield lines of text in any encoding; a line that is too long comes in pieces."""
    encoding = encoding_of(stream.read(HEAD_BYTES)) or "utf-8"
    stream.seek(0)
    with io.TextIOWrapper(stream, encoding, errors="replace") as text:
        while line := text.readline(LINE_LENGTH_MAX):
            yield line


@dataclass(slots=True)
class Survey:
    """The first lines of a log, by which its bus is chosen; the log is read only once."""

    lines: Iterator[Line]
    """All lines of the log, the first ones included."""
    strange: str = ""
    """The first line that was not understood, with its number; empty: none."""
    frames: Counter[tuple[str, int | None]] = field(default_factory=Counter)
    """Number of frames by bus and arbitration id; id None: CAN FD."""
    lacks_times: bool = False
    """True if the line of `strange` is a frame without a time, as `candump` alone shows it."""
    has_steps: bool = False
    """True if times count from the line before (`candump -td`, ASC with relative times)."""

    @classmethod
    def of(cls, path: Path) -> Survey:
        """Read the first lines of a log. Raises `RecordingError`."""
        log = read_log(path)
        first = list(islice(log, FIRST_LINES))
        survey, last_ns, rises, falls = cls(chain(first, log)), dict[str, int](), 0, 0
        for number, text, logged in first:
            if logged is None:
                if not survey.strange:
                    survey.strange = _shown(number, text)
                    survey.lacks_times = parse(f"(0) {text}") is not None
                continue
            key = logged.bus, None if logged.frame is None else logged.frame.arbitration_id
            is_counted = key in survey.frames or len(survey.frames) < IDS_MAX
            if logged.bus == NO_BUS or logged.t_ns is None or not is_counted:
                continue
            survey.frames[key] += 1
            if logged.may_be_step:
                before_ns = last_ns.setdefault(logged.bus, logged.t_ns)
                rises += logged.t_ns > before_ns
                falls += logged.t_ns < before_ns
                last_ns[logged.bus] = logged.t_ns
        survey.has_steps = bool(last_ns) and falls >= rises * STEPS_SHARE - 1
        return survey


def _shown(number: int, text: str) -> str:
    return f"line {number}, {text.strip()[:SHOWN_LENGTH_MAX]!r}"


class CanLog(LinkLogDriver[CanFrame]):
    """Play one bus of CAN logs through the live driver's `CanStream`."""

    stream: CanStream

    def __init__(
        self,
        paths: Sequence[Path],
        fingers: Sequence[str],
        *,
        channel: str | None = None,
        speed: float | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        **board: Unpack[BoardOptions],
    ) -> None:
        """`channel`: bus to play if the logs have several. `speed`: factor of real time; None: as
        fast as possible. `board`: options of `CanStream`; raises `ValueError` if they are wrong."""
        super().__init__(paths, speed, clock)
        self._fingers, self._board = fingers, board
        self._channel = None if channel is None else bus_name(channel)
        self._bus: str | None = None
        self._surveys: dict[Path, Survey] = {}
        self.begin()

    def begin(self) -> None:
        self._shift_ns = self._last_ns = 0
        self.stream = CanStream("link log", self._fingers, **self._board)

    def close(self) -> None:
        super().close()
        self._surveys = {}

    def survey(self) -> None:
        """Read the first lines of the logs to choose the bus."""
        surveys = {path: Survey.of(path) for path in self.paths}
        frames: Counter[tuple[str, int | None]] = Counter()
        for path, survey in surveys.items():
            if survey.strange and not survey.frames:
                why = "the lines have no times" if survey.lacks_times else "no line was understood"
                problem = f"{why}: {survey.strange}; record with `candump -L`"
                raise RecordingError(path, problem)
            frames += survey.frames
        self._bus = self._choose({bus for bus, _ in frames})
        self._check_ids(frames)
        self._surveys = surveys

    def _choose(self, buses: set[str]) -> str:
        """Return the bus to play. Raises `RecordingError` if no frame was found, or if there are
        several buses and the chosen channel is not one of them."""
        names = ", ".join(sorted(buses)[:SHOWN_MAX])
        if not buses:
            raise RecordingError(self.paths[0], "has no frame")
        if len(buses) == 1:
            (only,) = buses
            if self._channel not in (None, only):
                _log.warning(
                    "%s: has no channel %s; played is %s", self.paths[0], self._channel, only
                )
            return only
        if self._channel not in buses:
            problem = f"has the channels {names}: set tactile.channel to one of them"
            raise RecordingError(self.paths[0], problem)
        _log.info("%s: has the channels %s; played is %s", self.paths[0], names, self._channel)
        return self._channel

    def _check_ids(self, frames: Counter[tuple[str, int | None]]) -> None:
        """Warn if no frame has the board's arbitration id. Raise `RecordingError` if all are CAN
        FD."""
        wanted = self._board.get("arbitration_id")
        ids = {key[1]: count for key, count in frames.items() if key[0] == self._bus}
        if set(ids) == {None}:
            problem = "has frames of CAN FD alone; SynTouch's board sends classic ones"
            raise RecordingError(self.paths[0], problem)
        if wanted is None or wanted in ids:
            return
        most = sorted(ids, key=lambda each: -ids[each])[:SHOWN_MAX]
        names = ", ".join("CAN FD" if each is None else f"{each:#x}" for each in most)
        _log.warning(
            "%s: no frame of the begin has tactile.arbitration_id %#x; there are %s",
            self.paths[0],
            wanted,
            names,
        )

    def records(self, path: Path) -> Iterator[tuple[int, CanFrame]]:
        survey = self._surveys[path]
        buses = {ANY_BUS, NO_BUS, *(bus for bus, _ in survey.frames)}
        since_ns, lines, strange, first = 0, 0, 0, ""
        for number, text, logged in survey.lines:
            if logged is None:
                lines, strange = lines + 1, strange + 1
                first = first or _shown(number, text)
                continue
            lines += logged.bus != NO_BUS
            if logged.t_ns is not None:
                since_ns = logged.t_ns + (since_ns if survey.has_steps else 0)
            if logged.bus not in buses and len(buses) < SHOWN_MAX:
                buses.add(logged.bus)
                _log.warning("%s: line %d has the channel %s, too", path, number, logged.bus)
            if logged.bus not in (self._bus, ANY_BUS):
                continue
            if logged.frame is None:
                self.stream.counters.malformed_frames += 1
                continue
            yield within_limits(path, self._going_on(since_ns), number), logged.frame
        if strange:
            text = "%s: %d of %d lines were not understood; the first is %s"
            _log.warning(text, path, strange, lines, first)

    def _going_on(self, t_ns: int) -> int:
        """Return `t_ns`, raised so that a log's clock set back by over 1 s is a pause of 1 s."""
        t_ns += self._shift_ns
        if t_ns < self._last_ns - SET_BACK_NS:
            self._shift_ns += self._last_ns + SET_BACK_NS - t_ns
            t_ns = self._last_ns + SET_BACK_NS
        self._last_ns = t_ns
        return t_ns

    def feed(self, t_ns: int, record: CanFrame) -> Sequence[Reading]:
        if self.stream.link.state is LinkState.CLOSED:
            self.stream.link.start(t_ns)
            self.stream.link.greeting()
        self.stream.watch(t_ns)
        readings, trouble = self.stream.receive([(record, t_ns, t_ns)])
        self.stream.watch(t_ns)
        if trouble is not None:
            self.stream.interrupt()
        return readings
