"""Recordings that other tools have packed again, and recordings with losses, replay in order."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from msgspec.structs import replace

from graspd.daemon.record import mcap_reader
from graspd.daemon.record.mcap import METADATA, McapWriter
from graspd.daemon.record.mcap_reader import McapReader, RecordedMessage
from graspd.daemon.record.player import McapReplayDriver, RecordedEvent
from graspd.daemon.record.topics import Late
from graspd.drivers.base import RecordingError
from tests.daemon.record.recorded import BOOT
from tests.daemon.record.test_mcap import OFFSET_NS, READING, START_NS, WHOLE, header, read


def packed_again(
    data: bytes, order: Callable[[list[RecordedMessage]], list[RecordedMessage]], **options: int
) -> bytes:
    """Return a recording as another tool writes it: messages by `order`, the metadata last.

    `options`: of the library's `Writer`.
    """
    stream = io.BytesIO()
    writer = Writer(stream, **{"chunk_size": 4000, **options})  # type: ignore[arg-type]
    writer.start(profile="", library="another tool")
    schema = writer.register_schema("any", "jsonschema", b"{}")
    messages = order(read(data))
    channels = {
        kind: writer.register_channel(f"{kind}.right", "json", schema)
        for kind in dict.fromkeys(message.kind for message in messages)
    }
    for message in messages:
        log_ns = message.at_ns + OFFSET_NS
        writer.add_message(channels[message.kind], log_ns, message.payload, log_ns)
    writer.add_metadata(METADATA, header("ff", "th", joints=True).texts())
    writer.finish()
    return stream.getvalue()


def in_fifths(messages: list[RecordedMessage]) -> list[RecordedMessage]:
    """Return every fifth message, then every fifth from the second on, and so on."""
    return [message for first in range(5) for message in messages[first::5]]


@given(st.randoms(use_true_random=False), st.integers(1, 20_000), st.booleans())
@settings(max_examples=50, deadline=None)
def test_shuffled_or_truncated_files_are_read_in_time_order(
    random: Random, chunk: int, chunked: bool
) -> None:
    def shuffled(messages: list[RecordedMessage]) -> list[RecordedMessage]:
        return random.sample(messages, len(messages))

    data = packed_again(WHOLE, shuffled, chunk_size=chunk, use_chunking=chunked)
    assert read(data) == read(WHOLE)
    with contextlib.suppress(RecordingError):
        found = [message.at_ns for message in read(data[: random.randrange(len(data))])]
        assert found == sorted(found)


def test_messages_too_far_out_of_order_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_reader, "OPEN_MAX_BYTES", 10_000)
    with pytest.raises(RecordingError, match="`mcap sort` puts it in order"):
        read(packed_again(WHOLE, in_fifths))
    assert read(packed_again(WHOLE, list)) == read(WHOLE)


def test_without_metadata_the_messages_give_the_header() -> None:
    reader = McapReader(Path("a.mcap"), io.BytesIO(without_metadata(WHOLE)))
    assert reader.header.fingers == ("ff", "th")
    assert (reader.header.boot_id, reader.header.joints) == (BOOT, True)
    # Readings were 2 ms old when they were recorded: that is not known any more.
    assert [m.at_ns for m in reader] == [m.at_ns - 2_000_000 for m in read(WHOLE)]


def without_metadata(data: bytes) -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start(profile="", library="another tool")
    for message in read(data):
        channel = writer.register_channel(f"{message.kind}.right", "json", 0)
        log_ns = message.at_ns + OFFSET_NS
        writer.add_message(channel, log_ns, message.payload, log_ns)
    writer.finish()
    return stream.getvalue()


def test_two_recordings_in_one_file_are_refused() -> None:
    stream = io.BytesIO(packed_again(WHOLE, list))
    writer = Writer(stream)
    writer.start(profile="", library="another tool")
    for number in range(2):
        texts = replace(header("ff", "th", joints=True), file=number).texts()
        writer.add_metadata(METADATA, texts)
    writer.finish()
    with pytest.raises(RecordingError, match="several recordings"):
        read(stream.getvalue())


def play(driver: McapReplayDriver) -> None:
    while not driver.exhausted:
        driver.read_ready()


@pytest.mark.parametrize("change", [bytes, without_metadata])
def test_readings_of_another_run_are_refused(
    tmp_path: Path, change: Callable[[bytes], bytes]
) -> None:
    def two(messages: list[RecordedMessage]) -> list[RecordedMessage]:
        other = [
            message._replace(payload=message.payload.replace(BOOT.encode(), b"f" * 32))
            for message in messages
        ]
        return [*messages[:20], *other[20:]]

    path = tmp_path / "a.mcap"
    path.write_bytes(change(packed_again(WHOLE, two)))
    with McapReplayDriver([path], ("ff", "th")) as driver:
        with pytest.raises(RecordingError, match="several recordings"):
            play(driver)
        assert driver.counters.readings == 10


LINES: dict[str, tuple[str, object]] = {
    "tactile": ("tactile", READING),
    "stale": ("verdict", {"reasons": ["stale"]}),
    "stable": ("verdict", {"reasons": []}),
    "dropped": ("dropped", {}),
}
"""First part of the topic, and content, of each message that the tests name."""


@pytest.mark.parametrize(
    ("recorded", "is_cut", "called_late"),
    [
        (("tactile", "stable", "tactile"), False, [False, False]),
        (("tactile", "stable", "tactile"), True, [False, True]),
        (("tactile", "stable"), True, [False]),
        (("tactile", "stale"), True, [True]),
        (("tactile", "dropped", "tactile", "stable"), False, [True, False]),
        (("tactile", "stable", "dropped", "tactile", "stable"), False, [False, False]),
        (("tactile", "stale", "dropped", "tactile", "stable"), False, [True, False]),
    ],
)
def test_an_unjudged_reading_before_a_loss_is_played_as_late(
    tmp_path: Path, recorded: tuple[str, ...], is_cut: bool, called_late: list[bool]
) -> None:
    path = tmp_path / "a.mcap"
    file = McapWriter(path, header("ff", joints=False))
    for topic, content in (LINES[name] for name in recorded):
        file.write(f"{topic}.right".encode(), json.dumps(content).encode(), START_NS)
    file.close()
    if is_cut:
        path.write_bytes(path.read_bytes()[:-1])
    found, events = list[bool](), list[RecordedEvent]()
    with McapReplayDriver([path], ("ff",)) as driver:
        driver.on_event = events.append
        while not driver.exhausted:
            if driver.read_ready():
                found.append(any(isinstance(event, Late) for event in events))
                events.clear()
        assert driver.counters.cut_off == is_cut
    assert found == called_late
