"""Signals for twins in tests: noise of a recording played again, and grasps of tables."""

from __future__ import annotations

import ast
import csv
import itertools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES
from graspd.drivers.recordings.csv_rows import read_rows
from graspd.drivers.twins.grasps.grasp_script import EndPoint, Timetable
from graspd.drivers.twins.grasps.whole_grasps import Counting

PALM_ROWS = 7
"""Number of rows, 10 ms apart, after which a round of 14 ms begins with a row again."""
PALM_STALE_ROWS = 2
"""Number of `PALM_ROWS` that repeat an electrode: 28.57 %, verified in the untouched recording."""


def played(
    residuals: NDArray[np.float64],
) -> Callable[[int, np.random.Generator], Counting]:
    """Return a `noise` for `WholeGrasps` that plays `residuals`, (rows, fingers, 24), in a loop.

    Each sweep has one row, from a random row on; nothing is added.
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
    """Time, s, when the mean speed of creep falls to this rate, if no lift came before.

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
