"""On a healthy twin the doctor has nothing to say, for an hour of the hand's time."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon.doctor.electrodes import ElectrodeStatistics
from drivers.twins.faults import LinkFaults
from tests.daemon.doctor.emulated import FINGERS, LINKS, STEPS_PER_S, Hand, faults_told, listen

HOUR_S, EVERY_S, LOOK_S = 3600, 60, 3
HAND_HZ = 10.0
"""Moments of the hand in a second of its own: the link plays them faster."""


@pytest.mark.parametrize("kind", LINKS)
def test_nothing_is_wrong_with_a_healthy_twin_for_an_hour(kind: str, tmp_path: Path) -> None:
    hand = Hand(HAND_HZ)
    looks, steps = HOUR_S // EVERY_S, LOOK_S * STEPS_PER_S[kind]
    with LINKS[kind](hand, tmp_path, LinkFaults()) as (driver, step):
        for look in range(looks):
            statistics = ElectrodeStatistics(FINGERS)
            listen(driver, step, steps, statistics)
            told = faults_told(driver, statistics, float(LOOK_S))
            assert told == [], f"look {look} of {looks}"
            if kind != "joints":
                assert statistics.readings > 60
                hand.skip(int(EVERY_S * HAND_HZ) - statistics.readings)
