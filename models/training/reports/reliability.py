"""Calibration of `p_slip`: of the grasps with a probability of 0.1 a tenth should slip.

The learner's scale is fitted on the sessions of some objects and judged on those of the others.
Rows are those of `streams.live`.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import pandas as pd
from scipy import optimize

from graspd.models.training.evaluating.files import markdown_table
from graspd.models.trust.learner import SCALE

EDGES: Final = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98, 1.0)
"""Limits of the ranges of `p_slip` in which it is compared with the share of slips."""
SLOPE_MAX: Final = 20.0
CONFIDENT: Final = 1e-12
"""Smallest distance of a probability from 0 and 1; nearer ones are clipped."""
SPREAD: Final = (0.05, 0.5, 0.95)
"""Quantiles of the sessions' slopes."""


def slope(rows: pd.DataFrame) -> float:
    """Return the factor on the log-odds that makes these probabilities the likeliest.

    1: calibrated. Above: too near to 0.5. Below: too confident. At most `SLOPE_MAX`.
    """
    p = np.clip(rows["p_slip"].to_numpy(), CONFIDENT, 1.0 - CONFIDENT)
    log_odds = np.log(p / (1.0 - p))
    for_outcome = np.where(rows["slipped"], log_odds, -log_odds)
    if not for_outcome.any():
        return 1.0
    best = optimize.minimize_scalar(
        lambda factor: np.logaddexp(0.0, -factor * for_outcome).sum(),
        bounds=(0.0, SLOPE_MAX),
        method="bounded",
        options={"xatol": 1e-9},
    )
    return float(best.x)


def fitted_scales(unscaled: pd.DataFrame) -> dict[tuple[int, int], float]:
    """Return a scale for each split and fold of objects, fitted on the split's other folds.

    `unscaled`: rows of `live` with a scale of 1. A single fold gets the learner's own scale.
    """
    scales = {}
    for split, rows in after_outcomes(unscaled).groupby("split"):
        for fold in rows["fold"].unique():
            others = rows[rows["fold"] != fold]
            scales[split, fold] = slope(others) if len(others) else SCALE
    return scales


def after_outcomes(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of judged grasps whose verdict rests on at least one outcome."""
    return rows[~rows["refused"] & (rows["outcomes"] > 0)]


def reliability(learning: pd.DataFrame, scales: dict[tuple[int, int], float]) -> dict[str, Any]:
    """Return the calibration of `p_slip` in rows of `live`, which had these scales.

    `parts`: for grasps with a `p_slip` from `low` to `high`, its mean (`said`) and the share that
    `slipped`. `slope`: of all grasps. `sessions`: quantiles `SPREAD` of single sessions' slopes.
    `scales`: those given, `shipped`: the learner's own.
    """
    rows = after_outcomes(learning)
    parts = [
        {
            "low": edges.left,
            "high": edges.right,
            "grasps": len(part),
            "said": part["p_slip"].to_numpy().mean(),
            "slipped": part["slipped"].mean(),
        }
        for edges, part in rows.groupby(pd.cut(rows["p_slip"], EDGES, right=False), observed=True)
    ]
    slopes = [slope(session) for _, session in rows.groupby("session")]
    return {
        "parts": parts,
        "slope": slope(rows),
        "sessions": np.quantile(slopes, SPREAD).tolist(),
        "scales": list(scales.values()),
        "shipped": SCALE,
    }


def reliability_lines(figures: dict[str, Any]) -> list[str]:
    """Return lines with predicted and actual share of slips by range of `p_slip`, and slopes."""
    rows = [
        [
            f"{part['low']:g} to {part['high']:g}",
            str(part["grasps"]),
            f"{100 * part['said']:.1f}",
            f"{100 * part['slipped']:.1f}",
        ]
        for part in figures["parts"]
    ]
    lines = list(markdown_table(("`p_slip`", "grasps", "said, %", "slipped, %"), rows))
    low, middle, high = figures["sessions"]
    scales = figures["scales"]
    return [
        *lines,
        "",
        f"Slope of outcomes on log-odds: {figures['slope']:.2f}; of a session {middle:.2f}, from "
        f"{low:.2f} to {high:.2f} (5 to 95 %). Scale of each group of objects, fitted on the "
        f"others: {min(scales):.2f} to {max(scales):.2f}; shipped {figures['shipped']:g}.",
    ]
