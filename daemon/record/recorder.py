"""Record readings, published messages and events in files, without delaying the loop.

The loop appends to a bounded queue, and a thread writes. A slow disk costs entries, not time.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec
from msgspec.structs import replace

from graspd.daemon.judge.exchange import Exchanged
from graspd.daemon.judge.reasons import Reason
from graspd.daemon.process.worker import Worker
from graspd.daemon.publish.companion import Companion, LoopEvent, PublishedVerdict
from graspd.daemon.record.mcap import (
    McapWriter,
    RecordingFile,
    RecordingHeader,
    make_room,
    rotate_bytes,
)
from graspd.daemon.record.topics import EVENT, Joints, Judged, Late, TakenBack, Topic, flat
from graspd.daemon.record.viewers import Viewer
from graspd.daemon.scene.scene import Record
from graspd.daemon.trust.lift_book import GraspId
from graspd.drivers.base import JointReading, Reading

if TYPE_CHECKING:
    from graspd.daemon.publish.messages import Status
    from graspd.daemon.record.link_log import Tap

log = logging.getLogger("graspd")

FLUSH_NS: Final = 1_000_000_000
"""Longest time of data that is lost if the daemon is killed or the power fails, ns."""
ROTATE_NS: Final = 3_600_000_000_000
"""Age of files at which new ones begin, ns: an hour."""
QUEUE_MAX: Final = 20_000
"""Most queued entries: 12 MB, a minute of readings. Later ones are dropped."""
RETRY_NS: Final = 60_000_000_000
"""Time after a failure of the disk until the next try, ns."""
ROUNDS_PER_FLUSH: Final = 10
"""Rounds of the thread in a flush interval; few, so that it rarely delays the loop."""
FLUSH_AFTER: Final = 0.8
"""Share of the flush interval after which a flush is due; a round and the writing follow."""
CLOSE_S: Final = 0.5
"""Longest wait of `close` for the thread, s."""
PATIENCE_S: Final = 60.0
"""Longest wait for the disk in a replay as fast as possible, s. No hand waits for it."""

MakeHeader = Callable[[], RecordingHeader]
"""Function that makes a header from a copied state; the thread calls it."""

LINK: Final = b""
"""Topic of entries that are link traffic."""
NEXT_FILES: Final = b"next"
"""Topic of an entry that begins new files; its content is a `MakeHeader`."""

_Entry = tuple[int, bytes, object]
"""Monotonic time, ns, topic, and payload, a function that makes it, or parts of link traffic."""


@dataclass(slots=True, eq=False)
class _Open:
    """Files that are being written."""

    files: list[RecordingFile]
    """The recording, then the link log, if there is one."""
    offset_ns: int
    """Wall time less monotonic time, ns."""
    since_ns: int
    """Monotonic time of the start of the files, ns."""
    unflushed: int = 0
    """Number of entries that may not be on the disk yet."""


class Recorder(Companion):
    """Records one run of the daemon. Methods never raise, and only `close` waits for the disk."""

    def __init__(
        self,
        options: Record,
        hand: str,
        boot_id: str,
        *,
        take_header: Callable[[], MakeHeader],
        tap: Tap | None = None,
        patience_s: float = 0.0,
        clock: Callable[[], int] = time.monotonic_ns,
        wall_clock: Callable[[], int] = time.time_ns,
    ) -> None:
        """Start the thread, which creates the first file.

        `take_header`: copies session and learning for a file's header. It is called here and after
        a status, when no reading is being judged. `tap`: gives the link's traffic; None: it is not
        recorded. `patience_s`: longest wait for a slow disk in `close` (at least `CLOSE_S`) and in
        `ReplayRecorder`. `clock`: monotonic ns. `wall_clock`: ns since 1970.
        """
        self._options = options
        self._hand = hand
        self._boot_id = boot_id
        self._take_header = take_header
        self._tap = tap
        self._clock = clock
        self._wall_clock = wall_clock
        self._queue: deque[_Entry] = deque()
        self._names = {topic: f"{topic}.{hand}".encode() for topic in Topic}
        self._last_topic = b""
        self._viewer = Viewer()
        self._counted = Counter(recorded=0, lost=0, files=0, removed=0, failures=0)
        self._dropped = 0
        self._room = QUEUE_MAX
        """Most entries of the queue; 0 after a drop, until the recording has a note of it."""
        self._patience_s = patience_s
        self._taken = threading.Event()
        """Set after the thread has taken the entries of the queue."""
        self._open: _Open | None = None
        self._number = 0
        self._flush_due_ns = clock() + FLUSH_NS
        self._retry_due_ns: int | None = None
        self._awaits_turn = True
        """True while `NEXT_FILES` is queued or requested by `_wants_turn`."""
        self._wants_turn = False
        self._queue.append((clock(), NEXT_FILES, take_header()))
        self._stopping = threading.Event()
        self._worker: Worker[None] = Worker("recorder")
        self._worker.submit(self._work)
        if tap is not None:
            tap.connect(partial(self._put, LINK))

    def send(self, topic: bytes, payload: bytes) -> None:
        self._put(topic, payload)

    def wanted(self, topic: bytes) -> bool:
        """Return True: all topics are recorded, also without a subscriber."""
        return True

    def on_reading(self, reading: Reading) -> None:
        """Record joint angles; tactile readings are recorded as messages."""
        if isinstance(reading, JointReading):
            self._put(self._names[Topic.JOINTS], partial(Joints.of, reading))

    def on_verdict(self, published: PublishedVerdict) -> None:
        judgement = published.judgement
        if published.reading is not None and Reason.STALE in judgement.reasons:
            late = Late(judgement.moment.judges)
            self._put(self._names[Topic.LATE], lambda: late)
        if judgement.moment.judged and judgement.judged_counts is not None:
            making = partial(Judged.of, self._boot_id, judgement)
            self._put(self._names[Topic.JUDGED], making)

    def on_event(self, event: LoopEvent, grasp: GraspId | None = None) -> None:
        """Record an event. Equal events in a row are recorded once, except `TAKEN_BACK`."""
        topic = self._names[Topic(event.value)]
        if event is LoopEvent.TAKEN_BACK and grasp is not None:
            self._put(topic, partial(TakenBack, *grasp))
        elif topic != self._last_topic or event is LoopEvent.TAKEN_BACK:
            self._put(topic, EVENT)

    def on_status(self, status: Status) -> None:
        """Copy the state if the thread needs it for new files."""
        if self._wants_turn:
            self._wants_turn = False
            self._queue.append((self._clock(), NEXT_FILES, self._take_header()))

    def exchanged(self, known: Exchanged) -> None:
        self._put(self._names[Topic.EXCHANGED], lambda: known)

    def _put(self, topic: bytes, content: object, at_ns: int | None = None) -> None:
        if len(self._queue) < self._room or self._goes_on():
            self._queue.append((self._clock() if at_ns is None else at_ns, topic, content))
            self._last_topic = topic

    def _goes_on(self) -> bool:
        """Return True, after queueing `dropped`, if there is room again; else count a drop."""
        if len(self._queue) >= QUEUE_MAX:
            self._dropped += 1
            self._room = 0
            return False
        self._room = QUEUE_MAX
        self._put(self._names[Topic.DROPPED], EVENT)
        return True

    @property
    def counters(self) -> dict[str, dict[str, int]]:
        """Under `record`: entries `recorded`, `dropped` (slow disk), `lost` (failed disk); `files`
        begun and `removed`; `failures` of the disk; `writing`, 1 while files are open."""
        writing = int(self._open is not None)
        return {"record": {**self._counted, "dropped": self._dropped, "writing": writing}}

    def close(self) -> None:
        """Write the queue and close the files, if the disk answers in time."""
        if self._stopping.is_set():
            return
        self._stopping.set()
        if not self._worker.close(max(CLOSE_S, self._patience_s)):
            log.warning("record: the disk does not answer, the end of the recording is lost")

    def _work(self) -> None:
        try:
            while not self._stopping.wait(FLUSH_NS / ROUNDS_PER_FLUSH / 1e9):
                self.go_round()
            self._flush_due_ns = 0
            self.go_round()
        except BaseException:
            self._counted["failures"] += 1  # a bug of graspd, which the status shows
            log.exception("record: nothing is recorded any more")
            raise
        finally:
            self._finish()

    def go_round(self) -> None:
        """Write queued entries, flush if due; while no file is open, count the entries as lost."""
        entries = [self._queue.popleft() for _ in range(len(self._queue))]
        self._taken.set()
        now_ns = self._clock()
        if self._open is None and (self._retry_due_ns is None or now_ns >= self._retry_due_ns):
            self._ask_for_turn()
        for at_ns, topic, content in entries:
            if topic == NEXT_FILES:
                self._take_turn(cast(MakeHeader, content), now_ns)
            elif self._open is None:
                self._counted["lost"] += 1
            else:
                self._write(self._open, topic, content, at_ns)
        if self._open is not None and now_ns >= self._flush_due_ns:
            self._flush(self._open, now_ns)

    def _ask_for_turn(self) -> None:
        """Ask the loop to copy its state for new files."""
        if not self._awaits_turn:
            self._awaits_turn = self._wants_turn = True

    def _take_turn(self, make_header: MakeHeader, now_ns: int) -> None:
        """Begin new files, unless `close` was called while files are open."""
        self._awaits_turn = False
        if self._open is None or not self._stopping.is_set():
            self._finish()
            self._begin(now_ns, make_header())

    def _begin(self, now_ns: int, header: RecordingHeader) -> None:
        offset_ns = self._wall_clock() - now_ns
        header = replace(header, file=self._number, wall_minus_monotonic_ns=offset_ns)
        # Names sort by time.
        began = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        stamp = f"{began}-{self._boot_id[:8]}-{self._number:04}"
        path = self._options.folder / f"{self._hand}-{stamp}.mcap"
        files: list[RecordingFile] = []
        try:
            self._counted["removed"] += make_room(self._options, self._hand, stamp)
            files.append(McapWriter(path, header))
            if self._tap is not None:
                files.append(RecordingFile(path.with_suffix(self._tap.ending)))
        except OSError as error:
            for file in files:
                file.remove()
            self._fail(error)
            return
        log.info("record: %s", path)
        self._retry_due_ns = None
        self._number += 1
        self._counted["files"] += 1
        self._open = _Open(files, offset_ns, now_ns)

    def _write(self, current: _Open, topic: bytes, content: object, at_ns: int) -> None:
        current.unflushed += 1
        try:
            if topic == LINK and self._tap is not None:
                entry = cast(tuple[object, ...], content)
                current.files[-1].append(self._tap.encode(at_ns, current.offset_ns, *entry))
            else:
                self._write_message(current, topic, content, at_ns)
        except OSError as error:
            self._fail(error)

    def _write_message(self, current: _Open, topic: bytes, content: object, at_ns: int) -> None:
        """Write a message, and the log lines and images made from it."""
        message = _message(content)
        file = cast(McapWriter, current.files[0])
        file.write(topic, msgspec.json.encode(flat(message)), at_ns)
        kind = topic.partition(b".")[0].decode()
        for made, payload in self._viewer.of(kind, message, at_ns + current.offset_ns):
            file.write(self._names[Topic(made)], payload, at_ns)

    def _flush(self, current: _Open, now_ns: int) -> None:
        try:
            size = sum(file.flush() for file in current.files)
        except OSError as error:
            self._fail(error)
            return
        self._counted["recorded"] += current.unflushed
        current.unflushed = 0
        self._flush_due_ns = now_ns + round(FLUSH_NS * FLUSH_AFTER)
        if size >= rotate_bytes(self._options) or now_ns - current.since_ns >= ROTATE_NS:
            self._ask_for_turn()

    def _finish(self) -> None:
        current = self._open
        if current is None:
            return
        try:
            for file in current.files:
                file.close()
        except OSError as error:
            self._fail(error)
            return
        self._open = None
        self._counted["recorded"] += current.unflushed

    def _fail(self, error: OSError) -> None:
        """Close the files after a failure of the disk; count it, warn once, schedule a retry."""
        current, self._open = self._open, None
        self._number += 1  # the next file does not follow the last one
        if current is not None:
            self._counted["lost"] += current.unflushed
            for file in current.files:
                file.abandon()
        self._counted["failures"] += 1
        is_first = self._retry_due_ns is None
        self._retry_due_ns = self._clock() + RETRY_NS
        say = log.warning if is_first else log.debug
        where = self._options.folder
        say("record: %s: %s; nothing is recorded", where, error.strerror or error)


class ReplayRecorder(Recorder):
    """Records a replay at any pace, with the times of its readings.

    Messages are recorded as if each reading had arrived at its own time.
    """

    _base_ns: int | None = None
    """Monotonic time of the zero of the readings' times, ns. None before the first reading."""
    _now_ns = 0
    """Time of the last reading, ns."""
    _ahead_ns = 0
    """Time at which the last reading was played, less `_now_ns`, ns."""

    def on_reading(self, reading: Reading) -> None:
        if self._base_ns is None:
            self._base_ns = reading.t_ns - reading.made_ns
        self._now_ns = self._base_ns + reading.made_ns
        self._ahead_ns = reading.t_ns - self._now_ns
        super().on_reading(reading)

    def _put(self, topic: bytes, content: object, at_ns: int | None = None) -> None:
        if self._base_ns is not None:
            content, at_ns = partial(_moved, content, self._ahead_ns), self._now_ns
        super()._put(topic, content, at_ns)

    def on_verdict(self, published: PublishedVerdict) -> None:
        """Record a verdict's late mark and counts; if the queue is half full, wait for the disk."""
        super().on_verdict(published)
        self._taken.clear()
        is_full = len(self._queue) >= QUEUE_MAX // 2
        if is_full and self._patience_s and not self._taken.wait(self._patience_s):
            self._patience_s = 0.0


def _moved(content: object, ahead_ns: int) -> dict[str, object]:
    """Return the message with a monotonic time that is earlier by `ahead_ns`."""
    message = _message(content)
    if "t_mono_ns" in message:
        message["t_mono_ns"] = max(message["t_mono_ns"] - ahead_ns, 0)
    return message


def _message(content: object) -> dict[str, Any]:
    """Return the message of an entry, decoded; `content`: its JSON, or a function that makes it."""
    if callable(content):
        return cast(dict[str, Any], msgspec.to_builtins(content()))
    return cast(dict[str, Any], msgspec.json.decode(cast(bytes, content)))
