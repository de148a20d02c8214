"""Health of readings against its definition, electrode by electrode in plain Python."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.judge.health import (
    JUMP_COUNTS,
    JUMPS_FADE,
    JUMPS_MAX,
    STILL,
    STILL_COUNTS,
    UNCHANGED_MAX,
    Health,
)
from daemon.judge.reasons import Reason
from drivers.base import TactileReading

FINGERS = 3
Counts = NDArray[np.uint16]
Flags = NDArray[np.uint8]


class Definition:
    """What is broken, and which finger repeats itself, by the words of `daemon.judge.health`."""

    def __init__(self) -> None:
        self.before: list[list[int]] | None = None
        self.unchanged = [[0] * 24 for _ in range(FINGERS)]
        self.jumps = [[0.0] * 24 for _ in range(FINGERS)]

    def watch(self, counts: Counts, flags: Flags) -> tuple[list[list[bool]], bool]:
        broken, repeats = [], False
        now, flagged = counts.tolist(), flags.tolist()
        for finger in range(FINGERS):
            sound = [not flag for flag in flagged[finger]]
            moved = [9999] * 24
            if self.before is not None:
                moved = [abs(a - b) for a, b in zip(now[finger], self.before[finger], strict=True)]
            is_still = sum(step <= STILL_COUNTS for step in moved) >= STILL
            for place, step in enumerate(moved):
                same = step == 0 and sound[place]
                self.unchanged[finger][place] = self.unchanged[finger][place] + 1 if same else 0
                jumps = self.before is not None and is_still and step > JUMP_COUNTS
                self.jumps[finger][place] = JUMPS_FADE * self.jumps[finger][place] + jumps
            read = [step for step, is_sound in zip(moved, sound, strict=True) if is_sound]
            repeats |= bool(read) and not any(read)
            broken.append(
                [
                    not sound[place]
                    or now[finger][place] in (0, 4095)
                    or self.unchanged[finger][place] >= UNCHANGED_MAX
                    or self.jumps[finger][place] > JUMPS_MAX
                    for place in range(24)
                ]
            )
        self.before = now
        return broken, repeats


def spoilt(random: np.random.Generator, sweeps: int) -> tuple[Counts, Flags]:
    """A hand that wavers, with dead, jumping, railed and flagged electrodes and held fingers."""
    counts = random.integers(500, 3500, (FINGERS, 24)) + np.zeros((sweeps, 1, 1), dtype=np.int64)
    counts += random.integers(-3, 4, counts.shape)
    counts[:, 0, 5] = 1234
    counts[:, 1, 3] += 400 * (random.random(sweeps) < 0.4)
    counts[sweeps // 2 :, 2] += 200  # a touch
    counts[:, 2, 7] = np.where(random.random(sweeps) < 0.1, 0, counts[:, 2, 7])
    counts[:, 1, 9] = np.where(random.random(sweeps) < 0.1, 4095, counts[:, 1, 9])
    flags = (random.random(counts.shape) < 0.01) * random.choice([1, 2, 4, 8], counts.shape)
    for sweep in random.choice(np.arange(1, sweeps), sweeps // 20, replace=False):
        counts[sweep, sweep % FINGERS] = counts[sweep - 1, sweep % FINGERS]
    return counts.astype(np.uint16), flags.astype(np.uint8)


@pytest.mark.parametrize("seed", range(5))
def test_every_electrode_is_broken_when_the_definition_says_so(seed: int) -> None:
    health, definition = Health(FINGERS), Definition()
    held, named = 0, set[Reason]()
    for place, (counts, flags) in enumerate(
        zip(*spoilt(np.random.default_rng(seed), 300), strict=True)
    ):
        watched = health.watch(TactileReading(place, place, counts, flags))
        broken, repeats = definition.watch(counts, flags)
        assert watched.broken.tolist() == broken, f"seed {seed}, sweep {place}"
        assert (Reason.FROZEN in watched.reasons) == repeats
        held += repeats
        named.update(health.electrodes().values())
    assert held > 5, "fingers were held"
    assert {Reason.ELECTRODE_DEAD, Reason.ELECTRODE_JUMPS, Reason.SATURATED} <= named


def test_a_first_reading_of_low_counts_is_no_jump_from_anywhere() -> None:
    health = Health(FINGERS)
    counts = np.full((FINGERS, 24), 5, dtype=np.uint16)
    counts[1, 4] = 3000
    flags = np.zeros(counts.shape, dtype=np.uint8)
    for place in range(3):  # two jumps more would be enough
        counts[1, 4] = 3000 - 500 * place
        health.watch(TactileReading(place, place, counts.copy(), flags))
    assert Reason.ELECTRODE_JUMPS not in health.electrodes().values()


def test_what_is_shared_by_all_sound_readings_cannot_be_written() -> None:
    sweeps, _ = spoilt(np.random.default_rng(0), 2)
    counts = np.clip(sweeps[0], 1, 4094)
    watched = Health(FINGERS).watch(
        TactileReading(0, 0, counts, np.zeros(counts.shape, dtype=np.uint8))
    )
    assert not watched.broken.any()
    with pytest.raises(ValueError, match="read-only"):
        watched.broken[0, 0] = True
