"""Recordings are read up to the first damage, and no content of a file breaks the reader."""

from __future__ import annotations

import contextlib
import io
import json
import struct
import tempfile
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk
from mcap.writer import Writer
from msgspec import to_builtins
from msgspec.structs import replace

from graspd.biotac import FINGERS
from graspd.daemon.publish.messages import Tactile
from graspd.daemon.record.mcap import METADATA, McapWriter, RecordingHeader
from graspd.daemon.record.mcap_reader import (
    CHUNK_MAX_BYTES,
    RATIO_MAX,
    McapReader,
    RecordedMessage,
    header_of,
)
from graspd.daemon.record.player import McapReplayDriver
from graspd.daemon.record.topics import Joints, flat
from graspd.drivers.base import JointReading, RecordingError, TactileReading
from graspd.models.session_statistics import SessionState
from tests.daemon.record.recorded import BOOT, HEADER

OFFSET_NS = 10**18
START_NS = 5 * 10**12
PERIOD_NS = 10_000_000
READINGS = 20
READING = {
    **{"v": 1, "boot_id": BOOT, "seq": 1, "t": 0.0, "t_mono_ns": START_NS},
    **{"fingers": ["ff"], "counts": [1] * 24, "faults": [0] * 24},
}
NOW_NS = 7 * 10**12
REQUIRED = ("fingers", "joints", "boot_id", "scene", "model", "model_sha256")
"""Fields of a header without which a file is refused."""


def counts_of(number: int) -> list[list[int]]:
    counts: list[list[int]] = np.random.default_rng(number).integers(0, 4096, (2, 24)).tolist()
    return counts


def header(*fingers: str, joints: bool) -> RecordingHeader:
    scene = {"gate": {"mode": "settled"}}
    return replace(
        HEADER, fingers=fingers, joints=joints, scene=scene, wall_minus_monotonic_ns=OFFSET_NS
    )


def write(path: Path, first: int = 0) -> None:
    """Write `READINGS` readings of two fingers, numbered from `first`, 2 ms old when they are
    recorded; flush after every fifth."""
    file = McapWriter(path, header("ff", "th", joints=True))
    for number in range(first, first + READINGS):
        t_ns = START_NS + number * PERIOD_NS
        angles = JointReading(t_ns - 1000, number, ("FFJ3",), np.array([number / 100]))
        tactile = Tactile(
            boot_id=BOOT,
            seq=number,
            t=0.0,
            t_mono_ns=t_ns,
            fingers=["ff", "th"],
            counts=counts_of(number),
            faults=[[0] * 24] * 2,
        )
        joints = Joints.of(angles)
        fields = {name: getattr(joints, name) for name in joints.__struct_fields__}
        file.write(b"joints.right", json.dumps(fields).encode(), t_ns + 1_999_999)
        content = flat(to_builtins(tactile))
        file.write(b"tactile.right", json.dumps(content).encode(), t_ns + 2_000_000)
        if number % 5 == 4:
            file.flush()
    file.close()


def whole() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        write(path)
        return path.read_bytes()


WHOLE = whole()
STATES = st.fixed_dictionaries(
    {
        "trust": st.binary(max_size=40),
        "grasps": st.integers(0, 1 << 62),
        "file": st.integers(0, 99),
        "session": st.none()
        | st.just(SessionState(weight=2.5, grasps=3, mean=(0.1, 1e-9), squares=(4.0, 0.0))),
    }
)


def read(data: bytes) -> list[RecordedMessage]:
    return list(McapReader(Path("a.mcap"), io.BytesIO(data)))


@given(STATES, st.sets(st.sampled_from(FINGERS), min_size=1))
def test_a_header_comes_back_as_it_was_written(state: dict[str, Any], fingers: set[str]) -> None:
    written = replace(header(*fingers, joints=True), **state)
    assert RecordingHeader.of(written.texts()) == written


