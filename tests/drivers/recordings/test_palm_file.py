"""Files of palm packets as recordings: every count, one packet per millisecond, what is none."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from graspd.drivers.base import RecordingError
from graspd.drivers.palm.packet import Palm
from graspd.drivers.recordings.palm_file import PalmFile
from graspd.drivers.twins.palm import PalmTwin
from tests.drivers.one_sweep import tactile
from tests.drivers.palm.palm_stream import MS, datagrams, rows
from tests.kit.clock import Clock


@pytest.mark.parametrize(("palm", "appended"), [(Palm.PALM_0220, bytes(12)), (Palm.PALM_0250, b"")])
def test_a_file_of_packets_plays_count_for_count(
    tmp_path: Path, palm: Palm, appended: bytes
) -> None:
    twin = PalmTwin(rows(40), palm=palm)
    path = tmp_path / "hand.palm"
    path.write_bytes(b"".join(packet.to_bytes() + appended for packet in twin.packets()) + bytes(5))
    readings = []
    clock = Clock()
    with PalmFile(path, clock=clock) as driver:
        while not driver.exhausted:
            clock.now_ns = driver.due_ns() or clock.now_ns
            readings += tactile(driver.read_ready())
        assert driver.stream.counters.bad_lengths == 1  # the file ends in the middle of a packet
        assert driver.due_ns() is None
    assert np.array_equal([reading.counts for reading in readings], rows(40))


@pytest.mark.parametrize(
    ("good", "nonsense", "plays"),
    # One packet and 20 bytes may be a packet with a CAN record (12 bytes) and 8 bytes.
    [(14, 14 * 220, True), (13, 15 * 220, False), (1, 12, True), (1, 20, False)],
)
def test_half_of_the_packets_of_a_file_make_sense_and_with_one_length(
    tmp_path: Path, good: int, nonsense: int, plays: bool
) -> None:
    path = tmp_path / "hand.palm"
    path.write_bytes(b"".join(datagrams(1)[:good]) + bytes(nonsense))
    driver = PalmFile(path)
    if plays:
        driver.open()
        driver.close()
    else:
        with pytest.raises(RecordingError, match="not a file of palm packets"):
            driver.open()


def test_a_file_plays_one_packet_per_millisecond(tmp_path: Path) -> None:
    clock = Clock()
    path = tmp_path / "hand.palm"
    path.write_bytes(b"".join(datagrams(10)))
    times = []
    with PalmFile(path, clock=clock) as driver:
        start_ns = clock.now_ns
        while (due_ns := driver.due_ns()) is not None:
            clock.now_ns = due_ns
            times += [reading.t_ns - start_ns for reading in driver.read_ready()]
    assert times == [(14 * number + 13) * MS for number in range(10)]


def test_a_pipe_is_refused_instead_of_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "hand.palm"
    os.mkfifo(path)
    with pytest.raises(RecordingError, match="is not a regular file"):
        PalmFile(path).open()


@pytest.mark.parametrize("content", [None, b"", b"no packets at all" * 500, bytes(22000)])
def test_a_file_without_packets_is_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "hand.palm"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"hand\.palm"):
        PalmFile(path).open()
    with pytest.raises(RecordingError, match="is a directory"):
        PalmFile(tmp_path).open()
