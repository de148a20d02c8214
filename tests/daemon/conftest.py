"""The recording of an untouched hand, and the grasps of the demo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.drivers.recordings.csv_player import DEMO_DAY
from tests.drivers.twins.signals import untouched_counts


@pytest.fixture(scope="session")
def untouched(bts3_dir: Path) -> NDArray[np.uint16]:
    """Counts of three untouched sensors, 9.8 s at 100 Hz, where samples of 71.43 Hz repeat: shape
    (977, 3, 24)."""
    path = bts3_dir.parent / "untouched" / "untouched.csv"
    if not path.is_file():
        pytest.skip("the real recording of an untouched hand is not there")
    return untouched_counts(path)


@pytest.fixture(scope="module")
def counts() -> NDArray[np.float64]:
    """Counts of the demo's grasps, as numpy reads the file: shape (n, 3, 24)."""
    rows = np.genfromtxt(DEMO_DAY, delimiter=",", skip_header=1)
    names = DEMO_DAY.read_text().partition("\n")[0].split(",")
    places = [names.index(f"{f}_biotac_{e}") for f in ("ff", "mf", "th") for e in range(1, 25)]
    return rows[:, places].reshape(-1, 3, 24)
