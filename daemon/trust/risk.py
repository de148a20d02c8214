"""Keeps the share of slips among `stable` lifts at what the user allows, whatever drifts."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Final

import msgspec

LOWEST: Final = -6.0
"""Log-odds of slip (0.25 %) that the threshold must not fall below: nothing is surer than that."""
STEP: Final = 1.0
"""How far an outcome moves the threshold, log-odds, per slip more or less than allowed."""

Count = Annotated[int, msgspec.Meta(ge=0)]


class Permission(StrEnum):
    """Whether a grasp may be called `stable`."""

    ALLOWED = "allowed"
    WITHHELD = "withheld"
    """Too likely to slip for the risk that is set."""
    UNPROVEN = "unproven"
    """As withheld, and too few outcomes are known: lift under supervision."""
    RISK_EXCEEDED = "risk-exceeded"
    """More slipped than the rule can make good: nothing is `stable` until the user starts anew."""


@dataclass(frozen=True, slots=True)
class RiskLimits:
    """What the user sets."""

    max_slip_when_stable: float | None = None
    """Share of the `stable` lifts that may slip, 0.001..0.5; None: no rule, all is allowed."""
    warm_up: int = 0
    """Outcomes, since the start or an exchange of a sensor, until which every grasp is to be
    lifted under supervision; few are surely `stable` by then."""
    explore: float = 0.0
    """Share, 0..1, of the grasps that are not `stable` to be lifted under supervision: without
    their outcomes nobody learns that the rule is too strict."""

    def __post_init__(self) -> None:
        """Raise `ValueError` for what is out of range."""
        alpha = self.max_slip_when_stable
        if alpha is not None and not 0.001 <= alpha <= 0.5:
            raise ValueError("max_slip_when_stable must be 0.001..0.5")
        if self.warm_up < 0 or not 0.0 <= self.explore <= 1.0:
            raise ValueError("warm_up must not be negative, explore must be 0..1")


class RiskReport(msgspec.Struct, frozen=True, kw_only=True):
    """What lifts of `stable` verdicts came to, for those who decide whether to lift."""

    target: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] | None
    """`[risk] max_slip_when_stable`; null: none is set."""
    lifts: Count
    """Lifts of `stable` verdicts whose outcome was told."""
    slips: Count
    """Slips among them."""
    outstanding: Count
    """`stable` verdicts whose outcome can still come; each may add one slip to the bound."""
    bound: Annotated[float, msgspec.Meta(ge=0.0)] | None
    """What `slips` cannot exceed, but for `outstanding`; null: no risk is set."""
    warm_up_left: Count
    """Outcomes that are missing until the warm-up is over; 0 without a risk."""

    @property
    def beyond_share(self) -> float:
        """How many slips the bound allows beyond the target's share of the lifts; 0 without one."""
        if self.target is None or self.bound is None:
            return 0.0
        return self.bound - self.target * self.lifts


