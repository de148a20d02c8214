"""Repaired electrodes against the conditional mean of a Gaussian, in extended precision.

The daemon works with the inverse covariance; here the covariance itself is used.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
from numpy.typing import NDArray

from models import zoo
from models.electrodes import Electrodes
from models.runtime import TactileModel
from tests.stability.exact import Exact
from tests.stability.readings import ELECTRODES, likely_grasps

BROKEN_MAX, BROKEN_FINGER_MAX = 12, 8
"""Electrodes of a hand and of one finger that may be repaired."""
ERROR_MAX_COUNTS = 1e-6
"""A millionth of a count is 1e-8 of a finger's smallest spread."""
READINGS = 20


def test_a_repaired_electrode_is_the_conditional_mean(
    note: Callable[..., None], model: str
) -> None:
    seen = TactileModel(zoo.find(model)).contract.seen
    random, electrodes, worst = np.random.default_rng(1), Electrodes(seen), 0.0
    fingers = len(seen.centre)
    covariance = inverted(seen.whitening_matrix().astype(np.longdouble))
    centre = np.array(seen.centre, dtype=np.longdouble).ravel()
    for counts in likely_grasps(seen, seed=1)[:READINGS]:
        broken = np.zeros((fingers, ELECTRODES), dtype=np.bool_)
        first = random.integers(0, ELECTRODES - BROKEN_FINGER_MAX)
        broken[0, first : first + BROKEN_FINGER_MAX] = True
        others = BROKEN_MAX - BROKEN_FINGER_MAX
        broken[-1, random.choice(ELECTRODES, others, replace=False)] |= fingers > 1
        out = broken.ravel()
        deviations = counts.ravel().astype(np.longdouble) - centre
        weights = solved(covariance[np.ix_(~out, ~out)], deviations[~out])
        wanted = centre[out] + covariance[np.ix_(out, ~out)] @ weights
        found = electrodes.repaired(counts.astype(np.float64), broken).ravel()[out]
        worst = max(worst, float(np.abs(found - wanted).max()))
    number = BROKEN_MAX if fingers > 1 else BROKEN_FINGER_MAX
    note(
        step=f"repair of {number} electrodes, {model}",
        expected=f"counts to {ERROR_MAX_COUNTS:.0e}",
        found=f"{worst:.1e}",
    )
    assert worst <= ERROR_MAX_COUNTS


def inverted(whitening: Exact) -> Exact:
    """Inverse of `whitening @ whitening.T`, by forward substitution."""
    inverse = np.zeros_like(whitening)
    for row in range(len(whitening)):
        inverse[row] = -whitening[row, :row] @ inverse[:row]
        inverse[row, row] += 1
        inverse[row] /= whitening[row, row]
    return cast(Exact, inverse.T @ inverse)


def solved(matrix: Exact, right: Exact) -> Exact:
    """Solution of a symmetric positive definite system, by elimination without pivoting."""
    left, solution = matrix.copy(), right.copy()
    size = len(left)
    for row in range(size):
        factors: NDArray[np.longdouble] = left[row + 1 :, row] / left[row, row]
        left[row + 1 :] -= np.outer(factors, left[row])
        solution[row + 1 :] -= factors * solution[row]
    for row in reversed(range(size)):
        rest = left[row, row + 1 :] @ solution[row + 1 :]
        solution[row] = (solution[row] - rest) / left[row, row]
    return solution
