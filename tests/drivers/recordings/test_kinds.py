"""Kinds of files, by their content; packed and piped files are read as plain ones are."""

from __future__ import annotations

import gzip
import io
import os
import pickle
import sqlite3
import struct
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from graspd.drivers.base import RecordingError
from graspd.drivers.recordings import kinds
from graspd.drivers.recordings.kinds import (
    Kind,
    files_of,
    kind_of,
    kind_of_all,
    open_recording,
)
from graspd.drivers.recordings.serial_log import encode_records
from graspd.drivers.spi.conversation import LineEvent
from tests.drivers.recordings.tables import table, write

HEADER = struct.Struct("<BQI")


def mcap(profile: bytes) -> bytes:
    """Magic and header record of an MCAP file (its specification, "Header")."""
    library = struct.pack("<I", 1) + b"x"
    length = 4 + len(profile) + len(library)
    return b"\x89MCAP0\r\n" + HEADER.pack(1, length, len(profile)) + profile + library


def bag2(tables: str) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        database = sqlite3.connect(path)
        database.executescript(tables)
        database.close()

    return make


def parquet(path: Path) -> None:
    frame = pytest.importorskip("pandas").DataFrame({"ff_biotac_1": [1]})
    frame.to_parquet(path)


TOPICS = "create table topics (id integer); create table messages (id integer);"
FILES: dict[str, tuple[bytes | Callable[[Path], None], Kind]] = {
    "table": (table(2), Kind.TEXT),
    "with a byte order mark": (b"\xef\xbb\xbf" + table(2), Kind.TEXT),
    "UTF-16": (table(2).decode().encode("utf-16"), Kind.TEXT),
    "Latin-1": (table(2).replace(b"thing", b"K\xe4se"), Kind.TEXT),
    "a line of blanks": (b" " * 65_535 + b"\n", Kind.TEXT),
    "a table that ends in zeros": (table(2) + bytes(900), Kind.TEXT),
    "Parquet": (parquet, Kind.PARQUET),
    "MCAP of graspd": (mcap(b""), Kind.MCAP),
    "MCAP of ROS 2": (mcap(b"ros2"), Kind.ROS2_BAG),
    "ROS 1 bag": (b"#ROSBAG V2.0\n\x45\0\0\0", Kind.ROS1_BAG),
    "SQLite bag": (bag2(TOPICS), Kind.ROS2_BAG),
    "candump -L": (b"(1436509052.249713) can0 5A1#A2BF98\n", Kind.CANDUMP),
    "candump -ta": (b" (1436509052.249713)  can0  5A1   [7]  A2 BF 98\n", Kind.CANDUMP),
    "candump -tA": (b" (2023-11-14 22:13:20.000000)  can0  5A1   [1]  A2\n", Kind.CANDUMP),
    "candump alone": (b"  can0  5A1   [2]  A2 BF\n", Kind.CANDUMP),
    "candump after noise": (b"\n? ##\n(1.5) can0 5A1#\n", Kind.CANDUMP),
    "ASC": (b"date Thu Nov 26 2026\nbase hex  timestamps absolute\n", Kind.ASC),
    "ASC without its header": (b"   0.000200 1  5A1   Rx   d 7 A4 CB 70 DA 61 C7 A1\n", Kind.ASC),
    "BLF": (b"LOGG\x90\0\0\0", Kind.BLF),
    "TRC": (b";$FILEVERSION=2.1\n", Kind.TRC),
    **{
        f"serial, {event.name}": (b"noise\0" + encode_records(event, 5, b"\1\2"), Kind.SERIAL)
        for event in LineEvent
    },
}


def made(path: Path, content: bytes | Callable[[Path], None]) -> Path:
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        content(path)
    return path


@pytest.mark.parametrize(("content", "kind"), FILES.values(), ids=FILES)
def test_the_kind_of_a_file_depends_on_its_content_alone(
    tmp_path: Path, content: bytes | Callable[[Path], None], kind: Kind
) -> None:
    assert kind_of(made(tmp_path / "RUN.XYZ", content)) is kind


def test_a_packed_file_has_the_kind_of_its_content(tmp_path: Path) -> None:
    assert kind_of(write(tmp_path, gzip.compress(b"LOGG\x90\0\0\0"))) is Kind.BLF
    (tmp_path / "metadata.yaml").touch()
    assert kind_of(tmp_path) is Kind.ROS2_BAG


