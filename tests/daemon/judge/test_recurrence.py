"""Old sweeps that come again: never `stable`, and not found by chance."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.daemon.judge.decision import HandLimits, Limits
from graspd.daemon.judge.health import Health
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.judge.reasons import Decision, Reason
from graspd.drivers.base import ElectrodeFault
from graspd.drivers.palm.packet import ROUND, PalmPacket
from graspd.drivers.palm.stream import PalmStream
from graspd.drivers.twins.datagrams import PalmTwin
from graspd.drivers.twins.grasps.grasp_script import Durations
from graspd.drivers.twins.grasps.grasps import recorded_counts
from graspd.drivers.twins.grasps.whole_grasps import PALM_RATE_HZ, synthetic_grasps
from graspd.models import zoo
from graspd.models.runtime import TactileModel
from tests.daemon.fakes import FINGERS, MS, Clock, sound
from tests.drivers.one_sweep import tactile

GRACE = 3
"""Sweeps after the first turn of a ring from which no verdict may be `stable` any more."""
UNDER_RING = 30
"""Sweeps after that."""
HELD = Durations(first_rest_s=(3.0, 3.0), settle_s=(4.0, 4.0))


@pytest.mark.parametrize(("sweeps", "live"), [(2, 0), (64, 4), (128, 0), (129, 0)])
def test_a_ring_of_128_sweeps_is_frozen_from_its_repeat(sweeps: int, live: int) -> None:
    """The first `live` electrodes differ by one count from turn to turn."""
    health = Health(3)
    old = np.random.default_rng(2).integers(500, 3500, (sweeps, 3, 24))
    for number in range(3 * sweeps):
        counts = old[number % sweeps].copy()
        counts[:, :live] += number // sweeps
        is_frozen = Reason.FROZEN in health.check(sound(counts)).reasons
        assert is_frozen is (number >= sweeps and sweeps <= 128)


@pytest.mark.parametrize("packets", [15, 896])
def test_a_ring_of_odd_palm_packets_is_never_stable(packets: int) -> None:
    """Where it restarts a packet is lost, or two contradict each other: a round lacks those."""
    clock, stream = Clock(), PalmStream(FINGERS)
    model = TactileModel(zoo.find("cnn1"))
    pipeline = Pipeline(model, FINGERS, Limits(), clock, hand=HandLimits())
    moments = synthetic_grasps(1, rate_hz=PALM_RATE_HZ, durations=HELD, seed=0)
    source = PalmTwin(moment.counts for moment in moments).packets()
    last: deque[PalmPacket] = deque(maxlen=packets)
    stable, turning = 0, 0
    while turning < packets + (GRACE + UNDER_RING) * ROUND:
        clock.now_ns += MS
        packet = last[0] if stable >= UNDER_RING else next(source)
        last.append(packet)
        turning += stable >= UNDER_RING
        for reading in tactile(stream.receive(packet.to_bytes(), clock.now_ns) or ()):
            is_stable = pipeline.judge(reading).decision is Decision.STABLE
            assert not (is_stable and turning > packets + GRACE * ROUND)
            stable += is_stable
    assert stable >= UNDER_RING


@pytest.mark.parametrize(("equal", "is_frozen"), [(19, False), (20, True), (23, True)])
def test_a_sweep_of_twenty_equal_electrodes_comes_again(equal: int, is_frozen: bool) -> None:
    health, random = Health(3), np.random.default_rng(4)
    sweeps = random.integers(500, 3500, (9, 3, 24))
    sweeps[8, 1] = sweeps[2, 1]
    sweeps[8, 1, equal:] += 1
    for counts in sweeps:
        checked = health.check(sound(counts))
    assert (Reason.FROZEN in checked.reasons) == is_frozen


@pytest.mark.parametrize("faulty", ["always the same", "another each time", "at first", "later"])
def test_an_electrode_that_is_not_read_hides_no_ring(faulty: str) -> None:
    """Its count means nothing, however it is flagged."""
    health, random = Health(3), np.random.default_rng(1)
    old = random.integers(500, 3500, (9, 3, 24))
    said = []
    for number in range(60):
        reading = sound(old[number % 9])
        where = {
            "always the same": [4],
            "another each time": random.choice(24, 3, replace=False).tolist(),
            "at first": [number % 24] if number < 9 else [],
            "later": [number % 24] if number >= 9 else [],
        }[faulty]
        reading.faults[:, where] = ElectrodeFault.PARITY
        reading.counts[:, where] = random.integers(0, 4096, (3, len(where)))
        said.append(health.check(reading).reasons)
    assert all(Reason.FROZEN not in reasons for reasons in said[:9])
    assert all(Reason.FROZEN in reasons for reasons in said[9:])


def test_an_unread_finger_does_not_recur() -> None:
    health, random = Health(3), np.random.default_rng(3)
    for _ in range(300):
        reading = sound(random.integers(500, 3500, (3, 24)))
        reading.counts[1], reading.faults[1] = 0, ElectrodeFault.MISSING
        assert Reason.FROZEN not in health.check(reading).reasons


@pytest.mark.parametrize("table", ["palm_45", "palm_down", "palm_side", "untouched"])
def test_no_real_sweep_comes_again(
    bts3_dir: Path, untouched: NDArray[np.uint16], table: str
) -> None:
    sweeps = untouched if table == "untouched" else recorded_counts(bts3_dir / f"{table}.csv")
    health = Health(3)
    found = [Reason.FROZEN in health.check(sound(counts)).reasons for counts in sweeps]
    assert len(found) > 900
    assert not any(found)
