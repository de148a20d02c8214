"""The readings on which stability is measured: stiff, extreme, impossible, random and real ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.base import COUNT_MAX, ELECTRODES, RecordingError
from drivers.recordings.csv_player import DEMO_RECORDING, DEMO_TABLE
from drivers.recordings.csv_rows import read_rows
from models.bts3 import TABLES
from models.contract import SeenCounts

RANDOM_READINGS = 300
"""Of each kind; a model takes up to 1 ms for one, with the reference beside it."""
STREAM_STEP = 20
"""Of the demo stream every 20th row is taken: its neighbours differ by noise alone."""
DENORMAL = 5e-310
"""Below the smallest normal double, 2.2e-308."""


@dataclass(frozen=True, slots=True, eq=False)
class StabilityCase:
    """Readings that have something in common."""

    name: str
    counts: NDArray[np.generic]
    """Shape (N, fingers, 24): uint16, raw counts; or float64, what no sensor sends."""
    never_judged: bool = False
    """Whether every verdict must be `unknown`."""
    one_hand: bool = False
    """Whether the readings are judged one after the other, as of one hand; else each is the first
    that its pipeline sees."""

    @property
    def is_raw(self) -> bool:
        """Whether a driver could hand the readings over."""
        return self.counts.dtype == np.uint16


def cases(fingers: int, seen: SeenCounts) -> Iterator[StabilityCase]:
    """All cases of a hand that need no recording, for a model that has `seen` these counts."""
    random = np.random.default_rng(0)
    likely = likely_grasps(seen, random)
    yield from _flat(fingers)
    yield from _stiff(fingers, likely)
    yield from _railed(fingers, likely)
    yield from _not_counts(fingers, likely)
    every = random.integers(0, COUNT_MAX + 1, (RANDOM_READINGS, fingers, ELECTRODES))
    yield StabilityCase("random 12-bit counts", every.astype(np.uint16), one_hand=True)
    yield StabilityCase("counts like the training's", likely, one_hand=True)


def recorded(fingers: Sequence[str], folder: Path | None) -> Iterator[StabilityCase]:
    """The demo recordings, and the real grasps of `folder`. Raises `RecordingError`."""
    table, stream = _counts(DEMO_TABLE, fingers), _counts(DEMO_RECORDING, fingers)
    yield StabilityCase("demo table", table, one_hand=True)
    yield StabilityCase("demo stream", stream[::STREAM_STEP], one_hand=True)
    if folder is None:
        return
    for file in TABLES:
        path = folder / f"{file.name}.csv"
        if not path.is_file():
            raise RecordingError(path, "no such file; `graspd data` gets it")
        yield StabilityCase(f"real grasps, {file.name}", _counts(path, fingers), one_hand=True)


def likely_grasps(seen: SeenCounts, random: np.random.Generator) -> NDArray[np.uint16]:
    """Counts (N, fingers, 24) drawn from the mean and covariance of a model's training."""
    centre = np.array(seen.centre)
    normal = random.normal(size=(RANDOM_READINGS, centre.size))
    # The covariance is inv(L @ L.T), so inv(L).T gives normal numbers just that.
    deviations = np.linalg.solve(seen.whitening_matrix().T, normal.T).T
    counts = np.rint(centre.ravel() + deviations).clip(1, COUNT_MAX - 1).astype(np.uint16)
    grasps: NDArray[np.uint16] = counts.reshape(-1, *centre.shape)
    return grasps


def _flat(fingers: int) -> Iterator[StabilityCase]:
    levels = np.array([1, 2, 2000, COUNT_MAX - 1], dtype=np.uint16)
    equal = np.broadcast_to(levels[:, None, None], (4, fingers, ELECTRODES)).copy()
    yield StabilityCase("all electrodes equal", equal, never_judged=True)
    yield StabilityCase("sigma of 1 count", _wavering(fingers, [1, 2000, 4090], 2), True)
    for sigma in (0.01, 1e-12):
        floats = _wavering(fingers, [1, 2000, 4090], 0).astype(np.float64)
        floats[..., ::2] += 2.0 * sigma
        yield StabilityCase(f"sigma of {sigma:g} counts", floats, never_judged=True)
    close = _wavering(fingers, [4000], 1)
    yield StabilityCase("counts 4000 +- 0.5", close, never_judged=True)
    yield StabilityCase("counts 4000 +- 2", _wavering(fingers, [3998], 4), never_judged=True)