OTHERS: dict[str, tuple[bytes | Callable[[Path], None], str]] = {
    "xlsx": (b"PK\x03\x04", "a zip archive or an Excel workbook: unpack it, or save"),
    "pickle": (pickle.dumps([1, 2]), "a Python pickle"),
    "other SQLite": (bag2("create table x (y integer);"), "an SQLite database without"),
    "can_logger": (b"Timestamp:     1.500000    ID: 5A1\n", "take `can_logger -f log.asc`"),
    "JSON": (b'{"t": 0}\n', "JSON: write the table as CSV"),
    "NumPy array": (b"\x93NUMPY\1\0", 'graspd.load("small-session").predict(array) takes it'),
    "rostopic echo": (b"header:\n  seq: 1\n", "what `rostopic echo` shows"),
    "rostopic echo in UTF-16": ("header:\r\n".encode("utf-16"), "what `rostopic echo` shows"),
    "XML in UTF-16 without mark": ("<a>1</a>\n".encode("utf-16-le"), "of HTML or XML"),
    "packed twice": (gzip.compress(gzip.compress(b"1")), "packed twice: unpack it first"),
    "binary": (bytes(range(256)), "is of a kind that is not known"),
    "zeros": (bytes(256), "is of a kind that is not known"),
}


@pytest.mark.parametrize(("content", "said"), OTHERS.values(), ids=OTHERS)
def test_other_kinds_are_refused_with_a_reason_and_documentation_page(
    tmp_path: Path, content: bytes | Callable[[Path], None], said: str
) -> None:
    path = made(tmp_path / "grasps.csv", content)
    with pytest.raises(RecordingError) as caught:
        kind_of(path)
    assert said in str(caught.value)
    assert str(caught.value).endswith("; deploy/RECORDING.md lists what graspd reads")


def test_a_folder_without_metadata_names_the_missing_file(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"a directory without the file metadata\.yaml"):
        kind_of(tmp_path)


def test_a_long_name_and_an_empty_file_are_errors(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="file name too long"):
        kind_of(Path("a" * 300))
    with pytest.raises(RecordingError, match=r"grasps\.csv: the file is empty"):
        kind_of(write(tmp_path, b""))


def test_files_of_two_kinds_are_not_one_recording(tmp_path: Path) -> None:
    paths = [write(tmp_path, table(1), "a"), write(tmp_path, mcap(b""), "b")]
    assert kind_of_all(paths[:1] * 2) is Kind.TEXT
    with pytest.raises(RecordingError, match=r"b: is a recording of graspd .* not one recording"):
        kind_of_all(paths)


def lines(path: Path) -> bytes:
    with open_recording(path) as file:
        return file.read()


@pytest.mark.parametrize("damage", [lambda data: data[:-20], lambda data: data[:99] + b"?" * 99])
def test_a_damaged_packed_file_is_an_error(
    tmp_path: Path, damage: Callable[[bytes], bytes]
) -> None:
    path = write(tmp_path, damage(gzip.compress(table(50))))
    with pytest.raises(RecordingError, match=r"grasps\.csv: "):
        kind_of(path)


def test_a_packed_file_that_grows_too_much_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kinds, "COPIED_BYTES_MAX", 100_000)
    path = write(tmp_path, gzip.compress(b"1,2\n" * 50_000))
    with pytest.raises(OSError, match="it unpacks to more than 100000 bytes"):
        lines(path)


def test_standard_input_is_read_as_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.TextIOWrapper(io.BytesIO(gzip.compress(table(3))))
    monkeypatch.setattr(sys, "stdin", stream)
    plain = write(tmp_path, table(3))
    with files_of([Path("-"), plain]) as (copy, same):
        assert lines(copy) == table(3)
        assert lines(copy) == table(3), "again"
        assert copy.name == "standard input"
        assert same == plain
    assert not copy.exists()
    with files_of([copy]) as paths:  # its reader says that it is not there
        assert paths == [copy]


def test_a_pipe_is_copied_up_to_a_size_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipe = tmp_path / "pipe"

    def played(content: bytes) -> Path:
        pipe.unlink(missing_ok=True)
        os.mkfifo(pipe)
        threading.Thread(target=pipe.write_bytes, args=(content,)).start()
        return pipe

    with files_of([played(table(2))]) as (copy,):
        assert lines(copy) == lines(copy) == table(2)
    monkeypatch.setattr(kinds, "COPIED_BYTES_MAX", 100)
    with (
        pytest.raises(RecordingError, match="brings more than 100 bytes"),
        files_of([played(table(2))]),
    ):
        pass
