"""Faults that the replay puts into a recording on demand, in the words of PX4's failure injection.

They let a user see what a controller does when a sensor fails, and they test the daemon.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.base import COUNT_MAX, ELECTRODES, FINGERS, DriverCounters, ElectrodeFault

DELAY_MAX_S = 3600.0
"""An hour: longer is a mistake in the unit."""
WORD_MAX = 0xFFFF
"""Largest value of the 16-bit word in which a BioTac SP answers."""


@dataclass(frozen=True, slots=True)
class ReplayFaults:
    """Which faults to inject; by default none. Readings are numbered from 0 over the whole run.

    `stuck`, `wrong` and `garbage` change the counts of the chosen electrodes, in this order.
    `off`, `slow` and `intermittent` take whole tactile readings away; joint readings still come.
    Raises `ValueError` for a value out of range.
    """

    off_from: int | None = None
    """From this reading on the sensor is silent."""
    stuck_from: int | None = None
    """From this reading on the counts are those of the reading before it, so at least 1."""
    garbage_probability: float = 0.0
    """Chance that a reading has random 16-bit values for counts. Those over 4095 are no counts."""
    wrong_counts: int = 0
    """Added to every count; the sum is clipped to 0..4095."""
    slow_every: int = 1
    """The sensor makes only every n-th reading: readings 0, n, 2n... `seq` shows no gap."""
    delayed_s: float = 0.0
    """Readings come so many seconds late, and their `t_ns` says when they should have come."""
    intermittent_probability: float = 0.0
    """Chance that a reading is lost on the way. `seq` shows a gap."""
    fingers: tuple[str, ...] | None = None
    """Fingers whose counts change; None for all."""
    electrodes: tuple[int, ...] | None = None
    """Electrodes, 1..24, whose counts change; None for all."""
    seed: int = 0
    """The same seed injects the same faults into the same recording."""

    def __post_init__(self) -> None:
        for name, lowest in (("off_from", 0), ("stuck_from", 1), ("slow_every", 1), ("seed", 0)):
            value = getattr(self, name)
            if value is not None and value < lowest:
                raise ValueError(f"{name} is {value}, must be at least {lowest}")
        for name in ("garbage_probability", "intermittent_probability"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is {getattr(self, name)}, must be in 0..1")
        if abs(self.wrong_counts) > COUNT_MAX:
            raise ValueError(f"wrong_counts is {self.wrong_counts}, must be in +-{COUNT_MAX}")
        if not 0.0 <= self.delayed_s <= DELAY_MAX_S:
            raise ValueError(f"delayed_s is {self.delayed_s}, must be in 0..{DELAY_MAX_S:.0f}")
        _check_choice("fingers", self.fingers, FINGERS)
        _check_choice("electrodes", self.electrodes, range(1, ELECTRODES + 1))


@dataclass(slots=True)
class ReplayCounters(DriverCounters):
    """What a replay counts. `missed_readings` are those that `intermittent` took away."""

    late: int = 0
    """Readings handed over more than one period after they were due. None is ever skipped."""
    not_counts: int = 0
    """Electrode values handed over that are no 12-bit count, of the file or injected."""
    cut_off: int = 0
    """Readings handed over whose row has no line end."""
    bad_angles: int = 0
    """Joint angles handed over as NaN."""
    injected_off: int = 0
    """Readings kept back by `off`, and so on: one per reading and fault."""
    injected_stuck: int = 0
    injected_garbage: int = 0
    injected_wrong: int = 0
    injected_slow: int = 0
    injected_delayed: int = 0
    injected_intermittent: int = 0


class FaultInjector:
    """Applies `ReplayFaults` to one run and counts what it injects.

    For each reading in order call `observe`, `makes`, `loses` and `spoil`, as far as it gets.
    Raises `ValueError` if a fault names a finger that the run does not have.
    """

    def __init__(
        self, faults: ReplayFaults, fingers: Sequence[str], counters: ReplayCounters
    ) -> None:
        self._faults = faults
        self._counters = counters
        by_chance = max(faults.garbage_probability, faults.intermittent_probability) > 0.0
        # Where nothing is left to chance, numpy.random need not be imported: 7 MiB.
        self._rng = np.random.default_rng(faults.seed) if by_chance else None
        self._where = _mask(faults, fingers)
        self._held: tuple[NDArray[np.uint16], NDArray[np.uint8]] | None = None
        self._is_stuck = False

    def observe(self, index: int, counts: NDArray[np.uint16], flags: NDArray[np.uint8]) -> None:
        """Note the reading that later ones repeat, and whether this one does."""
        stuck_from = self._faults.stuck_from
        if stuck_from is None:
            return
        if index == stuck_from - 1:
            self._held = counts.copy(), flags.copy()
        self._is_stuck = index >= stuck_from

    def makes(self, index: int) -> bool:
        """Whether the sensor makes reading `index` at all: `off`, `slow`."""
        faults, counters = self._faults, self._counters
        if faults.off_from is not None and index >= faults.off_from:
            counters.injected_off += 1
            return False
        if index % faults.slow_every:
            counters.injected_slow += 1
            return False
        return True

    def loses(self) -> bool:
        """Draw whether this reading is lost (`intermittent`), and count it; call once a reading."""
        lost = self._happens(self._faults.intermittent_probability)
        self._counters.injected_intermittent += lost
        self._counters.missed_readings += lost
        return lost

    def spoil(self, counts: NDArray[np.uint16], flags: NDArray[np.uint8]) -> None:
        """Change a reading's counts and electrode faults, shape (fingers, 24), in place."""
        faults, counters, where = self._faults, self._counters, self._where
        if self._is_stuck and self._held is not None:
            np.copyto(counts, self._held[0], where=where)
            np.copyto(flags, self._held[1], where=where)
            counters.injected_stuck += 1
        if faults.wrong_counts:
            shifted = np.clip(counts.astype(np.int32) + faults.wrong_counts, 0, COUNT_MAX)
            # A value that is no count stays 0.
            np.copyto(counts, shifted.astype(np.uint16), where=where & (flags == 0))
            counters.injected_wrong += 1
        if self._rng is not None and self._happens(faults.garbage_probability):
            words = self._rng.integers(0, WORD_MAX, size=counts.shape, endpoint=True)
            is_count = words <= COUNT_MAX
            garbage = np.where(is_count, words, 0).astype(np.uint16)
            marks = np.where(is_count, 0, int(ElectrodeFault.NOT_A_COUNT)).astype(np.uint8)
            np.copyto(counts, garbage, where=where)
            np.copyto(flags, marks, where=where)
            counters.injected_garbage += 1

    def _happens(self, probability: float) -> bool:
        if self._rng is None or probability <= 0.0:
            return False
        return bool(self._rng.random() < probability)


def _mask(faults: ReplayFaults, fingers: Sequence[str]) -> NDArray[np.bool_]:
    """Shape (fingers, 24): the electrodes whose counts change."""
    chosen_fingers = tuple(fingers) if faults.fingers is None else faults.fingers
    strangers = [finger for finger in chosen_fingers if finger not in fingers]
    if strangers:
        raise ValueError(f"faults name finger {strangers[0]}, the run has {', '.join(fingers)}")
    electrodes = range(1, ELECTRODES + 1) if faults.electrodes is None else faults.electrodes
    mask = np.zeros((len(fingers), ELECTRODES), dtype=np.bool_)
    for finger in chosen_fingers:
        mask[fingers.index(finger), [electrode - 1 for electrode in electrodes]] = True
    return mask


def _check_choice(
    name: str, chosen: Sequence[str] | Sequence[int] | None, allowed: Sequence[str] | Sequence[int]
) -> None:
    if chosen is None:
        return
    if not chosen:
        raise ValueError(f"{name} is empty; leave it out for all")
    for value in chosen:
        if value not in allowed:
            raise ValueError(
                f"{name} has {value!r}, which is none of {', '.join(map(str, allowed))}"
            )
