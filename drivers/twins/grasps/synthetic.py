"""Synthetic grasps: drawn from a small statistical model of real ones, for demos and tests.

The model describes the BioTac SP Stability Set (palm down and palm side; MIT licence,
Zapata-Impata et al. 2018, Garcia-Garcia et al. 2019) by a few parameters per class and holds none
of its grasps. Each class is a mixture of Gaussians with few axes over the raw counts of ff, mf, th.

`python -m drivers.twins.grasps.synthetic` writes the demo table again, byte for byte, with `--day`
the demo day, and with `--fit FOLDER` first fits the model again to the tables in that folder.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from drivers.base import COUNT_MAX, ELECTRODES, RecordingError
from drivers.recordings.csv_player import DEMO_DAY, DEMO_TABLE
from drivers.recordings.csv_rows import OBJECT, SLIPPED, electrode_columns, read_rows

FINGERS = ("ff", "mf", "th")
COUNTS = len(FINGERS) * ELECTRODES
TABLES = ("palm_down.csv", "palm_side.csv")
MODEL = Path(__file__).with_name("grasp_classes.json")
COMPONENTS = 3
AXES = 24
"""Mixture components per class, and axes per component: 5763 parameters per class (`parameters`),
against 92,000 counts or so that a class of the data set has."""
DEMO_GRASPS = 200
DAY_GRASPS = 300
DEMO_SEED = 0
DRIFT_ENDS = 0.6
"""Share of a day after which its sensors drift no more."""
DRIFT_TO_STABLE = 1.2
"""By how many times the difference between the classes a drifting hand comes to read firmer."""
DRIFT_COUNTS, DRIFT_GAIN = 60.0, 0.1
"""Standard deviation, over the electrodes, of a further offset, and of the logarithm of a gain."""
FIT_SEED = 0
KMEANS_PASSES = 50
OBJECT_PREFIX = "synthetic"
ABOUT = (
    "Parameters of a statistical model of the grasps in the BioTac SP Stability Set (MIT licence), "
    "palm_down and palm_side, raw counts ff 1..24, mf 1..24, th 1..24. Draws from it are synthetic."
)


@dataclass(frozen=True, slots=True, eq=False)
class Component:
    """A Gaussian with few axes. Its covariance is `axes.T @ axes` plus `spread` squared."""

    weight: float
    """Share of the class, 0..1."""
    mean: NDArray[np.float64]
    """Shape (72,), counts."""
    axes: NDArray[np.float64]
    """Shape (axes, 72), counts: the largest principal axes, one standard deviation long."""
    spread: NDArray[np.float64]
    """Shape (72,), counts: standard deviation of each electrode beside the axes."""


@dataclass(frozen=True, slots=True, eq=False)
class GraspClass:
    """The grasps of one class: stable, or slip."""

    lowest: NDArray[np.float64]
    """Shape (72,), counts: what no real grasp of the class falls below."""
    highest: NDArray[np.float64]
    components: tuple[Component, ...]

    @property
    def parameters(self) -> int:
        """How many numbers the class is made of."""
        per_component = [1 + c.mean.size + c.axes.size + c.spread.size for c in self.components]
        return self.lowest.size + self.highest.size + sum(per_component)


GraspModel = Mapping[bool, GraspClass]
"""By label: False stable, True slip."""


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticGrasps:
    """What `draw` drew."""

    counts: NDArray[np.uint16]
    """Shape (grasps, 72)."""
    slipped: NDArray[np.bool_]
    """Shape (grasps,)."""
    component: NDArray[np.int64]
    """Shape (grasps,): the mixture component, from 0; it stands in for the object."""


def fit(counts: NDArray[np.uint16], slipped: NDArray[np.bool_]) -> GraspModel:
    """Fit both classes to real grasps: counts (grasps, 72), labels (grasps,).

    Raises `ValueError` for classes too small to fit.
    """
    return {
        label: _fit_class(counts[slipped == label].astype(np.float64)) for label in (False, True)
    }


def draw(model: GraspModel, rng: np.random.Generator, grasps: int) -> SyntheticGrasps:
    """Draw so many grasps, half of them slipping, in random order; counts within the real range."""
    slipped = rng.permutation(np.arange(grasps) % 2 == 1)
    counts = np.zeros((grasps, COUNTS), dtype=np.uint16)
    component = np.zeros(grasps, dtype=np.int64)
    for index, label in enumerate(slipped):
        grasp_class = model[bool(label)]
        component[index], counts[index] = _draw_one(grasp_class, rng)
    return SyntheticGrasps(counts, slipped, component)


def draw_day(model: GraspModel, rng: np.random.Generator, grasps: int) -> SyntheticGrasps:
    """As `draw`, but by sensors that drift: slips come to read as stable grasps did in the morning.

    At first the grasps are those of `draw`. Real sensors drift by hundreds of counts from month to
    month; that it happens within a day, and in the direction that misleads, is made up.
    """
    drawn = draw(model, rng, grasps)
    means = [
        sum((part.weight * part.mean for part in model[label].components), np.zeros(COUNTS))
        for label in (False, True)
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


def read_tables(paths: Sequence[Path]) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
    """Counts (grasps, 72) and labels (grasps,) of labelled tables. Raises `RecordingError`."""
    counts, slipped = [], []
    for path in paths:
        for row in read_rows(path, FINGERS, strict=True):
            if row.annotation.slipped is None:
                raise RecordingError(path, "the grasps have no labels", column=SLIPPED)
            counts.append(row.counts.ravel())
            slipped.append(row.annotation.slipped)
    return np.array(counts, dtype=np.uint16), np.array(slipped, dtype=np.bool_)


def write_model(model: GraspModel, path: Path) -> None:
    """Write a model as JSON, one vector per line."""
    classes = {
        _name(label): {
            "lowest": grasp_class.lowest.astype(int).tolist(),
            "highest": grasp_class.highest.astype(int).tolist(),
            "components": [
                {
                    "weight": component.weight,
                    "mean": component.mean.tolist(),
                    "spread": component.spread.tolist(),
                    "axes": component.axes.tolist(),
                }
                for component in grasp_class.components
            ],
        }
        for label, grasp_class in model.items()
    }
    text = json.dumps({"about": ABOUT, **classes}, separators=(",", ":"))
    path.write_text(text.replace("],", "],\n") + "\n", encoding="utf-8")


def read_model(path: Path = MODEL) -> GraspModel:
    """Read what `write_model` wrote."""
    document = json.loads(path.read_text(encoding="utf-8"))
    return {
        label: GraspClass(
            lowest=np.array(document[_name(label)]["lowest"]),
            highest=np.array(document[_name(label)]["highest"]),
            components=tuple(
                Component(
                    weight=component["weight"],
                    mean=np.array(component["mean"]),
                    axes=np.array(component["axes"]),
                    spread=np.array(component["spread"]),
                )
                for component in document[_name(label)]["components"]
            ),
        )
        for label in (False, True)
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the demo table, or one of another size, seed or model."""
    parser = argparse.ArgumentParser(
        prog="python -m drivers.twins.grasps.synthetic", description=__doc__
    )
    parser.add_argument("--fit", type=Path, metavar="FOLDER", help=f"fit to {', '.join(TABLES)}")
    parser.add_argument("--model", type=Path, default=MODEL, help="JSON file of the model")
    parser.add_argument("--day", action="store_true", help="a day in which the sensors drift")
    parser.add_argument("--out", type=Path, help="CSV file to write (default: the demo's)")
    parser.add_argument("--grasps", type=int, help=f"(default: {DEMO_GRASPS}, a day {DAY_GRASPS})")
    parser.add_argument("--seed", type=int, default=DEMO_SEED)
    options = parser.parse_args(arguments)
    try:
        if options.fit is not None:
            tables = [options.fit / table for table in TABLES]
            write_model(fit(*read_tables(tables)), options.model)
        rng = np.random.default_rng(options.seed)
        model = read_model(options.model)
        if options.day:
            grasps, out = draw_day(model, rng, options.grasps or DAY_GRASPS), DEMO_DAY
        else:
            grasps, out = draw(model, rng, options.grasps or DEMO_GRASPS), DEMO_TABLE
        with (options.out or out).open("w", encoding="utf-8", newline="") as file:
            write_table(grasps, file)
    except (RecordingError, OSError, ValueError) as error:
        parser.error(str(error))


