"""The order of the board's words need not be the order of the hand's fingers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.drivers.can.driver import CanBridgeDriver
from graspd.drivers.can.formats import encode_sample
from tests.drivers.can.can_standin import ScriptedBus, bridge, channel, message, stand_in
from tests.drivers.can.can_words import SLOT_NS, samples, truth
from tests.drivers.one_sweep import tactile
from tests.kit.clock import Clock

ORDER = ("th", "ff", "mf")
"""The board's sensors: its first word is the thumb's."""


def readings(
    monkeypatch: pytest.MonkeyPatch, fingers: Sequence[str], spoilt: dict[int, bytes] | None = None
) -> tuple[list[TactileReading], CanBridgeDriver]:
    """What the driver makes of two sweeps of three sensors, and the driver.

    `spoilt`: words, six bytes, in place of those of a channel of the first sweep.
    """
    clock = Clock()
    bus = ScriptedBus()
    stand_in(monkeypatch, lambda: bus)
    driver = bridge(channel(), sensors=ORDER, fingers=fingers, clock=clock, wall_clock=clock)
    taken: list[TactileReading] = []
    with driver:
        for sweep in (0, 1):
            for number, words, _ in samples(sweep):
                given = (spoilt or {}).get(number) if sweep == 0 else None
                bus.script.append(message(encode_sample(number, given or words)))
                clock.now_ns += SLOT_NS
                taken += tactile(driver.read_ready())
    return taken, driver


@pytest.mark.parametrize("fingers", [("ff", "mf", "th"), ("th", "ff", "mf"), ("mf", "th"), ("ff",)])
def test_rows_are_fingers_and_words_are_sensors(
    monkeypatch: pytest.MonkeyPatch, fingers: Sequence[str]
) -> None:
    taken, driver = readings(monkeypatch, fingers)
    assert len(taken) == 2
    for sweep, reading in enumerate(taken):
        assert not reading.faults.any()
        assert reading.counts.shape == (len(fingers), 24)
        for row, finger in enumerate(fingers):
            assert (reading.counts[row] == truth(sweep)[ORDER.index(finger)]).all()
    assert driver.counters.wrong_length_frames == driver.counters.lost_frames == 0


def test_a_damaged_word_is_flagged_at_its_finger_only(monkeypatch: pytest.MonkeyPatch) -> None:
    number, words, _ = samples(0)[4]
    damaged = bytes([words[0] ^ 1]) + words[1:]
    taken, driver = readings(monkeypatch, ("ff", "mf", "th"), {number: damaged})
    assert np.argwhere(taken[0].faults).tolist() == [[2, 4]]
    assert taken[0].faults[2, 4] == ElectrodeFault.PARITY
    assert driver.counters.parity_words == 1


def test_a_damaged_word_of_a_finger_that_is_not_wanted_means_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    number, words, _ = samples(0)[4]
    damaged = bytes([words[0] ^ 1]) + words[1:]
    taken, driver = readings(monkeypatch, ("ff", "mf"), {number: damaged})
    assert not taken[0].faults.any()
    assert driver.counters.parity_words == driver.counters.faulty_readings == 0


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"sensors": ("ff", "mf")}, "fingers .* are not all of"),
        ({"sensors": ("ff", "mf", "th", "rf")}, "1 to 3 sensors, not 4"),
        ({"sensors": ORDER, "format": "sweep_fd"}, "sensors is for the format syntouch"),
    ],
)
def test_sensors_that_cannot_be_are_refused(options: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        CanBridgeDriver("virtual", channel(), **options)
