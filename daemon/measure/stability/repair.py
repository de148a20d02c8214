"""Repair of broken electrodes against the conditional mean of a Gaussian, in extended precision.

The daemon works with the inverse covariance; here the covariance itself is used.
"""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import NDArray

from daemon.judge.health import BROKEN_FINGER_MAX, BROKEN_MAX
from daemon.measure.reference.exact import Exact
from daemon.measure.stability.cases import likely_grasps
from daemon.measure.stability.steps import StepRow
from models.contract import SeenCounts
from models.electrodes import Electrodes
from models.layout import ELECTRODES

ERROR_MAX_COUNTS = 1e-6
"""A millionth of a count is 1e-8 of a finger's smallest spread."""
READINGS = 20


def repair_row(name: str, seen: SeenCounts) -> StepRow:
    """As many broken electrodes as may be repaired, neighbours among them."""
    error = _error(seen)
    number = BROKEN_MAX if len(seen.centre) > 1 else BROKEN_FINGER_MAX
    return StepRow(
        f"repair of {number} electrodes, {name}",
        f"counts to {ERROR_MAX_COUNTS:.0e}",
        f"{error:.1e}",
        error <= ERROR_MAX_COUNTS,
    )


def _error(seen: SeenCounts) -> float:
    """Largest error of a repaired electrode, counts."""
    random = np.random.default_rng(1)
    electrodes = Electrodes(seen)
    fingers = len(seen.centre)
    covariance = _covariance(seen.whitening_matrix().astype(np.longdouble))
    centre = np.array(seen.centre, dtype=np.longdouble).ravel()
    worst = 0.0
    for counts in likely_grasps(seen, random)[:READINGS]:
        broken = np.zeros((fingers, ELECTRODES), dtype=np.bool_)
        first = random.integers(0, ELECTRODES - BROKEN_FINGER_MAX)
        broken[0, first : first + BROKEN_FINGER_MAX] = True
        others = BROKEN_MAX - BROKEN_FINGER_MAX
        broken[-1, random.choice(ELECTRODES, others, replace=False)] |= fingers > 1
        out = broken.ravel()
        deviations = counts.ravel().astype(np.longdouble) - centre
        known = _solved(covariance[np.ix_(~out, ~out)], deviations[~out])
        wanted = centre[out] + covariance[np.ix_(out, ~out)] @ known
        found = electrodes.repaired(counts.astype(np.float64), broken).ravel()[out]
        worst = max(worst, float(np.abs(found - wanted).max()))
    return worst


def _covariance(whitening: Exact) -> Exact:
    """Inverse of `whitening @ whitening.T`, by forward substitution."""
    inverse = np.zeros_like(whitening)
    for row in range(len(whitening)):
        inverse[row] = -whitening[row, :row] @ inverse[:row]
        inverse[row, row] += 1
        inverse[row] /= whitening[row, row]
    return cast(Exact, inverse.T @ inverse)


def _solved(matrix: Exact, right: Exact) -> Exact:
    """Solution of a symmetric positive definite system, by elimination without pivoting."""
    left, solution = matrix.copy(), right.copy()
    size = len(left)
    for row in range(size):
        factors: NDArray[np.longdouble] = left[row + 1 :, row] / left[row, row]
        left[row + 1 :] -= np.outer(factors, left[row])
        solution[row + 1 :] -= factors * solution[row]
    for row in reversed(range(size)):
        solution[row] = (solution[row] - left[row, row + 1 :] @ solution[row + 1 :]) / left[
            row, row
        ]
    return solution
