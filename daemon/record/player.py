"""Driver that plays recordings of graspd."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass

from graspd.daemon.judge.exchange import Exchanged
from graspd.daemon.judge.reasons import Reason
from graspd.daemon.publish.messages import GateMessage, OutcomeMessage, decode_outcome
from graspd.daemon.record.mcap_reader import SEVERAL, McapReader, RecordedMessage, header_of
from graspd.daemon.record.topics import (
    EVENTS,
    MALFORMED,
    PLAYED,
    Late,
    Said,
    TakenBack,
    Topic,
    boot_id_of,
    decode_exchanged,
    decode_gate,
    decode_late,
    decode_said,
    decode_taken_back,
    joint_reading,
    tactile_reading,
)
from graspd.drivers.base import DriverCounters, Reading, RecordingError, TactileReading
from graspd.drivers.recordings.kinds import open_recording
from graspd.drivers.recordings.player import ReadingsDriver, within_limits

_log = logging.getLogger(__name__)

RecordedEvent = Topic | OutcomeMessage | Exchanged | TakenBack | Late | GateMessage | Said
"""An event of `EVENTS`, a lift taken back, an outcome or an exchange of sensors. `Late`,
`GateMessage` and `Said` are about the next reading: late, a change of the gate, its verdict."""
_Item = Reading | RecordedEvent
LATE = b'{"judged":false}'
"""Content of the `late` message played before a reading that may have been late."""
STALE = f'"{Reason.STALE}"'.encode()
"""Text in the JSON of a verdict on a late reading."""
HELD_MAX = 64
"""Most messages that may stand between a reading and the messages about it."""


@dataclass(slots=True)
class McapCounters(DriverCounters):
    """Counters of a replay."""

    malformed: int = 0
    """Malformed messages, and readings of other fingers."""
    cut_off: int = 0
    """Files that were cut off or are damaged."""


class McapReplayDriver(ReadingsDriver[_Item]):
    """Play the files of one run, at most one reading per call of `read_ready`.

    A damaged file is played up to the damage, and counted.
    """

    on_event: Callable[[RecordedEvent], None] | None = None
    """Called with each recorded event; those about a reading come before it. None: not called."""

    def reset(self) -> None:
        super().reset()
        self.counters = McapCounters()

    def open(self) -> None:
        """Check the header of each file, then start from the first. Raises `RecordingError`."""
        self.close()
        self.reset()
        for path in self.paths:
            recorded = header_of(path).fingers
            missing = [finger for finger in self._fingers if finger not in recorded]
            if missing:
                raise RecordingError(path, f"has no finger {missing[0]}, only {recorded}")
        self.start(self._items())

    def read_ready(self) -> Sequence[Reading]:
        """Return the next reading if it is due, or pass an event to `on_event` and return `()`. A
        verdict is passed together with its reading."""
        taken = self.take()
        if taken is None:
            return ()
        at_ns, item = taken
        if isinstance(item, Said):  # the reading of this verdict follows at once
            if self.on_event is not None:
                self.on_event(item)
            return self.read_ready()
        if isinstance(item, RecordedEvent):
            if self.on_event is not None:
                self.on_event(item)
            return ()
        if isinstance(item, TactileReading):
            self._count(item)
        return [self.hand_over(item, at_ns)]

    def _count(self, made: TactileReading) -> None:
        self.counters.readings += 1
        self.counters.faulty_readings += bool(made.faults.any())
        self.follow(made.t_ns)

    def _items(self) -> Generator[tuple[int, _Item], None, None]:
        for path in self.paths:
            with open_recording(path) as stream:
                recording = McapReader(path, stream)
                boot_id: bytes | None = None
                for message in _in_order(recording):
                    item = self._item_of(message)
                    if isinstance(item, TactileReading):
                        boot_id = boot_id or boot_id_of(message.payload)
                        if boot_id not in message.payload:
                            raise RecordingError(path, SEVERAL)
                    if item is not None:
                        yield within_limits(path, message.at_ns), item
                if recording.cut_off:
                    self.counters.cut_off += 1
                    _log.warning("%s: is cut off or damaged; played up to there", path)

    def _item_of(self, message: RecordedMessage) -> _Item | None:
        try:
            match message.kind:
                case Topic.TACTILE:
                    return tactile_reading(message.payload, self._fingers)
                case Topic.JOINTS:
                    return joint_reading(message.payload)
                case Topic.OUTCOME:
                    return decode_outcome(message.payload)
                case Topic.EXCHANGED:
                    return decode_exchanged(message.payload)
                case Topic.TAKEN_BACK:
                    return decode_taken_back(message.payload)
                case Topic.LATE:
                    return decode_late(message.payload)
                case Topic.GATE:
                    return decode_gate(message.payload)
                case Topic.VERDICT:
                    return decode_said(message.payload)
        except MALFORMED:
            self.counters.malformed += 1
            return None
        return Topic(message.kind) if message.kind in EVENTS else None


def _in_order(recording: McapReader) -> Iterator[RecordedMessage]:
    """Yield the messages to play; messages about a reading come before it, with its time.

    The `late` mark of a reading may be lost; its verdict shows it as well. Without a verdict the
    last reading before a loss counts as late.
    """
    held: list[RecordedMessage] = []
    was_in_time = is_judged = False
    for message in recording:
        if message.kind in (Topic.LATE, Topic.GATE):
            yield message._replace(at_ns=held[0].at_ns) if held else message
        elif message.kind == Topic.VERDICT:
            was_in_time = STALE not in message.payload
            if held and not is_judged:  # later verdicts are about silence
                is_judged = True
                yield message._replace(at_ns=held[0].at_ns)
        elif message.kind == Topic.TACTILE:
            yield from held
            held, was_in_time, is_judged = [message], False, False
        elif message.kind == Topic.DROPPED:
            _log.warning("%s: the disk was slow: verdicts may differ after a loss", recording.path)
            yield from held if was_in_time else _called_late(held)
            yield message._replace(kind=Topic.SKIPPED)
            held.clear()
        elif message.kind in PLAYED and held:
            held.append(message)
        elif message.kind in PLAYED:
            yield message
        if len(held) == HELD_MAX:
            yield from held
            held.clear()
    yield from held if was_in_time or not recording.cut_off else _called_late(held)


def _called_late(held: Sequence[RecordedMessage]) -> Iterator[RecordedMessage]:
    """Yield a `late` mark, which makes the verdict `stale` in the replay too, then `held`: a
    reading and messages about it; nothing if it is empty."""
    if held:
        yield held[0]._replace(kind=Topic.LATE, payload=LATE)
    yield from held
