"""The traffic of a link is in a log beside the recording, in a format that readers know.

`tests/test_process_replay.py` checks that readers of such logs give the link's own readings.
"""

from __future__ import annotations

import time
from pathlib import Path

import can
from pydantic import TypeAdapter

from graspd.daemon.record.link_log import Tap, tap_of
from graspd.daemon.scene.drivers import Tactile
from graspd.drivers.base import Driver
from graspd.drivers.can.driver import CanBridgeDriver
from graspd.drivers.recordings.serial_log import parse_records
from graspd.drivers.spi.conversation import LineEvent
from graspd.drivers.spi.driver import SpiBridgeDriver
from graspd.drivers.spi.messages import DELIMITER, FrameParser, Ping, Stop, encode
from tests.daemon.record.recorded import recorder
from tests.kit.clock import Clock

FINGERS = ("ff", "mf", "th")
SENT = [can.Message(arbitration_id=0x100, data=bytes([number] * 8)) for number in range(50)]


def tapped(link: Driver, **section: str) -> Tap:
    """Open a driver, and return a tap on it. `section`: the scene's section `tactile`."""
    tap = tap_of(link, TypeAdapter(Tactile).validate_python(section))
    assert tap is not None
    link.open()
    return tap


def log_of(folder: Path, ending: str) -> Path:
    (path,) = (folder / "record").glob(f"*{ending}")
    return path


def test_a_serial_log_has_both_directions_from_before_the_recording(tmp_path: Path) -> None:
    clock = Clock()
    driver = SpiBridgeDriver("loop://", FINGERS, clock=clock)
    tap = tapped(driver, driver="spi", port="loop://")
    said = [(LineEvent.SENT, DELIMITER + encode(Stop())), (LineEvent.SENT, encode(Ping(1)))]
    before_ns = time.monotonic_ns()
    writing = recorder(tmp_path, tap=tap, raw=True)
    driver.read_ready()
    driver.close()
    writing.close()
    content = log_of(tmp_path, ".serial").read_bytes()
    times, records = zip(*parse_records(FrameParser(), content), strict=True)
    opened, *sent, received, stop = records
    assert opened == (LineEvent.OPENED, b"")
    assert [event for event, _ in sent] == [event for event, _ in said]
    assert sent[0] == said[0]
    assert received == (LineEvent.RECEIVED, b"".join(data for _, data in sent))
    assert stop == (LineEvent.SENT, encode(Stop()))
    assert list(times) == sorted(times)
    assert times[2] <= before_ns <= times[3] <= time.monotonic_ns()


def test_python_can_reads_back_the_can_log(tmp_path: Path) -> None:
    driver = CanBridgeDriver("virtual", "of a log", FINGERS)
    tap = tapped(driver, driver="can", interface="virtual", channel="of a log")
    writing = recorder(tmp_path, tap=tap, raw=True)
    with can.Bus(interface="virtual", channel="of a log") as board:
        before_s = time.time()
        for message in SENT:
            board.send(message)
        driver.read_ready()
    driver.close()
    writing.close()
    with can.CanutilsLogReader(log_of(tmp_path, ".can.log")) as reader:
        frames = list(reader)
    assert [bytes(frame.data) for frame in frames] == [bytes(message.data) for message in SENT]
    assert {frame.arbitration_id for frame in frames} == {0x100}
    assert {frame.channel for frame in frames} == {"of_a_log"}
    stamps = [frame.timestamp for frame in frames]
    assert stamps == sorted(stamps)
    assert before_s - 0.1 <= stamps[0] <= stamps[-1] <= time.time() + 0.1
