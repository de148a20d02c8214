"""Streams of whole grasps: rest, approach, touch, close, settle, lift or slip, release.

End points are rows of a grasp table, or drawn. The course between them is invented, with measured
noise. Contact lowers counts, so a plausible end point is not above the rest; see `rest_above`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX, ELECTRODES, TABLE_FINGERS
from graspd.drivers.twins.grasps import synthetic
from graspd.drivers.twins.grasps.grasp_script import (
    JOINT_NAMES,
    Durations,
    EndPoint,
    GraspScript,
    Timetable,
)

Counting = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Function of sample times, s, shape () or (24,), that returns counts, shape (fingers, 24)."""
RATE_HZ = 100.0
"""Rows per second in the public recordings; sweeps per second of an SPI bridge."""
PALM_RATE_HZ = 1000 / 14
"""Sweeps per second of a palm, which needs 14 packets of a millisecond for one."""
ROUND_MS = 14
PLACES_MS = 1 + np.arange(1, ELECTRODES + 1) // 2
"""Time in a round when each electrode is sampled, ms: PDC/TAC, TDC/E1, E2/E3, ... E24."""
POSITION_NOISE_RAD = 0.0003
"""Noise (standard deviation) of a joint that stands still, rad."""
WARM_REST_MAX = COUNT_MAX - 50
"""Highest count after drift; the end of the range would look like a fault."""
REST_DRAWS = 1000
"""Number of synthetic grasps whose upper quantile is the rest of synthetic fingers."""
LOOPED_DRAWS = 200
"""Number of different synthetic grasps in an endless stream."""

NOISE_COUNTS = 3.5
"""Standard deviation of an untouched electrode, counts; measured 2.9 to 4.3 (robust)."""
SPIKE_PROBABILITY = 0.01
"""Chance per electrode and sweep of a downward spike; measured 0.75 to 1.22 %."""
SPIKE_COUNTS = (25.0, 150.0)
"""Depth of a spike, counts; no upward spike was recorded."""
DRIFT_COUNTS_PER_S = 0.7
"""Warm-up drift, counts/s; measured 0.56 to 0.84, always upward."""
WARM_UP_S = 300.0
"""End of the drift, s, after 210 counts; assumed, because the recordings are shorter."""


@dataclass(frozen=True, slots=True, eq=False)
class GraspRow:
    """One row of the stream."""

    t_s: float
    """Time since the first row, s."""
    counts: NDArray[np.uint16]
    joint_names: tuple[str, ...]
    position_rad: NDArray[np.float64]
    """Shape (joints,), in the order of `joint_names`."""
    grasp: int
    """Number of the grasp, from 1, until the next approach; 0 before the first."""
    slipped: bool | None
    """Label of the grasp, True slip; None before the first grasp."""
    object_name: str | None


class WholeGrasps:
    """A stream of grasps. Each iteration starts again; one seed gives one stream."""

    def __init__(
        self,
        rest: NDArray[np.float64],
        end_points: Sequence[EndPoint],
        *,
        held: bool = False,
        rate_hz: float = RATE_HZ,
        noise: Callable[[int, np.random.Generator], Counting] | None = None,
        durations: Durations = Durations(),  # noqa: B008 (immutable)
        loop: bool = False,
        seed: int = 0,
    ) -> None:
        """Raises `ValueError` for a rate not above 0, or with `held` for another than `RATE_HZ`.

        `rest`: untouched counts, shape (fingers, 24). `end_points`: those of the grasps. `held`:
        2 of 7 rows repeat values, as in recordings at 100 Hz. `rate_hz`: rows/s. `noise`: makes the
        noise of a number of fingers; None: `MeasuredNoise`. `loop`: repeat the end points for ever.
        """
        if not 0.0 < rate_hz < float("inf"):
            raise ValueError(f"rate_hz is {rate_hz}, must be positive")
        if held and rate_hz != RATE_HZ:
            raise ValueError(f"held values come at {RATE_HZ:g} Hz, not {rate_hz}")
        self._rest = rest.astype(np.float64)
        self._end_points = end_points
        self._held = held
        self._rate_hz = rate_hz
        self._noise = noise or self._measured_noise
        self._durations = durations
        self._loop = loop
        self._seed = seed

    def __iter__(self) -> Iterator[GraspRow]:
        noise_seed, joint_seed = np.random.SeedSequence([self._seed, 0]).spawn(2)
        joint_rng = np.random.default_rng(joint_seed)
        noise = self._noise(len(self._rest), np.random.default_rng(noise_seed))
        sampler = Sampler(self._rest, noise, held=self._held)
        scripts = self._scripts()
        script = next(scripts)
        for row in count():
            t_s = row / self._rate_hz
            while t_s >= script.timetable.end_s:
                following = next(scripts, None)
                if following is None:
                    return
                script = following
            jitter = joint_rng.normal(0.0, POSITION_NOISE_RAD, len(JOINT_NAMES))
            timetable = script.timetable
            has_begun = t_s >= timetable.approach_s
            yield GraspRow(
                t_s=t_s,
                counts=sampler.sample(script.deviation, t_s),
                joint_names=JOINT_NAMES,
                position_rad=script.position_rad(t_s) + jitter,
                grasp=timetable.grasp if has_begun else 0,
                slipped=timetable.slipped if has_begun else None,
                object_name=timetable.object_name if has_begun else None,
            )

    def timetables(self) -> Iterator[Timetable]:
        """Yield the true times of each grasp. Call at any time."""
        return (script.timetable for script in self._scripts())

    def _scripts(self) -> Iterator[GraspScript]:
        first_rng = np.random.default_rng([self._seed, 1, 0])
        start_s = first_rng.uniform(*self._durations.first_rest_s)
        for index in count():
            if index >= len(self._end_points) and not self._loop:
                return
            # Each grasp has its own generator, so it does not depend on the others.
            rng = np.random.default_rng([self._seed, 1, index + 1])
            end_point = self._end_points[index % len(self._end_points)]
            script = GraspScript(end_point, self._rest, index + 1, start_s, self._durations, rng)
            yield script
            start_s = script.timetable.end_s

    def _measured_noise(self, fingers: int, rng: np.random.Generator) -> Counting:
        return MeasuredNoise(fingers, rng, np.maximum(WARM_REST_MAX - self._rest, 0.0)).sweep


