"""Draw synthetic grasps from a small statistical model of real ones, for demos and tests.

The model describes the BioTac SP Stability Set (palm down and palm side; MIT licence,
Zapata-Impata et al. 2018, Garcia-Garcia et al. 2019). It has 5763 parameters per class, against
about 92,000 counts of a class, and contains no real grasp. A class is a mixture of three Gaussians
over the raw counts of ff, mf, th, with the 24 largest principal axes of each.

`python -m graspd.drivers.twins.grasps.synthetic` writes the demo table and the demo day.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import msgspec
import numpy as np
from numpy.typing import NDArray

from graspd.drivers.base import COUNT_MAX, ELECTRODES
from graspd.drivers.recordings.csv_player import DEMO_DAY, DEMO_TABLE
from graspd.drivers.recordings.csv_rows import OBJECT, SLIPPED, electrode_columns

FINGERS = ("ff", "mf", "th")
COUNTS = len(FINGERS) * ELECTRODES
MODEL = Path(__file__).with_name("grasp_classes.json")
DEMO_GRASPS = 200
DAY_GRASPS = 300
DEMO_SEED = 0
DRIFT_ENDS = 0.6
"""Share of the day after which the sensors stop drifting."""
DRIFT_TO_STABLE = 1.2
"""Drift of the day toward stable grasps, in differences between the classes."""
DRIFT_COUNTS, DRIFT_GAIN = 60.0, 0.1
"""Standard deviations over the electrodes: of an offset, counts, and of a gain's logarithm."""
OBJECT_PREFIX = "synthetic"


@dataclass(frozen=True, slots=True, eq=False)
class Component:
    """A Gaussian with few axes; its covariance is `axes.T @ axes` plus `spread` squared."""

    weight: float
    mean: NDArray[np.float64]
    axes: NDArray[np.float64]
    """Shape (axes, 72), counts: the largest principal axes, one standard deviation long."""
    spread: NDArray[np.float64]
    """Shape (72,), counts: standard deviation of each electrode without the axes."""


@dataclass(frozen=True, slots=True, eq=False)
class GraspClass:
    """Model of the grasps of one class: stable or slip."""

    lowest: NDArray[np.float64]
    """Shape (72,), counts: lowest counts of the class's real grasps."""
    highest: NDArray[np.float64]
    components: tuple[Component, ...]


class GraspModel(msgspec.Struct):
    """Model of each class."""

    stable: GraspClass
    slip: GraspClass


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticGrasps:
    """Grasps drawn by `draw` or `draw_day`."""

    counts: NDArray[np.uint16]
    slipped: NDArray[np.bool_]
    component: NDArray[np.int64]
    """Shape (grasps,): mixture component, from 0, instead of an object."""


def draw(model: GraspModel, rng: np.random.Generator, grasps: int) -> SyntheticGrasps:
    """Draw grasps in random order, half of them slips, with counts in the real range."""
    slipped = rng.permutation(np.arange(grasps) % 2 == 1)
    counts = np.zeros((grasps, COUNTS), dtype=np.uint16)
    component = np.zeros(grasps, dtype=np.int64)
    for index, label in enumerate(slipped):
        grasp_class = model.slip if label else model.stable
        component[index], counts[index] = _draw_one(grasp_class, rng)
    return SyntheticGrasps(counts, slipped, component)


def draw_day(model: GraspModel, rng: np.random.Generator, grasps: int) -> SyntheticGrasps:
    """Draw grasps of sensors that drift until slips look like the stable grasps of the morning.

    The first grasps are those of `draw`. Real sensors drift by hundreds of counts from month to
    month. Drift within one day, and in the misleading direction, is made up.
    """
    drawn = draw(model, rng, grasps)
    means = [
        sum((part.weight * part.mean for part in grasp_class.components), np.zeros(COUNTS))
        for grasp_class in (model.stable, model.slip)
    ]
    offset = DRIFT_TO_STABLE * (means[0] - means[1]) + rng.normal(0.0, DRIFT_COUNTS, COUNTS)
    gain = np.exp(rng.normal(0.0, DRIFT_GAIN, COUNTS))
    centre = (means[0] + means[1]) / 2.0
    drift = np.minimum(np.arange(grasps)[:, np.newaxis] / (DRIFT_ENDS * grasps), 1.0)
    counts = centre + (drawn.counts - centre) * gain**drift + offset * drift
    readable = np.clip(np.rint(counts), 1, COUNT_MAX - 1).astype(np.uint16)
    return SyntheticGrasps(readable, drawn.slipped, drawn.component)


def write_table(grasps: SyntheticGrasps, file: TextIO) -> None:
    """Write a grasp table in the layout of the BioTac SP Stability Set."""
    electrodes = [name for finger in FINGERS for name in electrode_columns(finger)]
    file.write(",".join([OBJECT, SLIPPED, *electrodes]) + "\n")
    rows = zip(grasps.component, grasps.slipped, grasps.counts, strict=True)
    for component, slipped, counts in rows:
        cells = [f"{OBJECT_PREFIX}_{component + 1}", int(slipped), *counts]
        file.write(",".join(map(str, cells)) + "\n")


def read_model() -> GraspModel:
    """Read the model of real grasps."""
    return msgspec.json.decode(MODEL.read_bytes(), type=GraspModel, dec_hook=_to_array)


def _to_array(_kind: type, numbers: list[float]) -> NDArray[np.float64]:
    return np.array(numbers, dtype=np.float64)


def main(folder: Path = DEMO_TABLE.parent) -> None:
    """Write the demo table and the demo day."""
    model = read_model()
    table = draw(model, np.random.default_rng(DEMO_SEED), DEMO_GRASPS)
    day = draw_day(model, np.random.default_rng(DEMO_SEED), DAY_GRASPS)
    for grasps, demo in ((table, DEMO_TABLE), (day, DEMO_DAY)):
        with (folder / demo.name).open("w", encoding="utf-8", newline="") as file:
            write_table(grasps, file)


def _draw_one(grasp_class: GraspClass, rng: np.random.Generator) -> tuple[int, NDArray[np.uint16]]:
    """Return component and counts, shape (72,), of one grasp."""
    weights = np.array([component.weight for component in grasp_class.components])
    index = int(np.searchsorted(weights.cumsum() / weights.sum(), rng.random(), side="right"))
    component = grasp_class.components[index]
    along = rng.standard_normal(len(component.axes)) @ component.axes
    beside = rng.standard_normal(COUNTS) * component.spread
    counts = np.clip(component.mean + along + beside, grasp_class.lowest, grasp_class.highest)
    return index, counts.round().astype(np.uint16)


if __name__ == "__main__":
    main()