class RiskState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a rule knows; see the attributes of `Risk`."""

    max_slip_when_stable: float | None
    theta: float
    lifts: Count
    slips: Count
    overdue: Count
    proven: Count


class Risk:
    """The online rule: `stable` only at log-odds of at most theta, which each outcome moves.

    With a = `max_slip_when_stable`, N reported `stable` lifts and S slips among them:

        S <= a N + (start - LOWEST) / STEP + (1 - a) max(1, overdue)    at every moment.

    Proof. Each reported `stable` lift adds STEP (a - y) to theta, y = 1 for a slip, else 0; all
    else that is done to theta (at most 0, at most `start` on an exchange) lowers it. So after N
    lifts theta <= start + STEP (a N - S), or S <= a N + (start - theta) / STEP. It remains to
    bound theta from below. Let `overdue` be the `stable` outcomes taken since theta was last >=
    LOWEST; each lowered it by at most STEP (1 - a), so theta >= LOWEST - overdue STEP (1 - a),
    which gives the bound. As `stable` is only said while theta >= LOWEST, all but the first of
    them were out when theta fell below it: if every outcome is told before the next `stable`,
    overdue <= 1, and each `stable` lift whose outcome is still out can add at most one. Nothing
    is assumed of data, model, learner or labels.

    Only reported lifts are covered; `slips` counts what was told, true or not.
    """

    def __init__(self, limits: RiskLimits) -> None:
        """Start with no outcome known."""
        self.limits = limits
        alpha = limits.max_slip_when_stable
        # A probability of 2 a; from a quarter on any grasp that is likelier to hold than to slip.
        twice = 0.5 if alpha is None else min(2.0 * alpha, 0.5)
        self.start = max(math.log(twice / (1.0 - twice)), LOWEST)
        """Where theta starts, log-odds."""
        self.theta = self.start
        """Highest log-odds of slip that may be called `stable`."""
        self.lifts = 0
        """`stable` lifts whose outcome is known."""
        self.slips = 0
        """Slips among them."""
        self.overdue = 0
        """Outcomes of `stable` lifts that were taken since theta was last at `LOWEST` or above."""
        self.proven = 0
        """Outcomes of any lift since the start or the last exchange of a sensor."""

    @property
    def warm_up_left(self) -> int:
        """Outcomes that are missing until the warm-up is over."""
        return max(self.limits.warm_up - self.proven, 0)

    @property
    def bound(self) -> float | None:
        """What `slips` cannot exceed; each lift whose outcome is out adds one. None: no rule."""
        alpha = self.limits.max_slip_when_stable
        if alpha is None:
            return None
        late = (1.0 - alpha) * max(1, self.overdue)
        return alpha * self.lifts + (self.start - LOWEST) / STEP + late

    def decide(self, log_odds: float) -> Permission:
        """Whether a grasp with these log-odds of slip may be called `stable`."""
        if self.limits.max_slip_when_stable is None:
            return Permission.ALLOWED
        if self.theta < LOWEST:
            return Permission.RISK_EXCEEDED
        if log_odds <= self.theta:  # false for NaN
            return Permission.ALLOWED
        return Permission.UNPROVEN if self.warm_up_left else Permission.WITHHELD

    def supervised(self, permission: Permission, seed: str, grasp: int) -> bool:
        """Whether to ask for a lift under supervision; the same for the same seed and grasp."""
        if permission is Permission.UNPROVEN:
            return True
        explored = permission is Permission.WITHHELD and self.limits.explore > 0.0
        return explored and _draw(seed, grasp) < self.limits.explore

    def take(self, *, stable: bool, slipped: bool, proves: bool) -> None:
        """Take in an outcome, and whether the grasp had been called `stable`.

        `proves` is false for lifts with former sensors: they count, but not for the warm-up.
        """
        self.proven += proves
        if not stable:
            return
        self.lifts += 1
        self.slips += slipped
        alpha = self.limits.max_slip_when_stable
        if alpha is None:
            return
        self.theta = min(self.theta + STEP * (alpha - slipped), 0.0)
        self.overdue = 0 if self.theta >= LOWEST else self.overdue + 1

    def exchanged(self) -> None:
        """A sensor was exchanged: what was learned no longer counts, what slipped does."""
        self.theta = min(self.theta, self.start)
        self.proven = 0

    def state(self) -> RiskState:
        """What `restore` needs."""
        alpha = self.limits.max_slip_when_stable
        return RiskState(alpha, self.theta, self.lifts, self.slips, self.overdue, self.proven)

    def restore(self, state: RiskState) -> None:
        """Go on from an earlier state; with another risk than now, only the warm-up counts.

        Raises `ValueError`, and changes nothing, if no outcomes lead to such a state.
        """
        if state.max_slip_when_stable != self.limits.max_slip_when_stable:
            self.proven = state.proven
            return
        alpha = state.max_slip_when_stable or 0.0
        highest = min(self.start + STEP * (alpha * state.lifts - state.slips), 0.0)
        lowest = LOWEST - STEP * (1.0 - alpha) * state.overdue
        rounding = 1e-12 * (state.lifts + 10)
        moved = state.max_slip_when_stable is not None
        if state.slips > state.lifts or state.overdue > state.lifts:
            raise ValueError("counts more slips than lifts")
        if moved and not lowest - rounding <= state.theta <= highest + rounding:
            raise ValueError("has a threshold that these outcomes do not lead to")
        if not moved and (state.theta != self.start or state.overdue):
            raise ValueError("has a threshold without a risk")
        self.theta, self.lifts, self.slips = state.theta, state.lifts, state.slips
        self.overdue, self.proven = state.overdue, state.proven


def _draw(seed: str, grasp: int) -> float:
    """A number in 0..1 that looks random, of a grasp."""
    digest = hashlib.blake2b(f"{seed} {grasp}".encode(), digest_size=8).digest()
    return int.from_bytes(digest) / 2.0**64
