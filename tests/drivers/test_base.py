"""What all drivers have in common: counters, fingers, readings."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from graspd.drivers.base import (
    ELECTRODES,
    FINGERS,
    Driver,
    DriverCounters,
    ElectrodeFault,
    Fact,
    LinkCause,
    TactileReading,
    sensor_rows,
)
from graspd.drivers.can.driver import CanBridgeDriver
from graspd.drivers.can.readings import CanCounters
from graspd.drivers.joints import JointCounters, JointStreamDriver
from graspd.drivers.palm.driver import PalmDriver
from graspd.drivers.palm.packet import PalmCounters
from graspd.drivers.recordings.faults import ReplayCounters
from graspd.drivers.spi.driver import SpiBridgeDriver
from graspd.drivers.spi.messages import FrameCounters
from graspd.drivers.spi.sweeps import BridgeCounters
from graspd.drivers.udp import DatagramCounters

COUNTERS = (
    *(DriverCounters, DatagramCounters, JointCounters, PalmCounters),
    *(CanCounters, BridgeCounters, ReplayCounters, FrameCounters),
)


@pytest.mark.parametrize("counters", COUNTERS, ids=lambda kind: kind.__name__)
def test_every_counter_begins_at_zero(counters: type[DriverCounters]) -> None:
    made = asdict(counters())
    assert made == dict.fromkeys(made, 0)


@pytest.mark.parametrize(
    ("fingers", "sensors", "rows"),
    [
        (("ff", "mf", "th"), None, (0, 1, 2)),
        (("th", "ff"), ("ff", "mf", "th"), (2, 0)),
        (("lf",), FINGERS, (3,)),
    ],
)
def test_a_row_is_where_the_device_has_the_finger(
    fingers: tuple[str, ...], sensors: tuple[str, ...] | None, rows: tuple[int, ...]
) -> None:
    assert sensor_rows(fingers, sensors) == rows


@pytest.mark.parametrize(
    ("counts", "faults"),
    [((3, 23), (3, 23)), ((3, 25), (3, 25)), ((24,), (24,)), ((3, 24), (2, 24))],
)
def test_a_reading_has_24_electrodes_a_finger(
    counts: tuple[int, ...], faults: tuple[int, ...]
) -> None:
    assert ELECTRODES == 24
    with pytest.raises(ValueError, match="counts"):
        TactileReading(0, 0, np.zeros(counts, np.uint16), np.zeros(faults, np.uint8))


def test_faults_keep_the_bits_that_recordings_hold() -> None:
    assert {fault.name: int(fault) for fault in ElectrodeFault} == {
        **{"MISSING": 1, "NOT_A_COUNT": 2, "PARITY": 4},
        **{"ERROR_WORD": 8, "HELD": 16, "CUT_OFF": 32},
    }


def test_a_recorded_reading_was_made_when_it_was_recorded_a_live_one_when_it_came() -> None:
    arrays = np.zeros((1, 24), np.uint16), np.zeros((1, 24), np.uint8)
    assert TactileReading(5, 0, *arrays).made_ns == 5
    assert TactileReading(5, 0, *arrays, recorded_ns=0).made_ns == 0


@pytest.mark.parametrize(
    ("driver", "name", "period_ns", "silence_ns"),
    [
        (SpiBridgeDriver("/dev/serial/by-id/none", FINGERS), "spi", None, None),
        (CanBridgeDriver("virtual", "test-closed"), "can", None, None),
        (PalmDriver("udp://127.0.0.1:0"), "palm", 14_000_000, 140_000_000),
        (JointStreamDriver("udp://127.0.0.1:0"), "joints", None, 500_000_000),
    ],
    ids=["spi", "can", "palm", "joints"],
)
def test_a_link_that_is_closed_says_so_and_reads_nothing(
    driver: Driver, name: str, period_ns: int | None, silence_ns: int | None
) -> None:
    assert (driver.name, driver.period_ns, driver.live) == (name, period_ns, True)
    assert getattr(driver, "silence_ns", None) == silence_ns
    assert driver.fileno() is driver.due_ns() is None
    assert not driver.exhausted
    assert driver.describe()["link"] == Fact("closed", LinkCause.UNKNOWN)
    assert driver.serials == {}
    with pytest.raises(RuntimeError, match="not open"):
        driver.read_ready()
    driver.close()
    driver.close()