def _name(label: bool) -> str:
    return "slip" if label else "stable"


def _fit_class(counts: NDArray[np.float64]) -> GraspClass:
    """Cluster the grasps, then take each cluster's largest principal axes. Rounded to 0.1 count."""
    cluster = _k_means(counts, np.random.default_rng(FIT_SEED))
    components = []
    for index in range(COMPONENTS):
        members = counts[cluster == index]
        if len(members) <= AXES:
            raise ValueError(f"{len(members)} grasps in a cluster are too few for {AXES} axes")
        mean = members.mean(axis=0)
        axes = _principal_axes(np.cov(members, rowvar=False))
        left = members.var(axis=0, ddof=1) - np.square(axes).sum(axis=0)
        components.append(
            Component(
                weight=round(len(members) / len(counts), 4),
                mean=mean.round(1),
                axes=axes.round(1),
                spread=np.sqrt(np.maximum(left, 0.0)).round(1),
            )
        )
    components.sort(key=lambda component: -component.weight)
    return GraspClass(counts.min(axis=0), counts.max(axis=0), tuple(components))


def _principal_axes(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """The largest axes, shape (AXES, 72), one standard deviation long."""
    variances, directions = np.linalg.eigh(covariance)
    largest = np.arange(COUNTS - 1, COUNTS - 1 - AXES, -1)
    axes = directions[:, largest].T * np.sqrt(variances[largest, np.newaxis])
    # An axis has no direction of its own; this choice makes a fit repeatable.
    steepest = np.abs(axes).argmax(axis=1)
    signed: NDArray[np.float64] = axes * np.sign(axes[np.arange(AXES), steepest])[:, np.newaxis]
    return signed


def _k_means(counts: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.int64]:
    """Cluster of each grasp, shape (grasps,)."""
    if len(counts) < COMPONENTS:
        raise ValueError(f"{len(counts)} grasps are too few for {COMPONENTS} clusters")
    centres = counts[rng.choice(len(counts), COMPONENTS, replace=False)]
    nearest = np.zeros(len(counts), dtype=np.int64)
    for _ in range(KMEANS_PASSES):
        distances = np.square(counts[:, np.newaxis] - centres).sum(axis=2)
        nearest = distances.argmin(axis=1)
        centres = np.array(
            [
                counts[nearest == index].mean(axis=0) if (nearest == index).any() else centre
                for index, centre in enumerate(centres)
            ]
        )
    return nearest


def _draw_one(grasp_class: GraspClass, rng: np.random.Generator) -> tuple[int, NDArray[np.uint16]]:
    """The component and the counts, shape (72,), of one grasp."""
    weights = np.array([component.weight for component in grasp_class.components])
    index = int(np.searchsorted(weights.cumsum() / weights.sum(), rng.random(), side="right"))
    component = grasp_class.components[index]
    along = rng.standard_normal(len(component.axes)) @ component.axes
    beside = rng.standard_normal(COUNTS) * component.spread
    counts = np.clip(component.mean + along + beside, grasp_class.lowest, grasp_class.highest)
    return index, counts.round().astype(np.uint16)


if __name__ == "__main__":
    main()
