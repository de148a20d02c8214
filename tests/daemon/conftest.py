"""The recording of an untouched hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.drivers.twins.signals import untouched_counts


@pytest.fixture(scope="session")
def untouched(bts3_dir: Path) -> NDArray[np.uint16]:
    """9.8 s of three untouched sensors at 100 Hz, held values of 71.43 Hz: shape (977, 3, 24)."""
    path = bts3_dir.parent / "untouched" / "untouched.csv"
    if not path.is_file():
        pytest.skip("the real recording of an untouched hand is not there")
    return untouched_counts(path)