def _wavering(fingers: int, lows: Sequence[int], step: int) -> NDArray[np.uint16]:
    """Every other electrode `step` counts above the low level: sigma is half of `step`."""
    counts = np.empty((len(lows), fingers, ELECTRODES), dtype=np.uint16)
    counts[...] = np.array(lows)[:, None, None]
    counts[..., ::2] += np.uint16(step)
    return counts


def _stiff(fingers: int, likely: NDArray[np.uint16]) -> Iterator[StabilityCase]:
    alone = []
    for electrode in range(ELECTRODES):
        for far in (1, 1000, COUNT_MAX - 1):
            counts = _wavering(fingers, [2000], 1)[0]
            counts[:, electrode] = far
            alone.append(counts)
    yield StabilityCase("one electrode far off", np.array(alone))
    yield StabilityCase("fingers' spreads 1e3 apart", _unequal(fingers).astype(np.uint16), True)
    # 1.5 and 1.5e6 counts: no sensor has them, the arithmetic must not mind.
    floats = _unequal(fingers)
    floats[:, -1] = (floats[:, -1] - 2000.0) * 1e3
    yield StabilityCase("fingers' spreads 1e6 apart", floats)
    dead = likely[:20].copy()
    dead[:, 0] = 2000
    yield StabilityCase("one finger dead", dead, never_judged=True)


def _unequal(fingers: int) -> NDArray[np.float64]:
    """Readings whose last finger spreads by 1500 counts and whose others spread by 1.5."""
    counts = _wavering(fingers, [2000, 3000], 3).astype(np.float64)
    counts[:, -1] = 2000.0 + 1500.0 * np.where(np.arange(ELECTRODES) % 2, 1.0, -1.0)
    return counts


def _railed(fingers: int, likely: NDArray[np.uint16]) -> Iterator[StabilityCase]:
    shape = (1, fingers, ELECTRODES)
    yield StabilityCase("all 0", np.zeros(shape, dtype=np.uint16), never_judged=True)
    full = np.full(shape, COUNT_MAX, dtype=np.uint16)
    yield StabilityCase("all 4095", full, never_judged=True)
    alternating = np.zeros((2, fingers, ELECTRODES), dtype=np.uint16)
    alternating[0, :, ::2] = alternating[1, :, 1::2] = COUNT_MAX
    yield StabilityCase("alternating 0 and 4095", alternating, never_judged=True)
    one = likely[: 2 * ELECTRODES].copy()
    for reading, electrode in enumerate(range(ELECTRODES)):
        one[2 * reading : 2 * reading + 2, 0, electrode] = (0, COUNT_MAX)
    yield StabilityCase("one electrode at a rail", one)


def _not_counts(fingers: int, likely: NDArray[np.uint16]) -> Iterator[StabilityCase]:
    for value in (np.nan, np.inf, -np.inf, 1e200):
        floats = likely[:ELECTRODES].astype(np.float64)
        for reading in range(ELECTRODES):
            floats[reading, reading % fingers, reading] = value
        yield StabilityCase(f"an electrode reads {value:g}", floats, never_judged=True)
    for value, name in ((DENORMAL, "denormal"), (-0.0, "negative zero")):
        floats = likely[:ELECTRODES].astype(np.float64)
        for reading in range(ELECTRODES):
            floats[reading, reading % fingers, reading] = value
        yield StabilityCase(f"an electrode reads {name}", floats)
        whole = np.full((1, fingers, ELECTRODES), value)
        yield StabilityCase(f"all electrodes read {name}", whole, never_judged=True)


def _counts(path: Path, fingers: Sequence[str]) -> NDArray[np.uint16]:
    """Counts (N, fingers, 24) of the rows of a recording."""
    return np.array([row.counts for row in read_rows(path, fingers)])
