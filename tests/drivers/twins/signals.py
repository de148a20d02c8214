"""What twins may feel in tests: an endless contact, or the noise of a recording played again."""

from __future__ import annotations

import ast
import csv
import itertools
import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX, ELECTRODES
from graspd.drivers.recordings.csv_rows import read_rows
from graspd.drivers.twins.grasps.grasp_script import EndPoint, Timetable
from graspd.drivers.twins.grasps.grasps import Counts
from graspd.drivers.twins.grasps.whole_grasps import (
    DRIFT_COUNTS_PER_S,
    NOISE_COUNTS,
    SPIKE_COUNTS,
    SPIKE_PROBABILITY,
    Counting,
)

UNTOUCHED_COUNTS = (2400.0, 3400.0)
"""Range in which untouched electrodes rest, counts."""
CONTACT_COUNTS = 700.0
"""Deepest fall of an electrode under the generated contact, counts."""
CONTACT_PERIOD_S = 4.0
"""A touch comes and goes this often, s."""

PALM_ROWS = 7
"""Rows of 10 ms in which a palm's rounds of 14 ms come round again, ..."""
PALM_STALE_ROWS = 2
"""... and how many of them repeat an electrode: 28.57 %, verified in the untouched recording."""


class GeneratedContact:
    """An endless, synthetic contact: rest, a touch that comes and goes, and the measured noise."""

    def __init__(self, fingers: int = 3, seed: int = 0) -> None:
        """Readings are at 100 Hz; the same seed gives the same counts."""
        self._random = np.random.default_rng(seed)
        shape = (fingers, ELECTRODES)
        self._rest = self._random.uniform(*UNTOUCHED_COUNTS, shape)
        self._yielding = self._random.uniform(0.0, CONTACT_COUNTS, shape)
        self._t_s = 0.0

    def __iter__(self) -> Iterator[Counts]:
        return self

    def __next__(self) -> Counts:
        touch = 0.5 - 0.5 * np.cos(2.0 * np.pi * self._t_s / CONTACT_PERIOD_S)
        counts = self._rest - touch * self._yielding + DRIFT_COUNTS_PER_S * self._t_s
        counts = counts + self._random.normal(0.0, NOISE_COUNTS, counts.shape)
        spiked = self._random.random(counts.shape) < SPIKE_PROBABILITY
        counts = counts - spiked * self._random.uniform(*SPIKE_COUNTS, counts.shape)
        self._t_s += 0.01
        readable: Counts = np.clip(np.rint(counts), 1, COUNT_MAX - 1).astype(np.uint16)
        return readable


def played(
    residuals: NDArray[np.float64],
) -> Callable[[int, np.random.Generator], Counting]:
    """The noise of whole grasps: residuals, shape (rows, fingers, 24), in a loop.

    One row per sweep, from a random start; nothing is added.
    """

    def begin(_fingers: int, rng: np.random.Generator) -> Counting:
        start = int(rng.integers(len(residuals)))
        rows = itertools.cycle(np.roll(residuals, -start, axis=0))
        return lambda _t_s: next(rows)

    return begin


def fresh_residuals(held: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Noise of a palm's untouched recording: fresh samples only, without level and drift.

    `held`: counts, shape (rows, fingers, 24), 100 Hz, five new values in seven rows. The result has
    five rows for seven. Level and drift are the straight line through an electrode's samples, moved
    so that the median residual is zero: the spikes, all downward, would pull a mean.
    """
    rounds = len(held) // PALM_ROWS
    rows = held[: rounds * PALM_ROWS].astype(np.float64)
    # All fingers are sampled together, so that a row repeats an electrode on all of them at once.
    repeats = (np.diff(rows, axis=0, prepend=np.nan) == 0.0).all(axis=1)
    stale = repeats.reshape(rounds, PALM_ROWS, ELECTRODES).sum(axis=0)
    fresh_places = np.sort(np.argsort(stale, axis=0, kind="stable")[:-PALM_STALE_ROWS], axis=0)
    blocks = rows.reshape(rounds, PALM_ROWS, -1, ELECTRODES)
    fresh = np.take_along_axis(blocks, fresh_places[np.newaxis, :, np.newaxis], axis=1)
    samples = fresh.reshape(rounds * len(fresh_places), -1)
    times = np.arange(len(samples))
    slope, level = np.polyfit(times, samples, 1)
    residuals = samples - np.outer(times, slope) - level
    residuals -= np.median(residuals, axis=0)
    return np.asarray(residuals.reshape(len(samples), -1, ELECTRODES), dtype=np.float64)


def crept_s(timetable: Timetable, rate_counts_per_s: float) -> float:
    """When the mean rate of the electrodes falls below this rate, s, leaving out the lift.

    Never before `closed_s`; later than `lift_s` if the lift comes first.
    """
    rate = timetable.creep_counts_per_s
    if rate <= rate_counts_per_s:
        return timetable.closed_s
    return timetable.closed_s + timetable.creep_tau_s * math.log(rate / rate_counts_per_s)


def untouched_counts(path: Path) -> NDArray[np.uint16]:
    """Counts of ff, mf, th, shape (rows, 3, 24), of the recording of an untouched hand.

    It was exported from a ROS bag: finger i of FF, MF, RF, LF, TH has its electrodes, as a list, in
    cell 13 + 6 i of a row.
    """
    with path.open(newline="") as file:
        _header, *rows = csv.reader(file)
    fingers = [[ast.literal_eval(row[13 + 6 * i]) for i in (0, 1, 4)] for row in rows]
    return np.array(fingers, dtype=np.uint16)


def read_end_points(path: Path) -> list[EndPoint]:
    """The grasps of a labelled table of ff, mf, th, in the order of the file."""
    notes = ((row, row.annotation) for row in read_rows(path, ("ff", "mf", "th"), strict=True))
    return [
        EndPoint(row.counts, note.slipped is True, note.object_name or "") for row, note in notes
    ]
