"""The faults of the table, each as a change of what comes from a hand."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX
from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.drivers.datagrams.tactile import TactileStream
from graspd.drivers.palm.packet import ROUND
from graspd.drivers.palm.stream import PalmStream
from graspd.drivers.twins.datagrams import PalmTwin, TactileTwin
from graspd.drivers.twins.faults import LinkFaults
from tests.daemon.fakes import FINGERS, MS
from tests.daemon.judge.fault_bench import Fault, Step
from tests.drivers.one_sweep import tactile

JOINTS_LOST_FOR = 120
"""Readings at 100 Hz: longer than the 1000 ms after which joints are lost."""
SYNCHRONISING = 3
"""Sound rounds from which the parts behind a palm know where in the stream they are."""


def lost(is_lost: Callable[[int], bool]) -> Fault:
    """Readings that do not come, by their number; the first under the fault is 1."""

    def spoil(sound: Sequence[Step]) -> list[Step]:
        return [
            dataclasses.replace(step, tactile=None) if is_lost(number) else step
            for number, step in enumerate(sound[1:], start=1)
        ]

    return spoil


def delayed(sound: Sequence[Step]) -> list[Step]:
    """Readings that come 0.2 s late."""
    return [dataclasses.replace(step, now_ns=step.now_ns + 200 * MS) for step in sound[1:]]


def in_tactile(change: Callable[[TactileReading, TactileReading], TactileReading]) -> Fault:
    """A change of each reading, given the last sound one."""

    def spoil(sound: Sequence[Step]) -> list[Step]:
        before = sound[0].tactile
        return [
            dataclasses.replace(step, tactile=change(step.tactile, before))
            for step in sound[1:]
            if step.tactile is not None and before is not None
        ]

    return spoil


Electrodes = tuple[int, slice]
ONE: Electrodes = (0, slice(6, 7))
NINE: Electrodes = (0, slice(9))
FINGER: Electrodes = (1, slice(24))


def flagged(fault: ElectrodeFault, where: Electrodes) -> Fault:
    """Electrodes that the driver flags, with a count that means nothing."""

    def change(reading: TactileReading, _before: TactileReading) -> TactileReading:
        counts, faults = reading.counts.copy(), reading.faults.copy()
        counts[where], faults[where] = 0, fault
        return msgspec.structs.replace(reading, counts=counts, faults=faults)

    return in_tactile(change)


def reading_only(count: int, where: Electrodes) -> Fault:
    """Electrodes that read the same count for ever."""

    def change(reading: TactileReading, _before: TactileReading) -> TactileReading:
        counts = reading.counts.copy()
        counts[where] = count
        return msgspec.structs.replace(reading, counts=counts)

    return in_tactile(change)


def stuck(where: Electrodes | slice = slice(None)) -> Fault:
    """Electrodes that repeat the last sound reading."""

    def change(reading: TactileReading, before: TactileReading) -> TactileReading:
        counts = reading.counts.copy()
        counts[where] = before.counts[where]
        return msgspec.structs.replace(reading, counts=counts)

    return in_tactile(change)


def wrong(by: int) -> Fault:
    """Counts that are all off by as much."""

    def change(reading: TactileReading, _before: TactileReading) -> TactileReading:
        counts = np.clip(reading.counts.astype(np.int32) + by, 0, COUNT_MAX)
        return msgspec.structs.replace(reading, counts=counts.astype(np.uint16))

    return in_tactile(change)


def garbage(sound: Sequence[Step]) -> list[Step]:
    """Any 16-bit words."""
    random = np.random.default_rng(0)

    def change(reading: TactileReading, _before: TactileReading) -> TactileReading:
        words = random.integers(0, 1 << 16, size=reading.counts.shape)
        counts = np.where(words <= COUNT_MAX, words, 0).astype(np.uint16)
        marks = np.where(words <= COUNT_MAX, 0, int(ElectrodeFault.NOT_A_COUNT)).astype(np.uint8)
        return msgspec.structs.replace(reading, counts=counts, faults=marks)

    return in_tactile(change)(sound)


def shifted(time_ms: int) -> Fault:
    """Readings whose time jumps by so much, once."""

    def change(reading: TactileReading, _before: TactileReading) -> TactileReading:
        return msgspec.structs.replace(reading, t_ns=reading.t_ns + time_ms * MS)

    return in_tactile(change)


def standing_still(reading: TactileReading, before: TactileReading) -> TactileReading:
    """A reading whose time is that of the last sound one."""
    return msgspec.structs.replace(reading, t_ns=before.t_ns)


def ring(sweeps: int, fingers: tuple[int, ...] = (0, 1, 2), live: int = 0) -> Fault:
    """The first `sweeps` come once more, and again and again, of these fingers.

    The first `live` electrodes of a finger differ by one count from turn to turn.
    """

    def spoil(sound: Sequence[Step]) -> list[Step]:
        steps: list[Step] = []
        for number, step in enumerate(sound[1:]):
            old = steps[number % sweeps].tactile if number >= sweeps else None
            if step.tactile is not None and old is not None:
                counts = step.tactile.counts.copy()
                counts[fingers, :] = old.counts[fingers, :]
                counts[fingers, :live] += np.uint16(number // sweeps % 2)
                tactile = msgspec.structs.replace(step.tactile, counts=counts)
                step = dataclasses.replace(step, tactile=tactile)
            steps.append(step)
        return steps

    return spoil


def in_joints(change: Callable[[NDArray[np.float64], float], NDArray[np.float64]]) -> Fault:
    """A change of the angles, given the seconds under fault."""

    def spoil(sound: Sequence[Step]) -> list[Step]:
        steps = []
        for step in sound[1:]:
            joints = step.joints
            if joints is not None:
                since_s = (step.now_ns - sound[0].now_ns) / 1e9
                angles = change(joints.position_rad, since_s)
                joints = msgspec.structs.replace(joints, position_rad=angles)
            steps.append(dataclasses.replace(step, joints=joints))
        return steps

    return spoil


def frozen_joints(sound: Sequence[Step]) -> list[Step]:
    """Angles that do not change by a bit any more."""
    last = next(step.joints for step in sound if step.joints is not None)
    return in_joints(lambda _angles, _s: last.position_rad)(sound)


def without_joints(sound: Sequence[Step]) -> list[Step]:
    """No angles come any more."""
    return [dataclasses.replace(step, joints=None) for step in sound[1:]]


def on_a_palm_link(faults: LinkFaults) -> Fault:
    """A fault between palm and host: packets by the millisecond, through the driver's parts."""

    def spoil(sound: Sequence[Step]) -> list[Step]:
        counts = [step.tactile.counts for step in sound if step.tactile is not None]
        joints = {step.now_ns: step.joints for step in sound}
        stream = PalmStream(FINGERS)
        before = PalmTwin([counts[0]] * SYNCHRONISING, seed=1).packets()
        lead_in = ([packet.to_bytes()] for packet in before)
        steps: list[Step] = []
        start_ns = sound[0].now_ns
        now_ns = start_ns - SYNCHRONISING * ROUND * MS
        for datagrams in itertools.chain(lead_in, PalmTwin(counts[1:], faults=faults).cycles()):
            now_ns += MS
            readings = [made for data in datagrams for made in stream.receive(data, now_ns) or ()]
            if now_ns > start_ns:
                steps.append(Step(now_ns, None, joints.get(now_ns)))
                steps += [Step(now_ns, reading, None) for reading in tactile(readings)]
        return steps

    return spoil