@pytest.mark.parametrize(
    ("name", "text"),
    [
        *[(name, None) for name in REQUIRED],
        *[("fingers", "[]"), ("fingers", '["toe"]'), ("fingers", "5"), ("scene", "[]")],
        *[("session", "{}"), ("trust", "A"), ("grasps", ""), ("file", "first")],
        pytest.param("scene", "[" * 100_000, id="nested deeply"),
    ],
)
def test_a_file_with_an_invalid_header_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, text: str | None
) -> None:
    texts = header("ff", joints=False).texts() | ({} if text is None else {name: text})
    if text is None:
        del texts[name]
    monkeypatch.setattr(RecordingHeader, "texts", lambda _: texts)
    McapWriter(tmp_path / "a.mcap", header("ff", joints=False)).close()
    with pytest.raises(RecordingError, match=r"a\.mcap: is an MCAP file of another graspd"):
        header_of(tmp_path / "a.mcap")


def test_readings_are_replayed_in_order_with_their_recorded_age(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap")
    write(tmp_path / "b.mcap", first=READINGS)
    found: list[TactileReading] = []
    turned: list[JointReading] = []
    paths = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    with McapReplayDriver(paths, ("th", "ff"), clock=lambda: NOW_NS) as driver:
        while not driver.exhausted:
            for reading in driver.read_ready():
                if isinstance(reading, TactileReading):
                    found.append(reading)
                else:
                    turned.append(reading)
    assert [reading.seq for reading in found] == list(range(2 * READINGS))
    assert {reading.t_ns for reading in found} == {NOW_NS - 2_000_000}
    assert [reading.made_ns - START_NS for reading in found] == [
        number * PERIOD_NS for number in range(2 * READINGS)
    ]
    assert found[7].counts.tolist() == counts_of(7)[::-1]  # the thumb first, as was asked for
    assert [reading.position_rad.tolist() for reading in turned][:2] == [[0.0], [0.01]]
    assert driver.period_ns == PERIOD_NS
    assert driver.counters.malformed == driver.counters.cut_off == 0


def test_a_finger_that_was_not_recorded_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap")
    with pytest.raises(RecordingError, match="no finger mf"):
        McapReplayDriver([tmp_path / "a.mcap"], ("mf",)).open()


@pytest.mark.parametrize(
    ("size", "why"),
    [(8, "is empty"), (12, "is damaged or cut off"), (17, "is damaged or cut off")],
)
def test_a_file_without_a_whole_record_is_named_so(size: int, why: str) -> None:
    with pytest.raises(RecordingError, match=why):
        read(WHOLE[:size])


@given(st.integers(0, len(WHOLE) - 1))
@settings(max_examples=200, deadline=None)
def test_a_truncated_file_gives_what_was_flushed_before(at: int) -> None:
    try:
        found = read(WHOLE[:at])
    except RecordingError:
        found = []
    assert found == read(WHOLE)[: len(found)]
    assert len(found) % 10 == 0  # five readings and their joints, by flush


@given(st.lists(st.tuples(st.integers(0, len(WHOLE) - 1), st.integers(0, 255)), max_size=5))
@settings(max_examples=300, deadline=None)
def test_damage_raises_recording_error_or_nothing(changes: list[tuple[int, int]]) -> None:
    data = bytearray(WHOLE)
    for at, value in changes:
        data[at] = value
    with contextlib.suppress(RecordingError):
        read(bytes(data))


def test_a_message_with_a_time_beyond_the_limit_is_refused(tmp_path: Path) -> None:
    file = McapWriter(tmp_path / "a.mcap", header("ff", joints=False))
    payload = {
        **{"v": 1, "boot_id": BOOT, "seq": 1, "t": 0.0, "t_mono_ns": 5},
        **{"fingers": ["ff"], "counts": [1] * 24, "faults": [0] * 24},
    }
    file.write(b"tactile.right", json.dumps(payload).encode(), 17 * 10**18)
    file.close()
    with (
        McapReplayDriver([tmp_path / "a.mcap"], ("ff",)) as driver,
        pytest.raises(RecordingError, match=r"a.mcap: the time 17000000000 s is later"),
    ):
        driver.read_ready()


def test_malformed_readings_are_counted_and_left_out(tmp_path: Path) -> None:
    file = McapWriter(tmp_path / "a.mcap", header("ff", joints=False))
    wrong = [
        b"",
        b"{}",
        b"\xff",
        b'{"counts":' + b"[" * 100_000,
        json.dumps(READING | {"counts": [1] * 23}).encode(),
        json.dumps(READING | {"counts": [-1] * 24}).encode(),
        json.dumps(READING | {"counts": [70_000] * 24}).encode(),
        json.dumps(READING | {"fingers": ["mf"]}).encode(),
        json.dumps(READING | {"faults": []}).encode(),
    ]
    for payload in wrong:
        file.write(b"tactile.right", payload, 10)
    file.write(b"joints.right", b'{"seq":1,"t_mono_ns":1,"names":["FFJ3"],"position_rad":[]}', 10)
    file.write(b"strange.right", b"{}", 10)
    file.write(b"tactile.right", json.dumps(READING).encode(), 10)
    file.close()
    with McapReplayDriver([tmp_path / "a.mcap"], ("ff",)) as driver:
        assert len(driver.read_ready()) == 1
        assert driver.exhausted
    assert driver.counters.malformed == len(wrong) + 1


MESSAGES = struct.pack("<BQHIQQ", 5, 24, 1, 0, 0, 0) + b"{}"
"""Record of one message with the payload `{}`."""


def with_chunk(compression: str, content: bytes, said_bytes: int, times: int = 1) -> bytes:
    """Return a file with a header and `times` equal chunks. `content`: compressed already.

    `said_bytes`: unpacked size that the chunks state.
    """
    builder = RecordBuilder()
    Channel(1, "strange.right", "json", {}, 0).write(builder)
    for _ in range(times):
        Chunk(compression, content, 0, 0, 0, said_bytes).write(builder)
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start(profile="", library="graspd")
    writer.add_metadata(METADATA, header("ff", "th", joints=False).texts())
    writer.flush()
    chunks: bytes = builder.end()
    return stream.getvalue() + chunks


def zstd(content: bytes, *, sized: bool = True) -> bytes:
    packed: bytes = zstandard.ZstdCompressor(level=19, write_content_size=sized).compress(content)
    return packed


@pytest.mark.parametrize("compression", ["", "zstd", "lz4"])
def test_chunks_of_each_compression_are_read(compression: str) -> None:
    content = MESSAGES * 1000
    pack = {"": bytes, "zstd": zstd, "lz4": lz4.frame.compress}[compression]
    found = read(with_chunk(compression, pack(content), len(content)))
    assert [message.payload for message in found] == [b"{}"] * 1000


BOMB = MESSAGES * (CHUNK_MAX_BYTES // len(MESSAGES) + 1)


@pytest.mark.parametrize("said_bytes", [len(BOMB), 1000, 1 << 60])
@pytest.mark.parametrize(
    ("compression", "content"),
    [
        ("zstd", zstd(BOMB)),
        ("zstd", zstd(BOMB, sized=False)),
        ("zstd", zstd(BOMB * 20)),
        ("lz4", lz4.frame.compress(BOMB)),
        ("lz4", lz4.frame.compress(BOMB, store_size=False)),
        ("", BOMB),
    ],
)
def test_a_chunk_that_unpacks_to_over_the_limit_is_refused(
    compression: str, content: bytes, said_bytes: int
) -> None:
    with pytest.raises(RecordingError, match=r"a\.mcap: unpacks to more than any recording"):
        read(with_chunk(compression, content, said_bytes))


def test_many_chunks_that_together_exceed_the_limit_are_refused(tmp_path: Path) -> None:
    content = MESSAGES * 30_000
    path = tmp_path / "a.mcap"
    path.write_bytes(with_chunk("zstd", zstd(content), len(content), times=100))
    assert path.stat().st_size < 40_000
    with path.open("rb") as stream:
        found: list[RecordedMessage] = []
        with pytest.raises(RecordingError, match="unpacks to more than any recording"):
            found.extend(McapReader(path, stream))
    assert 0 < len(found) <= (CHUNK_MAX_BYTES + RATIO_MAX * 40_000) // len(MESSAGES)


@pytest.mark.parametrize(
    ("compression", "content"),
    [("zstd", zstd(b"a" * 99)), ("zstd", b"abc"), ("lz4", b"abcdefgh" * 9), ("brotli", b"a")],
)
def test_a_chunk_of_wrong_size_or_compression_counts_as_damage(
    compression: str, content: bytes
) -> None:
    reader = McapReader(Path("a.mcap"), io.BytesIO(with_chunk(compression, content, 100)))
    assert list(reader) == []
    assert reader.cut_off
