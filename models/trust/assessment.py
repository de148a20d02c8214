"""Assess a judged grasp by outcomes: its corrected probability, and what the risk permits."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from graspd.models.trust.learner import Learner, sigmoid
from graspd.models.trust.risk import Permission, Risk


class Assessment(msgspec.Struct, frozen=True):
    """Assessment of a grasp by outcomes, before the decision; the defaults mean no grasp."""

    outcomes: int
    """Number of outcomes that `p_slip` rests on."""
    p_slip: float | None = None
    """Probability of slip after learning, 0..1; at first the model's own. None: not judged."""
    log_odds: float = 0.0
    """Log-odds of slip, after learning."""
    permission: Permission = Permission.ALLOWED
    supervised: bool = False
    """True to request a lift of the grasp under supervision."""
    features: bytes = b""
    """The learner's features, float64, for `Learner.learn`."""


def assess(
    learner: Learner,
    risk: Risk,
    p_slip: float,
    margin: float,
    inputs: NDArray[np.floating],
    *,
    name: tuple[str, int],
    awaited: int,
) -> Assessment:
    """Assess a grasp by the model's `p_slip`, its log-odds `margin`, and its flat `inputs`.

    `name`: `GraspId` of the grasp, whose hash may have it supervised. `awaited`: announced lifts
    of other grasps whose outcome can still come. Raises `ValueError` for values that are not finite
    or of another shape; such a grasp must be `unknown`.
    """
    if not 0.0 <= p_slip <= 1.0:  # also true for NaN
        raise ValueError(f"{p_slip} is not a probability")
    log_odds, features = learner.judge(margin, inputs)
    permission = risk.decide(log_odds, awaited)
    return Assessment(
        outcomes=learner.outcomes,
        p_slip=sigmoid(log_odds) if learner.outcomes else p_slip,
        log_odds=log_odds,
        permission=permission,
        supervised=risk.supervised(permission, *name),
        features=features.astype("<f8").tobytes(),
    )
