"""A day with graspd: each grasp of a stream judged, lifted, and its outcome told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.measure.worth.streams import Stream
from daemon.trust.learner import sigmoid
from daemon.trust.lift_book import GraspId
from daemon.trust.trust import Permission, RiskLimits, Trust


@dataclass(frozen=True, slots=True, eq=False)
class Life:
    """What was said of a stream's grasps (N,), each after the outcomes of those before it."""

    stream: Stream
    p_slip: NDArray[np.float64]
    stable: NDArray[np.bool_]
    """Which were called stable."""
    supervised: NDArray[np.bool_]
    """Which others were lifted all the same, though only stable ones are."""
    excess: float
    """Most slips among stable lifts at any time beyond the share that is allowed."""
    within: bool
    """Whether they never exceeded the bound."""


def live(stream: Stream, limits: RiskLimits, *, every: bool) -> Life:
    """Judge, lift and tell one grasp after the other; not `every` lift, but those that it asks for.

    Without `every`, the outcomes of other grasps than stable and supervised ones stay unknown.
    """
    trust, number = Trust("worth", stream.features.shape[1], limits), len(stream.slipped)
    p_slip, stable = np.empty(number), np.zeros(number, np.bool_)
    supervised, excess, within = stable.copy(), 0.0, True
    alpha = limits.max_slip_when_stable or 0.0
    for index, (margin, row, slipped) in enumerate(stream.rows()):
        grasp = GraspId(stream.table, index)
        found = trust.judge(grasp, sigmoid(margin), margin, row)
        p_slip[index] = sigmoid(margin) if found.p_slip is None else found.p_slip
        supervised[index] = found.supervised
        stable[index] = found.permission is Permission.ALLOWED and p_slip[index] < 0.5
        trust.note(grasp, found, stable=bool(stable[index]))
        if every or stable[index] or found.supervised:
            trust.outcome(grasp, slipped=slipped)
        excess = max(excess, trust.risk.slips - alpha * trust.risk.lifts)
        within &= trust.risk.bound is None or trust.risk.slips <= trust.risk.bound + 1e-9
    return Life(stream, p_slip, stable, supervised & ~stable, excess, within)
