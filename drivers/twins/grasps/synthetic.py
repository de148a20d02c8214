"""Draw synthetic grasps from a small statistical model of real ones, for demos and tests.

The model describes the BioTac SP Stability Set (palm down and palm side; MIT licence,
Zapata-Impata et al. 2018, Garcia-Garcia et al. 2019). It has 5763 parameters per class, against
about 92,000 counts of a class, and contains no real grasp. A class is a mixture of three Gaussians
over the raw counts of ff, mf, th, with the 24 largest principal axes of each.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES, TABLE_FINGERS

COUNTS = len(TABLE_FINGERS) * ELECTRODES
MODEL = Path(__file__).with_name("grasp_classes.json")
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


class GraspMixtures(msgspec.Struct):
    """Gaussian mixtures of the counts of both classes, fitted to real grasps."""

    stable: GraspClass
    slip: GraspClass


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticGrasps:
    """Grasps drawn by `draw`."""

    counts: NDArray[np.uint16]
    """Shape (grasps, 72)."""
    slipped: NDArray[np.bool_]
    component: NDArray[np.int64]
    """Shape (grasps,): mixture component, from 0, instead of an object."""


def draw(model: GraspMixtures, rng: np.random.Generator, grasps: int) -> SyntheticGrasps:
    """Draw a number, `grasps`, from the mixtures of both classes, half of them slips, shuffled."""
    slipped = rng.permutation(np.arange(grasps) % 2 == 1)
    counts = np.zeros((grasps, COUNTS), dtype=np.uint16)
    component = np.zeros(grasps, dtype=np.int64)
    for index, label in enumerate(slipped):
        grasp_class = model.slip if label else model.stable
        component[index], counts[index] = _draw_one(grasp_class, rng)
    return SyntheticGrasps(counts, slipped, component)


def read_model() -> GraspMixtures:
    """Read the model of real grasps."""
    return msgspec.json.decode(MODEL.read_bytes(), type=GraspMixtures, dec_hook=_to_array)


def _to_array(_kind: type, numbers: list[float]) -> NDArray[np.float64]:
    return np.array(numbers, dtype=np.float64)


def _draw_one(grasp_class: GraspClass, rng: np.random.Generator) -> tuple[int, NDArray[np.uint16]]:
    """Return component and counts, shape (72,), of one grasp."""
    weights = np.array([component.weight for component in grasp_class.components])
    index = int(np.searchsorted(weights.cumsum() / weights.sum(), rng.random(), side="right"))
    component = grasp_class.components[index]
    along = rng.standard_normal(len(component.axes)) @ component.axes
    beside = rng.standard_normal(COUNTS) * component.spread
    counts = np.clip(component.mean + along + beside, grasp_class.lowest, grasp_class.highest)
    return index, counts.round().astype(np.uint16)
