"""Health of readings: broken electrodes, unusable readings, and old sweeps that are repeated."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.daemon.judge.decision import HandLimits, Limits
from graspd.daemon.judge.health import Checked, Health
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.judge.reasons import Decision, Reason
from graspd.drivers.base import ElectrodeFault, TactileReading
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
"""Number of repeated sweeps after which no verdict may be `stable`."""
UNDER_RING = 30
"""Number of sweeps checked after those, and of `stable` verdicts before packets are repeated."""
HELD = Durations(first_rest_s=(3.0, 3.0), settle_s=(4.0, 4.0))


def broken_of(checked: Checked) -> NDArray[np.bool_]:
    """Return True for the broken electrodes, shape (3, 24)."""
    return np.zeros((3, 24), np.bool_) if checked.broken is None else checked.broken


def test_the_first_reading_is_never_counted_as_a_jump() -> None:
    health = Health(len(FINGERS))
    counts = np.full((3, 24), 5)
    for place in range(3):  # two jumps more would be enough
        counts[1, 4] = 3000 - 500 * place
        health.check(sound(counts))
    assert Reason.ELECTRODE_JUMPS not in health.electrodes().values()


def watched(steps: NDArray[np.int64]) -> list[dict[tuple[int, int], Reason]]:
    """Return `Health.electrodes()` after each reading; finger 1 goes from 2000 by `steps`, shape
    (sweeps, 24).

    The electrodes of the other fingers step one count more than those that keep still may.
    """
    health, found = Health(len(FINGERS)), []
    for place in range(len(steps) + 1):
        counts = np.full((3, 24), 2000 + 31 * (place % 2))
        counts[1] = 2000 + steps[:place].sum(axis=0)
        broken = broken_of(health.check(sound(counts)))
        found.append(health.electrodes())
        assert {(f, e) for f, e in np.argwhere(broken).tolist()} == set(found[-1])
    return found


def steps_of(sweeps: int, jumps: dict[int, int], movers: int = 1, by: int = 0) -> NDArray[np.int64]:
    """Return steps of one up and down for all electrodes, shape (sweeps, 24).

    In the sweeps of `jumps` (sweep: counts) the first electrode makes that jump, and the next
    `movers` - 1 step by `by`.
    """
    steps = np.tile((-1) ** np.arange(sweeps)[:, None], (1, 24))
    for sweep, jump in jumps.items():
        steps[sweep, 1:movers] = by
        steps[sweep, 0] = jump
    return steps


@pytest.mark.parametrize(
    ("jumps", "jumpy"),
    [
        ({0: 151, 1: -151, 2: 151}, True),
        ({at: 150 * (-1) ** at for at in range(5)}, False),  # the highest spike
        ({0: -151, 1: 151, 2: -151}, True),
        ({at: -150 * (-1) ** at for at in range(5)}, False),
        ({0: 151, 1: -151}, False),  # twice may be a spike
        ({0: 151, 1: -151, 7: 151}, True),  # 0.9**6 * (0.9 + 1) + 1 = 2.01
        ({0: 151, 1: -151, 8: 151}, False),  # 1.91
    ],
)
def test_three_recent_jumps_higher_than_a_spike_flag_an_electrode(
    jumps: dict[int, int], jumpy: bool
) -> None:
    found = watched(steps_of(max(jumps) + 1, jumps))
    assert [named == {(1, 0): Reason.ELECTRODE_JUMPS} for named in found] == [
        *([False] * (len(found) - 1)),
        jumpy,
    ]


@pytest.mark.parametrize(("movers", "by", "jumpy"), [(4, 31, True), (5, 31, False), (5, 30, True)])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_jump_counts_only_while_twenty_others_keep_still(
    movers: int, by: int, jumpy: bool, sign: int
) -> None:
    """A touch moves more than four electrodes by more than 30 counts."""
    jumps = {0: 400, 1: -400, 2: 400}
    steps = steps_of(3, {at: sign * jump for at, jump in jumps.items()}, movers, sign * by)
    found = watched(steps)
    assert ((1, 0) in found[-1]) == jumpy


def test_samples_that_were_not_read_do_not_jump() -> None:
    health = Health(len(FINGERS))
    for place in range(20):
        reading = flat(2000 + place)
        if place % 2:
            reading.counts[1, 4], reading.faults[1, 4] = 0, ElectrodeFault.MISSING
        checked = health.check(reading)
        assert broken_of(checked).sum() == broken_of(checked)[1, 4] == place % 2


def test_lost_samples_do_not_hide_an_electrode_that_is_dead() -> None:
    health = Health(len(FINGERS))
    for place in range(40):
        reading = flat(2000 + place)
        reading.counts[1, 4] = 2000
        if place % 10 == 5:
            reading.counts[1, 4], reading.faults[1, 4] = 0, ElectrodeFault.MISSING
        checked = health.check(reading)
    assert broken_of(checked)[1, 4]


def test_an_electrode_unchanged_for_16_readings_is_dead() -> None:
    steps = steps_of(40, {})
    steps[:16, 0] = 0
    steps[17:, 5] = 0  # from 17 on
    found = watched(steps)
    named = [set(each) for each in found]
    assert named[15] == set()
    assert named[16] == {(1, 0)}
    assert named[17] == set(), "it has changed"
    assert named[32] == set()
    assert named[33] == {(1, 5)}


@pytest.mark.parametrize(
    ("broken", "found"),
    [
        ((8, 4, 0), False),
        ((8, 5, 0), True),  # more than 12
        ((9, 0, 0), True),  # more than 8 of one finger
        ((4, 4, 4), False),
        ((5, 4, 4), True),
        ((0, 0, 0), False),
        ((24, 24, 24), True),
    ],
)
def test_over_12_broken_electrodes_or_8_per_finger_are_refused(
    broken: tuple[int, ...], found: bool
) -> None:
    railed = np.array([np.arange(24) < number for number in broken])
    checked = Health(len(FINGERS)).check(sound(np.where(railed, 4095, 2000)))
    assert checked.reasons == ((Reason.SATURATED, Reason.ELECTRODES_BROKEN) if found else ())


@pytest.mark.parametrize(
    ("count", "railed"), [(0, True), (1, False), (4094, False), (4095, True), (65535, True)]
)
def test_only_counts_at_or_beyond_a_rail_are_broken(count: int, railed: bool) -> None:
    counts = np.full((3, 24), 2000)
    counts[2, 7] = count
    health = Health(len(FINGERS))
    broken = broken_of(health.check(sound(counts)))
    assert broken.sum() == broken[2, 7] == railed
    assert health.electrodes() == ({(2, 7): Reason.SATURATED} if railed else {})


def flat(count: int) -> TactileReading:
    """Return a reading whose electrodes all read `count`."""
    return sound(np.full((3, 24), count))


@pytest.mark.parametrize("flag", [ElectrodeFault.HELD, ElectrodeFault.CUT_OFF])
def test_a_sweep_that_repeats_an_unusable_one_is_frozen(flag: int) -> None:
    health, reasons = Health(len(FINGERS)), []
    for count, bits in [(2000, flag), (2001, 0), (2002, 0), (2000, 0)]:
        reading = flat(count)
        reading.faults[0, 0] = bits
        reasons.append(health.check(reading).reasons)
    assert reasons[1:] == [(), (), (Reason.FROZEN,)]


@pytest.mark.parametrize(
    ("flags", "reasons"),
    [
        (ElectrodeFault.PARITY | ElectrodeFault.NOT_A_COUNT, ()),
        (ElectrodeFault.HELD, (Reason.ERROR_WORD, Reason.HELD)),
        (ElectrodeFault.CUT_OFF, (Reason.ERROR_WORD, Reason.CUT_OFF)),
        (64, (Reason.ERROR_WORD,)),
    ],
)
def test_only_a_fault_of_the_whole_reading_makes_it_unusable(
    flags: int, reasons: tuple[Reason, ...]
) -> None:
    health, reading = Health(len(FINGERS)), flat(2000)
    reading.faults[2, 23], reading.faults[0, 1] = flags, ElectrodeFault.ERROR_WORD
    found = health.check(reading)
    assert found.reasons == reasons
    assert np.argwhere(broken_of(found)).tolist() == [[0, 1], [2, 23]]
    # Of two faults of an electrode the first is named; one of no name is not a count.
    named = {16: Reason.HELD, 32: Reason.CUT_OFF}.get(int(flags), Reason.NOT_A_COUNT)
    assert health.electrodes() == {(0, 1): Reason.ERROR_WORD, (2, 23): named}


@pytest.mark.parametrize("stream", [True, False])
@pytest.mark.parametrize(("sweeps", "live"), [(2, 0), (64, 4), (128, 0), (129, 0)])
def test_a_stream_that_repeats_up_to_128_sweeps_is_frozen(
    sweeps: int, live: int, stream: bool
) -> None:
    """The first `live` electrodes of each finger differ by one count from cycle to cycle."""
    health = Health(len(FINGERS), stream=stream)
    old = np.random.default_rng(2).integers(500, 3500, (sweeps, 3, 24))
    for number in range(3 * sweeps):
        counts = old[number % sweeps].copy()
        counts[:, :live] += number // sweeps
        is_frozen = Reason.FROZEN in health.check(sound(counts)).reasons
        assert is_frozen is (stream and number >= sweeps and sweeps <= 128)


@pytest.mark.parametrize("packets", [15, 896])
def test_repeating_the_same_palm_packets_is_never_stable(packets: int) -> None:
    """Where they start again a packet is lost, or two contradict each other and are left out.

    `packets`: number of packets that are repeated.
    """
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


@pytest.mark.parametrize(
    ("equal", "unread", "is_frozen"),
    [
        (19, 0, False),
        (20, 0, True),
        (23, 0, True),
        (12, 7, False),
        (12, 8, True),
        (12, 12, True),
        (11, 13, False),  # fewer than 12 that were read
    ],
)
@pytest.mark.parametrize("since", [0, 8])
def test_twenty_equal_or_unread_electrodes_make_a_repeated_sweep(
    equal: int, unread: int, is_frozen: bool, since: int
) -> None:
    """From sweep `since` on, `unread` electrodes of the finger are flagged."""
    health, random = Health(len(FINGERS)), np.random.default_rng(4)
    sweeps = random.integers(500, 3500, (9, 3, 24))
    sweeps[8, 1] = sweeps[2, 1]
    sweeps[8, 1, equal:] += 1
    for number, counts in enumerate(sweeps):
        reading = sound(counts)
        if number >= since:
            reading.faults[1, equal : equal + unread] = ElectrodeFault.PARITY
        checked = health.check(reading)
    assert (Reason.FROZEN in checked.reasons) == is_frozen


@pytest.mark.parametrize("faulty", ["always the same", "another each time", "at first", "later"])
def test_repeated_sweeps_are_frozen_despite_electrodes_that_were_not_read(faulty: str) -> None:
    """`faulty`: which electrodes are flagged, with random counts, in which sweeps."""
    health, random = Health(len(FINGERS)), np.random.default_rng(1)
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


def test_an_unread_finger_is_missing_but_not_a_repeated_sweep() -> None:
    health, random = Health(len(FINGERS)), np.random.default_rng(3)
    for _ in range(300):
        reading = sound(random.integers(500, 3500, (3, 24)))
        reading.counts[1], reading.faults[1] = 0, ElectrodeFault.MISSING
        reasons = health.check(reading).reasons
        assert reasons == (Reason.SENSOR_MISSING, Reason.ELECTRODES_BROKEN)


@pytest.mark.parametrize("table", ["palm_45", "palm_down", "palm_side", "untouched"])
def test_no_sweep_of_a_real_recording_counts_as_a_repeat(
    bts3_dir: Path, untouched: NDArray[np.uint16], table: str
) -> None:
    sweeps = untouched if table == "untouched" else recorded_counts(bts3_dir / f"{table}.csv")
    health = Health(len(FINGERS))
    found = [Reason.FROZEN in health.check(sound(counts)).reasons for counts in sweeps]
    assert len(found) > 900
    assert not any(found)
