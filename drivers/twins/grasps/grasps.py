"""Read the counts of a recording, for a twin to play."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graspd.drivers.base import RecordingError
from graspd.drivers.recordings.csv_rows import read_rows

Counts = NDArray[np.uint16]
"""Shape (fingers, 24), raw counts 0..4095."""


def recorded_counts(path: Path) -> Iterator[Counts]:
    """Yield the counts of ff, mf, th of a grasp table or stream. Raises `RecordingError`."""
    for row in read_rows(path, ("ff", "mf", "th")):
        if row.faults.any():
            raise RecordingError(path, "holds another value than a count", line=row.annotation.line)
        yield row.counts
