"""Faults that the replay injects on request, named as in PX4, to test a controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX, ELECTRODES
from graspd.drivers.base import DriverCounters, ElectrodeFault


@dataclass(frozen=True, slots=True)
class ReplayFaults:
    """Faults to inject; by default none. Readings are numbered from 0 over the whole run.

    deploy/SCENE.md describes the names under `[tactile.faults]`; the scene checks the values.
    `stuck`, `wrong` and `garbage` change the counts of the chosen electrodes, in this order.
    `off`, `slow` and `intermittent` remove whole tactile readings; joint readings still come.
    Only `intermittent` leaves a gap in `seq`. `delayed` hands over late and keeps `t_ns`.
    """

    off_from: int | None = None
    stuck_from: int | None = None
    garbage_probability: float = 0.0
    wrong_counts: int = 0
    slow_every: int = 1
    delayed_s: float = 0.0
    intermittent_probability: float = 0.0
    fingers: tuple[str, ...] | None = None
    electrodes: tuple[int, ...] | None = None
    seed: int = 0


@dataclass(slots=True)
class ReplayCounters(DriverCounters):
    """Counters of a replay. `missed_readings`: those that `intermittent` removed."""

    late: int = 0
    """Readings handed over more than one period late; they are not skipped."""
    not_counts: int = 0
    """Electrode values handed over that are no 12-bit count, injected ones included."""
    cut_off: int = 0
    """Readings handed over whose row has no line end."""
    bad_angles: int = 0
    injected_off: int = 0
    """Readings removed by `off`. Each fault counts once in each reading, here and below."""
    injected_stuck: int = 0
    injected_garbage: int = 0
    injected_wrong: int = 0
    injected_slow: int = 0
    injected_delayed: int = 0
    injected_intermittent: int = 0


class FaultInjector:
    """Apply `ReplayFaults` to one run."""

    def __init__(
        self, faults: ReplayFaults, fingers: Sequence[str], counters: ReplayCounters
    ) -> None:
        self._faults = faults
        self._counters = counters
        by_chance = max(faults.garbage_probability, faults.intermittent_probability) > 0.0
        # Without random faults numpy.random is not imported: it takes 7 MiB.
        self._rng = np.random.default_rng(faults.seed) if by_chance else None
        self._where = _mask(faults, fingers)
        self._index = 0
        self._seq = 0
        self._held: tuple[NDArray[np.uint16], NDArray[np.uint8]] | None = None

    def inject(self, counts: NDArray[np.uint16], flags: NDArray[np.uint8]) -> int | None:
        """Change the next reading in place; return its `seq`, None if it is lost."""
        faults, counters = self._faults, self._counters
        index, held = self._index, self._held
        self._index += 1
        if self._index == faults.stuck_from:
            self._held = counts.copy(), flags.copy()
        if faults.off_from is not None and index >= faults.off_from:
            counters.injected_off += 1
            return None
        if index % faults.slow_every:
            counters.injected_slow += 1
            return None
        seq = self._seq
        self._seq += 1
        if self._happens(faults.intermittent_probability):
            counters.injected_intermittent += 1
            counters.missed_readings += 1
            return None
        if held is not None:
            np.copyto(counts, held[0], where=self._where)
            np.copyto(flags, held[1], where=self._where)
            counters.injected_stuck += 1
        self._spoil(counts, flags)
        return seq

    def _spoil(self, counts: NDArray[np.uint16], flags: NDArray[np.uint8]) -> None:
        faults, where = self._faults, self._where
        if faults.wrong_counts:
            shifted = np.clip(counts.astype(np.int32) + faults.wrong_counts, 0, COUNT_MAX)
            # A value that is no count stays 0.
            np.copyto(counts, shifted.astype(np.uint16), where=where & (flags == 0))
            self._counters.injected_wrong += 1
        if self._rng is not None and self._happens(faults.garbage_probability):
            words = self._rng.integers(0, 1 << 16, size=counts.shape)  # any 16-bit word
            is_count = words <= COUNT_MAX
            garbage = np.where(is_count, words, 0).astype(np.uint16)
            marks = np.where(is_count, 0, int(ElectrodeFault.NOT_A_COUNT)).astype(np.uint8)
            np.copyto(counts, garbage, where=where)
            np.copyto(flags, marks, where=where)
            self._counters.injected_garbage += 1

    def _happens(self, probability: float) -> bool:
        return self._rng is not None and probability > 0.0 and self._rng.random() < probability


def _mask(faults: ReplayFaults, fingers: Sequence[str]) -> NDArray[np.bool_]:
    chosen_fingers = tuple(fingers) if faults.fingers is None else faults.fingers
    electrodes = range(1, ELECTRODES + 1) if faults.electrodes is None else faults.electrodes
    mask = np.zeros((len(fingers), ELECTRODES), dtype=np.bool_)
    for finger in chosen_fingers:
        mask[fingers.index(finger), [electrode - 1 for electrode in electrodes]] = True
    return mask
