"""Short names of array types; docstrings add shapes and units."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.generic]
"""Counts as read (uint16), or mapped to other sensors (float64)."""
Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
"""Input of a model."""
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
