"""A single reading against the median of three fresh sweeps, on real grasps with measured noise.

`python -m tests.bench.median DIR` prints a table; DIR is the folder that holds `bts3/`. Every grasp
of the tables is read `DRAWS` times with noise on it: Gaussian, and one-sided spikes.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.twins.grasps.tactile_noise import MeasuredNoise
from drivers.twins.grasps.whole_grasps import read_end_points
from models import zoo
from models.runtime import TactileModel

TABLES = ("palm_down", "palm_side")
MODELS = ("cnn1", "svm")
DRAWS = 4


def noisy(
    counts: NDArray[np.uint16], sweeps: int, random: np.random.Generator
) -> NDArray[np.uint16]:
    """One reading of counts (fingers, 24), or the median of so many."""
    noise = MeasuredNoise(len(counts), random)
    # All at one time: warm-up drift is another matter.
    read = [np.clip(np.rint(counts + noise.sweep(np.zeros(()))), 1, 4094) for _ in range(sweeps)]
    median: NDArray[np.uint16] = np.median(read, axis=0).astype(np.uint16)
    return median


def probability(model: TactileModel, counts: NDArray[np.uint16]) -> float:
    """Of slip."""
    model.inputs.build(counts, model.input)
    return model.run()[1]


def lines(model: TactileModel, grasps: list[NDArray[np.uint16]]) -> Iterator[str]:
    """What noise does to a model's verdicts, for people."""
    clean = np.array([probability(model, counts) for counts in grasps])
    for sweeps in (1, 3):
        random = np.random.default_rng(0)
        flips, moved = [], []
        for _ in range(DRAWS):
            read = np.array([probability(model, noisy(c, sweeps, random)) for c in grasps])
            flips.append(np.mean((read >= 0.5) != (clean >= 0.5)))
            moved.append(np.abs(read - clean))
        far = np.quantile(np.concatenate(moved), 0.99)
        yield (
            f"{model.contract.name:6} {sweeps} sweep(s): {100 * np.mean(flips):.2f} +- "
            f"{100 * np.std(flips):.2f} % of verdicts flipped, p_slip moved by "
            f"{np.mean(moved):.4f} in the mean, {far:.3f} at p99"
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.median", description=__doc__)
    parser.add_argument("data", type=Path, metavar="DIR")
    options = parser.parse_args()
    paths = [options.data / "bts3" / f"{name}.csv" for name in TABLES]
    grasps = [point.counts for path in paths for point in read_end_points(path)]
    for name in MODELS:
        for line in lines(TactileModel(zoo.find(name)), grasps):
            print(line)  # noqa: T201


if __name__ == "__main__":
    main()
