"""Records readings, published messages and events in files, without ever holding up the loop.

The loop appends to a bounded queue and a thread writes: a slow or full disk costs entries, which
are counted, and no time of the loop.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, cast

import msgspec
from msgspec.structs import replace

from daemon.process.worker import Worker
from daemon.publish.companion import Companion, LoopEvent, PublishedVerdict
from daemon.record.files import RecordingFile, Retention
from daemon.record.flat import flat
from daemon.record.header import RecordingHeader
from daemon.record.mcap import McapWriter
from daemon.record.topics import EVENT, Exchanged, Joints, Judged, Topic
from daemon.record.viewers import ForPeople
from daemon.scene.scene import Record
from drivers.base import JointReading, Reading

if TYPE_CHECKING:
    from daemon.publish.messages import Status
    from daemon.record.link_log import Tap
    from daemon.trust.learner import LearnerState
    from models.session_statistics import SessionState

log = logging.getLogger("graspd")

QUEUE_MAX: Final = 20_000
"""Entries that may wait for the disk, some 12 MB: a minute of readings at 100 Hz, with verdicts
and joints. Beyond, the newest are dropped."""
RETRY_NS: Final = 60_000_000_000
"""From a failure of the disk to the next try, ns."""
ROUNDS_PER_FLUSH: Final = 10
"""How often the thread empties the queue between two flushes: seldom, so that it hardly ever needs
the interpreter when the loop does."""
FLUSH_AFTER: Final = 0.8
"""Part of the flush interval after which a flush is due: with a round and the writing, nothing
waits longer than the interval."""
CLOSE_S: Final = 0.5
"""How long `close` waits for the thread, s."""


MakeHeader = Callable[[], RecordingHeader]
"""Encodes a state that the loop has copied; called in the thread."""

LINK: Final = b""
"""Topic of entries for the link log."""
NEXT_FILES: Final = b"next"
"""Topic of the entry after which new files begin; its content is a `MakeHeader`."""

_Entry = tuple[int, bytes, object]
"""Monotonic ns; topic; payload, or a function that makes the message."""


@dataclass(slots=True, eq=False)
class _Open:
    """Files that are being written, and since when, monotonic ns."""

    messages: McapWriter
    link_log: RecordingFile | None
    offset_ns: int
    since_ns: int
    unflushed: int = 0
    """Entries that are written to these files, but perhaps not yet on the disk."""

    def all(self) -> list[RecordingFile]:
        """One or two files."""
        return [self.messages] if self.link_log is None else [self.messages, self.link_log]


class Recorder(Companion):
    """Records one run of the daemon. `send` and the hooks never block or raise."""

    def __init__(
        self,
        retention: Retention,
        options: Record,
        *,
        take_header: Callable[[], MakeHeader],
        tap: Tap | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        wall_clock: Callable[[], int] = time.time_ns,
    ) -> None:
        """Start the thread, which creates the first file.

        `take_header` copies what is known, for the header of a file, which lacks only what each
        file has of its own. It is called in the loop, here and where a file is to end: after a
        status, when no reading is being judged. `tap` gives what comes over the link.
        """
        self._retention = retention
        self._rotate_bytes = round(options.rotate_mb * 1e6)
        self._rotate_ns = round(options.rotate_minutes * 60e9)
        self._flush_ns = round(options.flush_ms * 1e6)
        self._take_header = take_header
        self._tap = tap
        self._clock = clock
        self._wall_clock = wall_clock
        self._queue: deque[_Entry] = deque()
        self._names = {topic: f"{topic}.{retention.hand}".encode() for topic in Topic}
        self._last_topic = b""
        """That of the newest entry."""
        self._for_people = ForPeople(options.images_hz)
        self._counted = Counter(recorded=0, lost=0, files=0, removed=0, failures=0)
        self._dropped = 0
        self._open: _Open | None = None
        self._number = 0
        self._flush_due_ns = clock() + self._flush_ns
        self._retry_due_ns: int | None = None
        self._awaits_turn = True
        """True while `NEXT_FILES` is queued, or will be when the loop sees `_wants_turn`."""
        self._wants_turn = False
        self._queue.append((clock(), NEXT_FILES, take_header()))
        self._stopping = threading.Event()
        self._worker: Worker[None] = Worker("recorder")
        self._worker.submit(self._work)
        if tap is not None:
            tap.connect(partial(self._put, LINK))

    def send(self, topic: bytes, payload: bytes) -> None:
        """Record a published message."""
        self._put(topic, payload)

    def wanted(self, topic: bytes) -> bool:
        """Always: what nobody subscribes to is recorded all the same."""
        return True

    def on_reading(self, reading: Reading) -> None:
        """Record joint angles; tactile readings come as messages."""
        if isinstance(reading, JointReading):
            self._put(self._names[Topic.JOINTS], partial(Joints.of, reading))

    def on_verdict(self, published: PublishedVerdict) -> None:
        """Record the counts that the network judged."""
        judgement = published.judgement
        if judgement.moment.judged and judgement.judged_counts is not None:
            making = partial(Judged.of, self._retention.boot_id, judgement)
            self._put(self._names[Topic.JUDGED], making)

    def on_event(self, event: LoopEvent) -> None:
        """Record an event; a question that follows another one adds nothing."""
        topic = self._names[Topic(event.value)]
        if topic != self._last_topic:
            self._put(topic, EVENT)

    def on_status(self, status: Status) -> None:
        """Copy the state if the thread waits for it to go on in new files."""
        if self._wants_turn:
            self._wants_turn = False
            self._queue.append((self._clock(), NEXT_FILES, self._take_header()))

    def exchanged(self, session: SessionState | None, learned: LearnerState | None) -> None:
        """Record that a sensor is another one than before, and what was known of the new ones."""
        self._put(self._names[Topic.EXCHANGED], partial(Exchanged, session, learned))

    def _put(self, topic: bytes, content: object, at_ns: int | None = None) -> None:
        if len(self._queue) >= QUEUE_MAX:
            self._dropped += 1
        else:
            self._queue.append((self._clock() if at_ns is None else at_ns, topic, content))
            self._last_topic = topic

    @property
    def counters(self) -> dict[str, dict[str, int]]:
        """Since the start: entries `recorded`, `dropped` because the disk was too slow, and `lost`
        when it failed; `files` begun and `removed`, `failures`; `writing`, 1 while a file is open.
        """
        writing = int(self._open is not None)
        return {"record": {**self._counted, "dropped": self._dropped, "writing": writing}}

    def close(self) -> None:
        """Write what is queued and end the files; give up if the disk does not answer in time."""
        if self._stopping.is_set():
            return
        self._stopping.set()
        if not self._worker.close(CLOSE_S):
            log.warning("record: the disk does not answer, the end of the recording is lost")

    def _work(self) -> None:
        try:
            while not self._stopping.wait(self._flush_ns / ROUNDS_PER_FLUSH / 1e9):
                self.go_round()
            self._flush_due_ns = 0
            self.go_round()
        except BaseException:
            self._counted["failures"] += 1  # a mistake of ours: the status must not say `writing`
            log.exception("record: nothing is recorded any more")
            raise
        finally:
            self._finish()

    def go_round(self) -> None:
        """Write what is queued; after a failure lose it until the next try is due."""
        entries = [self._queue.popleft() for _ in range(len(self._queue))]
        now_ns = self._clock()
        if self._open is None and (self._retry_due_ns is None or now_ns >= self._retry_due_ns):
            self._turn()
        for at_ns, topic, content in entries:
            if topic == NEXT_FILES:
                self._take_turn(cast(MakeHeader, content), now_ns)
            elif self._open is None:
                self._counted["lost"] += 1
            else:
                self._write(self._open, topic, content, at_ns)
        if self._open is not None and now_ns >= self._flush_due_ns:
            self._flush(self._open, now_ns)

    def _turn(self) -> None:
        """Go on in new files where the loop next copies its state."""
        if not self._awaits_turn:
            self._awaits_turn = self._wants_turn = True

    def _take_turn(self, make_header: MakeHeader, now_ns: int) -> None:
        """Go on in new files, except for the few entries that come after `close`."""
        self._awaits_turn = False
        if self._open is None or not self._stopping.is_set():
            self._finish()
            self._begin(now_ns, make_header())

    def _begin(self, now_ns: int, header: RecordingHeader) -> None:
        """Create the next files, if the disk takes them."""
        offset_ns = self._wall_clock() - now_ns
        try:
            self._counted["removed"] += self._retention.make_room(self._rotate_bytes)
            name = self._retention.name(self._number)
            path = name.with_name(f"{name.name}.mcap")
            messages = McapWriter(
                path,
                replace(header, file=self._number, wall_minus_monotonic_ns=offset_ns),
            )
            link_log = None
            try:
                if self._tap is not None:
                    link_log = RecordingFile(name.with_name(f"{name.name}{self._tap.ending}"))
            except OSError:
                messages.remove()
                raise
        except OSError as error:
            self._fail(error)
            return
        log.info("record: %s", path)
        self._retry_due_ns = None
        self._number += 1
        self._counted["files"] += 1
        self._open = _Open(messages, link_log, offset_ns, now_ns)

    def _write(self, files: _Open, topic: bytes, content: object, at_ns: int) -> None:
        files.unflushed += 1
        try:
            if topic != LINK:
                self._write_message(files, topic, content, at_ns)
            elif files.link_log is not None and self._tap is not None:
                entry = cast(tuple[object, ...], content)
                files.link_log.append(self._tap.encode(at_ns, files.offset_ns, *entry))
        except OSError as error:
            self._fail(error)

    def _write_message(self, files: _Open, topic: bytes, content: object, at_ns: int) -> None:
        """Write a message, and what it comes to for people."""
        if callable(content):
            message = msgspec.to_builtins(content())
        else:
            message = msgspec.json.decode(cast(bytes, content))
        files.messages.write(topic, msgspec.json.encode(flat(message)), at_ns)
        kind, wall_ns = topic.partition(b".")[0].decode(), at_ns + files.offset_ns
        for made, payload in self._for_people.of(kind, message, wall_ns):
            files.messages.write(self._names[Topic(made)], payload, at_ns)

    def _flush(self, files: _Open, now_ns: int) -> None:
        try:
            size = sum(file.flush() for file in files.all())
        except OSError as error:
            self._fail(error)
            return
        self._counted["recorded"] += files.unflushed
        files.unflushed = 0
        self._flush_due_ns = now_ns + round(self._flush_ns * FLUSH_AFTER)
        if size >= self._rotate_bytes or now_ns - files.since_ns >= self._rotate_ns:
            self._turn()

    def _finish(self) -> None:
        files = self._open
        if files is None:
            return
        try:
            for file in files.all():
                file.close()
        except OSError as error:
            self._fail(error)
            return
        self._open = None
        self._counted["recorded"] += files.unflushed

    def _fail(self, error: OSError) -> None:
        """After a failure of the disk: warn, the first time, and try again later."""
        files, self._open = self._open, None
        self._number += 1  # the next file does not go on where the last one ends
        if files is not None:
            self._counted["lost"] += files.unflushed
            for file in files.all():
                file.abandon()
        self._counted["failures"] += 1
        first = self._retry_due_ns is None
        self._retry_due_ns = self._clock() + RETRY_NS
        say = log.warning if first else log.debug
        where = self._retention.directory
        say("record: %s: %s; nothing is recorded", where, error.strerror or error)
