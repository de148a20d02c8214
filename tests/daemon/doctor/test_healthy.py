"""On a healthy twin the doctor has nothing to say, for an hour of the hand's time."""

from __future__ import annotations

from pathlib import Path

import pytest

from graspd.daemon.doctor.electrodes import ElectrodeStatistics
from graspd.drivers.twins.faults import LinkFaults
from tests.daemon.doctor.emulated import FINGERS, LINKS, STEPS_PER_S, Hand, faults_told, listen

HOUR_S, EVERY_S, LOOK_S = 3600, 20, 3
HAND_HZ = 10.0
"""Moments of the hand in a second of its own: the link plays them faster, a look in less time."""
SWEEPS = int(LOOK_S * HAND_HZ)


@pytest.mark.parametrize("kind", LINKS)
def test_nothing_is_wrong_with_a_healthy_twin_for_an_hour(kind: str, tmp_path: Path) -> None:
    hand, sweep_hz = Hand(HAND_HZ), 1000 / 14 if kind == "palm" else 100.0
    look_s = SWEEPS / sweep_hz
    with LINKS[kind](hand, tmp_path, LinkFaults()) as (driver, step):
        listen(driver, step, STEPS_PER_S[kind], ElectrodeStatistics(FINGERS))
        for look in range(HOUR_S // EVERY_S):
            statistics = ElectrodeStatistics(FINGERS)
            listen(driver, step, round(look_s * STEPS_PER_S[kind]), statistics)
            told = faults_told(driver, statistics, look_s)
            assert told == [], f"after {look * EVERY_S} s"
            if kind != "joints":
                assert statistics.readings >= SWEEPS - 1
                hand.skip(int(EVERY_S * HAND_HZ) - statistics.readings)