class MeasuredNoise:
    """Gaussian noise, downward spikes of single electrodes, and the warm-up drift.

    As in recordings, at most one electrode of a finger spikes in a sweep, and never twice in a row.
    """

    def __init__(
        self,
        fingers: int,
        rng: np.random.Generator,
        drift_max: NDArray[np.float64] | float = np.inf,
    ) -> None:
        """`drift_max`: largest drift, counts, shape () or (fingers, 24)."""
        self._rng = rng
        self._drift_max = drift_max
        self._fingers = np.arange(fingers)
        self._spiked = rng.integers(0, ELECTRODES, fingers)

    def sweep(self, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return noise, counts, shape (fingers, 24). `t_s`: sample times, shape () or (24,)."""
        noise = self._rng.normal(0.0, NOISE_COUNTS, (self._fingers.size, ELECTRODES))
        drift = DRIFT_COUNTS_PER_S * np.minimum(t_s, WARM_UP_S)
        noise += np.minimum(drift, self._drift_max)
        spiking = self._rng.random(self._fingers.size) < SPIKE_PROBABILITY * ELECTRODES
        steps = self._rng.integers(1, ELECTRODES, self._fingers.size)
        self._spiked = (self._spiked + steps) % ELECTRODES
        depth = self._rng.uniform(*SPIKE_COUNTS, self._fingers.size)
        noise[self._fingers, self._spiked] -= spiking * depth
        return noise


class Sampler:
    """Sample a hand row by row, in order of time.

    With `held`, rows at 100 Hz have values of 71.43 Hz as in recordings: 2 of 7 rows repeat values.
    An electrode not sampled yet keeps its old value. Otherwise all are sampled at the row's time.
    """

    def __init__(self, rest: NDArray[np.float64], noise: Counting, *, held: bool = False) -> None:
        """`rest`: untouched counts, shape (fingers, 24). `noise`: added to them."""
        self._rest = rest
        self._noise = noise
        self._held = held
        self._round: int | None = None
        self._present = self._former = np.zeros(rest.shape, dtype=np.uint16)

    def sample(self, deviation: Counting, t_s: float) -> NDArray[np.uint16]:
        """Return the counts of the row at `t_s`. `deviation`: counts minus those at rest."""
        if not self._held:
            return self._sweep(deviation, np.asarray(t_s))
        number, into_ms = divmod(round(t_s * 1000.0), ROUND_MS)
        if self._round is None:
            self._present = self._begin(deviation, number - 1)
        if number != self._round:
            self._former, self._present = self._present, self._begin(deviation, number)
        return np.where(into_ms >= PLACES_MS, self._present, self._former)

    def _begin(self, deviation: Counting, number: int) -> NDArray[np.uint16]:
        self._round = number
        return self._sweep(deviation, (number * ROUND_MS + PLACES_MS) / 1000.0)

    def _sweep(self, deviation: Counting, t_s: NDArray[np.float64]) -> NDArray[np.uint16]:
        counts = self._rest + deviation(t_s) + self._noise(t_s)
        # Counts stay away from 0 and 4095, which would look like broken electrodes.
        readable = np.minimum(np.maximum(np.rint(counts), 1), COUNT_MAX - 1)
        return readable.astype(np.uint16)


def rest_above(end_points: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Return a resting level, (fingers, 24), for the grasps of a table, (grasps, fingers, 24).

    Contact lowers counts, and in many grasps an electrode is hardly pressed, so the rest is near
    the highest counts. One odd grasp decides a maximum, but not a quantile.
    """
    return np.asarray(np.quantile(end_points, 0.98, axis=0), dtype=np.float64)


def synthetic_grasps(
    grasps: int = LOOPED_DRAWS,
    *,
    held: bool = False,
    rate_hz: float = RATE_HZ,
    durations: Durations = Durations(),  # noqa: B008 (immutable)
    loop: bool = False,
    seed: int = 0,
) -> WholeGrasps:
    """Return a stream of synthetic grasps, half of them slips. Raises as `WholeGrasps`.

    `grasps`: number of different ones. The other arguments are those of `WholeGrasps`.
    """
    model = synthetic.read_model()
    rng = np.random.default_rng([seed, 2])
    shape = (-1, len(TABLE_FINGERS), ELECTRODES)
    rest = rest_above(synthetic.draw(model, rng, REST_DRAWS).counts.reshape(shape))
    drawn = synthetic.draw(model, rng, grasps)
    end_points = [
        EndPoint(counts, bool(slipped), f"{synthetic.OBJECT_PREFIX}_{component + 1}")
        for counts, slipped, component in zip(
            drawn.counts.reshape(shape), drawn.slipped, drawn.component, strict=True
        )
    ]
    return WholeGrasps(
        rest,
        end_points,
        held=held,
        rate_hz=rate_hz,
        durations=durations,
        loop=loop,
        seed=seed,
    )
