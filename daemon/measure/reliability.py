"""How honest `p_slip` is: of the grasps with a probability of 0.1 a tenth should slip."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.daemon.measure.streams import Life, Stream
from graspd.daemon.process.text import markdown_table

EDGES: Final = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98, 1.0)
"""Ends of the parts in which `p_slip` is compared with what slipped."""
STEPS: Final = 50
"""Of Newton's method; 10 suffice."""
SLOPE_MAX: Final = 20.0
CONFIDENT: Final = 1e-12
"""A probability nearer to 0 or 1 is taken for this one."""


def slope(p_slip: NDArray[np.float64], slipped: NDArray[np.bool_]) -> float:
    """Return the factor on the log-odds that makes these probabilities (N,) the likeliest.

    1: honest. Above: timid. Below: too sure. At most `SLOPE_MAX`.
    """
    p = np.clip(p_slip, CONFIDENT, 1.0 - CONFIDENT)
    log_odds = np.log(p / (1.0 - p))
    factor = 1.0
    for _ in range(STEPS):
        said = 1.0 / (1.0 + np.exp(-factor * log_odds))
        curvature = float((said * (1.0 - said) * log_odds**2).sum())
        if curvature == 0.0:
            break
        factor += float(((slipped - said) * log_odds).sum()) / curvature
        factor = min(max(factor, 0.0), SLOPE_MAX)
    return factor


def reliability(
    several: Sequence[Stream], lives: Sequence[Life]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return `p_slip` of all judged grasps that rest on an outcome, and whether each slipped."""
    judged = [~one.refused & (life.outcomes > 0) for one, life in zip(several, lives, strict=True)]
    p_slip = [life.p_slip[rows] for life, rows in zip(lives, judged, strict=True)]
    slipped = [one.slipped[rows] for one, rows in zip(several, judged, strict=True)]
    return np.concatenate(p_slip), np.concatenate(slipped)


def reliability_table(several: Sequence[Stream], lives: Sequence[Life]) -> list[str]:
    """Return said and actual share of slips by part of `p_slip`, and the slope of each session."""
    p_slip, slipped = reliability(several, lives)
    rows = []
    for low, high in itertools.pairwise(EDGES):
        inside = (p_slip >= low) & (p_slip < high)
        if inside.any():
            said, actual = 100 * p_slip[inside].mean(), 100 * slipped[inside].mean()
            rows.append([f"{low:g} to {high:g}", str(inside.sum()), f"{said:.1f}", f"{actual:.1f}"])
    lines = list(markdown_table(("`p_slip`", "grasps", "said, %", "slipped, %"), rows))
    each = [slope(*reliability([one], [life])) for one, life in zip(several, lives, strict=True)]
    low, middle, high = np.quantile(each, (0.05, 0.5, 0.95))
    spread = f"of a session {middle:.2f}, from {low:.2f} to {high:.2f} (5 to 95 %)"
    return [*lines, "", f"Slope of outcomes on log-odds: {slope(p_slip, slipped):.2f}; {spread}."]
