"""Recordings that several tests of the judge use."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.conftest import data_dir
from tests.drivers.twins.signals import untouched_counts


@pytest.fixture(scope="session")
def untouched() -> NDArray[np.uint16]:
    """9.8 s of three untouched sensors at 100 Hz, held values of 71.43 Hz: shape (977, 3, 24)."""
    folder = data_dir()
    if folder is None or not (folder / "untouched" / "untouched.csv").is_file():
        pytest.skip("the real recording of an untouched hand is not there")
    return untouched_counts(folder / "untouched" / "untouched.csv")
