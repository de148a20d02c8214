"""A small `Trust`, and grasps for it to judge."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graspd.daemon.trust.lift_book import GraspId
from graspd.daemon.trust.trust import Trust
from graspd.models.trust.learner import sigmoid
from graspd.models.trust.risk import Permission, RiskLimits

BOOT = "0123456789abcdef" * 2
INPUTS = 26
RULE = RiskLimits(0.1)
TABLE = np.clip(np.random.default_rng(5).normal(0.0, 1.0, (997, INPUTS)), -3, 3).astype(np.float32)


def trust(limits: RiskLimits = RULE, *, learns: bool = True) -> Trust:
    return Trust("model", INPUTS, limits, learns=learns)


def named(grasp: int, boot: str = BOOT) -> GraspId:
    return GraspId(boot, grasp)


def inputs(grasp: int) -> NDArray[np.float32]:
    row: NDArray[np.float32] = TABLE[grasp % len(TABLE)]
    return row


def judge(part: Trust, grasp: int, margin: float = -6.0, boot: str = BOOT) -> bool:
    """Judge and note a grasp with `margin`, log-odds of slip; return True if it is `stable`."""
    name = named(grasp, boot)
    assessment = part.judge(name, sigmoid(margin), margin, inputs(grasp))
    stable = assessment.permission is Permission.ALLOWED and (assessment.p_slip or 0.0) < 0.5
    part.note(name, assessment, stable=stable)
    return stable
