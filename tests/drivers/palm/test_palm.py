"""The palm driver over real UDP and from files: link, senders, joints, time, what it imports."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from graspd.drivers.palm.calibration import CalibrationError
from graspd.drivers.palm.packet import Palm
from graspd.drivers.palm.stream import PalmDriver
from tests.conftest import ROOT
from tests.drivers.one_sweep import sweeps_of, tactile
from tests.drivers.palm.palm_stream import (
    MS,
    ROUND,
    datagrams,
    joints,
)
from tests.drivers.udp_standin import Receiver
from tests.kit.clock import Clock

LOOPBACK = "udp://127.0.0.1:0"
EXAMPLE = ROOT / "deploy" / "calibration" / "example_hand.toml"


@pytest.fixture
def driver(receiver: Receiver, clock: Clock) -> Iterator[PalmDriver]:
    with PalmDriver(LOOPBACK, clock=clock) as driver:
        yield driver


def test_another_kind_of_palm_is_not_mixed_in(driver: PalmDriver, receiver: Receiver) -> None:
    for one, two in zip(datagrams(2), datagrams(2, Palm.PALM_0230), strict=True):
        receiver.send(one, two)
    readings = tactile(driver.read_ready())
    assert np.array_equal([reading.counts for reading in readings], sweeps_of(2))
    assert driver.stream.counters.other_palms == 2 * ROUND


def test_a_round_wakes_the_loop_once(driver: PalmDriver, receiver: Receiver, clock: Clock) -> None:
    assert driver.fileno() is not None
    receiver.send(datagrams(1)[0])
    driver.read_ready()
    assert driver.fileno() is None  # 13 packets to go
    assert driver.due_ns() == clock.now_ns + 11 * MS
    clock.now_ns += 11 * MS
    assert driver.fileno() is not None


def test_joints_come_calibrated_at_their_own_rate(receiver: Receiver, clock: Clock) -> None:
    readings = []
    with PalmDriver(LOOPBACK, calibration=EXAMPLE, clock=clock) as driver:
        for data in datagrams(72)[:1000]:
            receiver.send(data)
            readings += joints(driver.read_ready())
            clock.now_ns += MS
    counters = driver.stream.counters
    assert len(readings) == counters.joint_readings == pytest.approx(100, abs=1)
    assert counters.bad_angles == 0
    assert counters.impossible_angles == 2 * len(readings)  # another hand's raw values
    assert [reading.seq for reading in readings] == list(range(len(readings)))
    angles = dict(zip(readings[0].names, readings[0].position_rad, strict=True))
    # Raw 1303 of the snapshot, by hand from the table of hand 378, noise of one count.
    expected_deg = 45 + 22.5 * (1942 - 1303) / (1942 - 1247)
    assert np.degrees(angles["FFJ1"]) == pytest.approx(expected_deg, abs=0.05)
    assert np.isnan(angles["MFJ1"])


def test_a_wrong_calibration_keeps_the_driver_from_opening(tmp_path: Path) -> None:
    path = tmp_path / "hand.toml"
    path.write_text("version = 1\n[joints]\nLFJ1 = [[22361, 0.0], [649, 90.0]]\n")
    driver = PalmDriver(LOOPBACK, calibration=path)
    with pytest.raises(CalibrationError, match=r"hand\.toml: LFJ1: raw 22361"):
        driver.open()
    assert driver.fileno() is None