def in_datagrams(faults: LinkFaults, *, delay_ms: int = 0) -> Fault:
    """A fault between a sender of JSON and the host, and a delay that was not there before."""

    def spoil(sound: Sequence[Step]) -> list[Step]:
        counts = [step.tactile.counts for step in sound if step.tactile is not None]
        sent = TactileTwin(counts, FINGERS, faults=faults).cycles()
        stream = TactileStream(FINGERS, "right")
        for data in next(sent):
            stream.receive(data, sound[0].now_ns)
        steps: list[Step] = []
        for step, datagrams in zip(sound[1:], sent, strict=False):
            steps.append(dataclasses.replace(step, tactile=None))
            now_ns = step.now_ns + delay_ms * MS
            readings = [made for data in datagrams for made in stream.receive(data, now_ns) or ()]
            steps += [Step(now_ns, reading, None) for reading in readings]
        return sorted(steps, key=lambda step: step.now_ns)

    return spoil


def ring_on_a_palm(sweeps: int) -> Fault:
    """The same between palm and host, with packets that lack nothing."""
    link = on_a_palm_link(LinkFaults())
    return lambda sound: link([sound[0], *ring(sweeps)(sound)])


SINGLE = (
    ElectrodeFault.MISSING,
    ElectrodeFault.NOT_A_COUNT,
    ElectrodeFault.PARITY,
    ElectrodeFault.ERROR_WORD,
    ElectrodeFault.HELD,
    ElectrodeFault.CUT_OFF,
)
HALF = np.random.default_rng(0).random(1000) < 0.5
FAULTS: dict[str, Fault] = {
    "replay off": lost(lambda _number: True),
    "replay stuck": stuck(),
    "replay stuck electrode": stuck(ONE),
    "replay garbage": garbage,
    "replay wrong by +500": wrong(500),
    "replay wrong by -500": wrong(-500),
    "replay slow, 20th": lost(lambda number: number % 20 > 0),
    "replay delayed, 0.2 s": delayed,
    "replay intermittent": lost(lambda number: bool(HALF[number])),
    **{
        f"{fault.name}, {name}".lower().replace("_", "-"): flagged(fault, where)
        for fault in SINGLE
        for name, where in (("one", ONE), ("nine", NINE), ("finger", FINGER))
    },
    "at 0, one": reading_only(0, ONE),
    "at 0, nine": reading_only(0, NINE),
    "at 4095, one": reading_only(COUNT_MAX, ONE),
    "at 4095, nine": reading_only(COUNT_MAX, NINE),
    "ring of 2": ring(2),
    "ring of 8": ring(8),
    "ring of 64": ring(64),
    "ring of 8, finger": ring(8, (1,)),
    "ring of 64, one live": ring(64, live=1),
    "joints silent": without_joints,
    "joints lost": without_joints,
    "joints not valid": in_joints(lambda angles, _: np.full_like(angles, np.nan)),
    "joints frozen": frozen_joints,
    "joints move": in_joints(lambda angles, s: angles + 0.5 * s),
    "time stands still": in_tactile(standing_still),
    "time back by 50 ms": shifted(-50),
    "time back by 1 s": shifted(-1000),
    "time ahead by 50 ms": shifted(50),
    "palm drops 5 %": on_a_palm_link(LinkFaults(drop_probability=0.05)),
    "palm drops half": on_a_palm_link(LinkFaults(drop_probability=0.5)),
    "palm sends twice": on_a_palm_link(LinkFaults(duplicate_probability=1.0)),
    "palm reorders": on_a_palm_link(LinkFaults(reorder_probability=0.3)),
    "palm flips bits": on_a_palm_link(LinkFaults(bit_flip_probability=0.2)),
    "palm sends in bursts": on_a_palm_link(LinkFaults(burst_frames=70)),
    "palm disconnects": on_a_palm_link(LinkFaults(disconnect_every_frames=70)),
    "palm, later version": on_a_palm_link(LinkFaults(wrong_version=True)),
    "palm, dead electrode": on_a_palm_link(LinkFaults(dead_electrodes=((0, 6),))),
    "palm, unplugged": on_a_palm_link(LinkFaults(unplugged_fingers=(2,))),
    "palm, ring of 8": ring_on_a_palm(8),
    "palm's request stands": on_a_palm_link(LinkFaults(stuck_clock=True)),
    "JSON, drops half": in_datagrams(LinkFaults(drop_probability=0.5)),
    "JSON, sent twice": in_datagrams(LinkFaults(duplicate_probability=1.0)),
    "JSON, reordered": in_datagrams(LinkFaults(reorder_probability=0.3)),
    "JSON, disconnects": in_datagrams(LinkFaults(disconnect_every_frames=8)),
    "JSON, unplugged": in_datagrams(LinkFaults(unplugged_fingers=(2,))),
    "JSON, topic repeats": in_datagrams(LinkFaults(stuck_clock=True)),
    "JSON, queue of 0.15 s": in_datagrams(LinkFaults(), delay_ms=150),
}
"""`one`, `nine`: electrodes of one finger. Those of a palm come through its packets."""
EARLIER = {
    "joints lost": JOINTS_LOST_FOR,
    "joints frozen": JOINTS_LOST_FOR,
    "ring of 2": 2,
    "ring of 8": 8,
    "ring of 64": 64,
    "ring of 64, one live": 64,
    "ring of 8, finger": 8,
    "palm, ring of 8": 8,
}
"""Readings before the state from which on it is under the fault; a ring's first turn is sound."""
