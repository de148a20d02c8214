"""How honest `p_slip` is: of the grasps with a probability of 0.1 a tenth should slip.

The learner's scale is fitted on the sessions of some objects and judged on those of the others.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from graspd.models.training.evaluating.files import markdown_table
from graspd.models.training.reports.streams import Group, Life
from graspd.models.trust.learner import SCALE

EDGES: Final = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98, 1.0)
"""Ends of the parts in which `p_slip` is compared with what slipped."""
SLOPE_MAX: Final = 20.0
CONFIDENT: Final = 1e-12
"""A probability nearer to 0 or 1 is taken for this one."""
SPREAD: Final = (0.05, 0.5, 0.95)
"""Quantiles of the sessions' slopes."""


@dataclass(frozen=True, slots=True)
class Part:
    """Grasps whose `p_slip` is between two edges."""

    low: float
    high: float
    grasps: int
    said: float
    """Mean `p_slip`."""
    slipped: float
    """Fraction."""


@dataclass(frozen=True, slots=True)
class Reliability:
    """Reliability of `p_slip` after outcomes, with scales fitted without its own objects."""

    parts: list[Part]
    slope: float
    """Slope of outcomes on log-odds; 1 is honest."""
    sessions: tuple[float, ...]
    """The same of single sessions, at the quantiles `SPREAD`."""
    scales: list[float]
    """Scale of each group of objects, fitted on the sessions of the others of its split."""
    shipped: float
    """Scale of the learner as it is shipped."""


def slope(p_slip: NDArray[np.float64], slipped: NDArray[np.bool_]) -> float:
    """Return the factor on the log-odds that makes these probabilities (N,) the likeliest.

    1: honest. Above: timid. Below: too sure. At most `SLOPE_MAX`.
    """
    p = np.clip(p_slip, CONFIDENT, 1.0 - CONFIDENT)
    log_odds = np.log(p / (1.0 - p))
    for_outcome = np.where(slipped, log_odds, -log_odds)
    if not for_outcome.any():
        return 1.0
    best = optimize.minimize_scalar(
        lambda factor: np.logaddexp(0.0, -factor * for_outcome).sum(),
        bounds=(0.0, SLOPE_MAX),
        method="bounded",
        options={"xatol": 1e-9},
    )
    return float(best.x)


def fitted_scales(unscaled: Sequence[Life]) -> dict[Group, float]:
    """Return the scale of each group of objects, fitted on the other groups of its split.

    `unscaled` are lives with a scale of 1. A group without others has the learner's.
    """
    scales = {}
    for group in dict.fromkeys(life.stream.group for life in unscaled):
        split = [life for life in unscaled if life.stream.group[0] == group[0]]
        others = [life for life in split if life.stream.group != group]
        scales[group] = slope(*outcomes_of(others)) if others else SCALE
    return scales


def outcomes_of(lives: Sequence[Life]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return `p_slip` of all judged grasps that rest on an outcome, and whether each slipped."""
    p_slip = np.concatenate([life.p_slip for life in lives])
    slipped = np.concatenate([life.stream.slipped for life in lives])
    refused = np.concatenate([life.stream.refused for life in lives])
    rows = ~refused & (np.concatenate([life.outcomes for life in lives]) > 0)
    return p_slip[rows], slipped[rows]


def reliability(lives: Sequence[Life], scales: dict[Group, float]) -> Reliability:
    """Return what `p_slip` of these lives is worth; they were lived with these scales."""
    p_slip, slipped = outcomes_of(lives)
    parts = []
    for low, high in itertools.pairwise(EDGES):
        inside = (p_slip >= low) & (p_slip < high)
        if inside.any():
            said, actual = float(p_slip[inside].mean()), float(slipped[inside].mean())
            parts.append(Part(low, high, int(inside.sum()), said, actual))
    spread = tuple(np.quantile([slope(*outcomes_of([life])) for life in lives], SPREAD).tolist())
    return Reliability(parts, slope(p_slip, slipped), spread, list(scales.values()), SCALE)


def reliability_lines(figures: Reliability) -> list[str]:
    """Return said and actual share of slips by part of `p_slip`, and the slopes."""
    rows = [
        [
            f"{part.low:g} to {part.high:g}",
            str(part.grasps),
            f"{100 * part.said:.1f}",
            f"{100 * part.slipped:.1f}",
        ]
        for part in figures.parts
    ]
    lines = list(markdown_table(("`p_slip`", "grasps", "said, %", "slipped, %"), rows))
    low, middle, high = figures.sessions
    return [
        *lines,
        "",
        f"Slope of outcomes on log-odds: {figures.slope:.2f}; of a session {middle:.2f}, from "
        f"{low:.2f} to {high:.2f} (5 to 95 %). Scale of each group of objects, fitted on the "
        f"others: {min(figures.scales):.2f} to {max(figures.scales):.2f}; shipped "
        f"{figures.shipped:g}.",
    ]
