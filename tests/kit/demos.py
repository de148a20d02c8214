"""Write the demo recordings that ship with graspd, byte for byte: `python -m tests.kit.demos`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TextIO

import numpy as np

from graspd.biotac import COUNT_MAX, TABLE_FINGERS, electrode_columns
from graspd.drivers.recordings.columns import OBJECT, SLIPPED, TIME
from graspd.drivers.recordings.csv_player import (
    DEMO_DAY,
    DEMO_RECORDING,
    DEMO_TABLE,
    SHOW_RECORDING,
)
from graspd.drivers.twins.grasps import synthetic
from graspd.drivers.twins.grasps.grasp_script import JOINT_NAMES, Durations
from graspd.drivers.twins.grasps.synthetic import COUNTS, GraspMixtures, SyntheticGrasps
from graspd.drivers.twins.grasps.whole_grasps import PALM_RATE_HZ, GraspRow, synthetic_grasps
from tests.kit.tables import write_table

TABLE_GRASPS = 200
DAY_GRASPS = 300
SEED = 0
DRIFT_ENDS = 0.6
"""Share of the day after which the sensors stop drifting."""
DRIFT_TO_STABLE = 1.2
"""Drift over the day, in multiples of the mean difference from slips to stable grasps."""
DRIFT_COUNTS, DRIFT_GAIN = 60.0, 0.1
"""Random drift: standard deviations over the electrodes of the offset, counts, and of the logarithm
of the gain."""
STREAM_GRASPS = 12
STREAM_DURATIONS = Durations(
    first_rest_s=(1.2, 1.2),
    approach_s=(0.25, 0.35),
    settle_s=(0.6, 0.7),
    lift_s=(0.35, 0.45),
    rest_s=(0.15, 0.25),
)
"""Phases of the stream, shorter than the default, for a small file."""
SHOW_GRASPS = 10
SHOW_DURATIONS = replace(STREAM_DURATIONS, settle_s=(2.0, 2.0), rest_s=(1.0, 1.0))
"""Held for two seconds, so that a person can read the verdict. In a rest of less than a second the
gate may lose the resting level of a finger."""


def draw_day(model: GraspMixtures, rng: np.random.Generator, grasps: int) -> SyntheticGrasps:
    """Draw grasps of sensors that drift until slips look like the stable grasps of the morning.

    The first grasps are those of `synthetic.draw`. Real sensors drift by hundreds of counts from
    month to month. Drift within one day, and in the misleading direction, is made up.
    """
    drawn = synthetic.draw(model, rng, grasps)
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


def write_stream(rows: Iterable[GraspRow], file: TextIO, t_decimals: int) -> None:
    """Write `rows` of ff, mf, th as a recorded stream with times of `t_decimals` decimals, s.

    Its column `slipped` is 0 before the first grasp.
    """
    electrodes = [name for finger in TABLE_FINGERS for name in electrode_columns(finger)]
    file.write(",".join([TIME, OBJECT, SLIPPED, *electrodes, *JOINT_NAMES]) + "\n")
    for row in rows:
        cells = [f"{row.t_s:.{t_decimals}f}", row.object_name or ""]
        cells += [str(int(row.slipped or False)), *map(str, row.counts.ravel().tolist())]
        cells += [f"{angle:.4f}" for angle in row.position_rad.tolist()]
        file.write(",".join(cells) + "\n")


def main(folder: Path = DEMO_TABLE.parent) -> None:
    """Write the demo table, the demo day, the short stream and the one to watch into `folder`."""
    model = synthetic.read_model()
    table = synthetic.draw(model, np.random.default_rng(SEED), TABLE_GRASPS)
    day = draw_day(model, np.random.default_rng(SEED), DAY_GRASPS)
    for grasps, demo in ((table, DEMO_TABLE), (day, DEMO_DAY)):
        objects = [f"{synthetic.OBJECT_PREFIX}_{each + 1}" for each in grasps.component]
        write_table(folder / demo.name, grasps.counts.reshape(-1, 3, 24), grasps.slipped, objects)
    stream = synthetic_grasps(STREAM_GRASPS, held=True, durations=STREAM_DURATIONS)
    watched = synthetic_grasps(SHOW_GRASPS, rate_hz=PALM_RATE_HZ, durations=SHOW_DURATIONS)
    for rows, demo, decimals in ((stream, DEMO_RECORDING, 2), (watched, SHOW_RECORDING, 3)):
        with (folder / demo.name).open("w", encoding="utf-8", newline="") as file:
            write_stream(rows, file, decimals)


if __name__ == "__main__":
    main()
