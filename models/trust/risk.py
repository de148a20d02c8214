"""The risk rule: a budget of slips among `stable` lifts, which every outcome changes."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Final, NamedTuple

import msgspec

BUDGET_START: Final = 5.0
"""Number of slips beyond the allowed share that a session may have. With 3 a session is blocked
early; with 4 fewer good lifts are called `stable`."""
BUDGET_MAX: Final = 8.0
"""Largest budget, slips. It bounds the slips in every stretch of lifts."""
SHARE_YOUNG: Final = 1.5
"""Largest probability of slip called `stable` before any outcome, in units of the allowed share.
With a full budget the surest grasps slip much less often than the threshold says."""
SHARE_PROVEN: Final = 3.0
"""As `SHARE_YOUNG`, but from `PROVEN_FROM` outcomes on. With 3, seven in ten sessions keep to the
target. With 5, 3 to 6 % more good lifts are `stable`, but 54 % of sessions exceed it, not 29 %."""
PROVEN_FROM: Final = 40
"""Number of outcomes after which the learner knows the day."""
ROUNDING: Final = 1e-9
"""Tolerance of a budget, slips, because it is a rounded sum of shares."""

Count = Annotated[int, msgspec.Meta(ge=0)]


class Permission(StrEnum):
    """Whether a grasp may be called `stable`."""

    ALLOWED = "allowed"
    WITHHELD = "withheld"
    """The grasp is too likely to slip for the configured risk."""
    UNPROVEN = "unproven"
    """Too few outcomes are known, or too many announced lifts lack one. Lift under supervision."""
    RISK_EXCEEDED = "risk-exceeded"
    """More lifts slipped than the rule can make up for. Nothing is `stable` until a reset, or until
    earlier `stable` lifts are reported to have held."""


@dataclass(frozen=True, slots=True)
class RiskLimits:
    """Limits set by the user, within the ranges of the scene."""

    max_slip_when_stable: float | None = None
    """Share of the `stable` lifts that may slip, 0.001..0.5; None: no rule, all is allowed."""
    warm_up: int = 0
    """Outcomes, since the start or an exchange of a sensor, before which each grasp that is not
    `stable` is to be lifted under supervision."""
    explore: float = 0.0
    """Share, 0..1, of the withheld grasps to be lifted under supervision: only their outcomes show
    that the rule is too strict."""
    outstanding_max: int = 5
    """Most announced lifts without an outcome at one time, 1 or more."""


class RiskState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """State of a `Risk`: its attributes of these names, and the share of slips that was allowed."""

    max_slip_when_stable: float | None
    lifts: Count
    slips: Count
    proven: Count
    budget: float


class RiskOutcomes(NamedTuple):
    """Outcomes of `stable` lifts at one moment; `RiskReport` (daemon/publish) explains them."""

    target: float | None
    lifts: int
    slips: int
    outstanding: int
    bound: float | None
    warm_up_left: int
    announced: int
    awaited: int

    @property
    def beyond_share(self) -> float:
        """Slips that the bound allows beyond the target's share of the lifts; 0 without a bound."""
        if self.target is None or self.bound is None:
            return 0.0
        return self.bound - self.target * self.lifts


class Risk:
    """The online rule: `stable` only while a slip is affordable, and only for likely stable grasps.

    A lift is announced when its `lift` question is answered `stable`. With
    a = `max_slip_when_stable`, N `stable` lifts with an outcome, S slips among them, and
    M = `outstanding_max`:

        S <= a N + BUDGET_START                if each outcome is told before the next `stable`
        S <= a N + BUDGET_MAX                  then also in any stretch of lifts
        S <= a N + BUDGET_START + M (1 - a)    if each lift is announced; no outcome: a slip

    1. The outcome of a `stable` lift adds a - y to the budget b, y = 1 for a slip, 0 otherwise. The
       cap BUDGET_MAX and an exchange of sensors only lower b.
    2. Hence b <= BUDGET_START + a N - S, which is S <= a N + BUDGET_START - b.
    3. A stretch begins at b <= BUDGET_MAX. In the same way S <= a N + BUDGET_MAX - b for it.
    4. `stable` is said only while b >= 1 - a. If each outcome is told before the next `stable`,
       a slip leaves b >= 0. This gives the first two bounds.
    5. Let m announced lifts be out. w = b - m (1 - a) is what is left of b if all of them slip.
    6. An announced grasp was called `stable` at b >= 1 - a and m < M, itself not counted in m.
       Hence w >= -(M - 1) (1 - a) after its announcement.
    7. An outcome of an announced lift does not lower w: a slip takes 1 - a from b and 1 from m. The
       cap leaves b >= BUDGET_START, and m <= M. An exchange may lower b further; that only makes
       `stable` rarer, so the bounds with the higher b still hold.
    8. An announced lift that leaves the book without an outcome counts as a slip. Hence 6 holds at
       every moment.
    9. With the m lifts counted as slips, 2 is S <= a N + BUDGET_START - w: the third bound.
    10. Late outcomes of lifts without an announcement can leave b < 0; `bound` adds that.

    The threshold, the learner, the model and the data play no part: any threshold has these bounds.
    They count reported outcomes, true or not. It is a rule of online selective inference: Gibbs and
    Candes, arXiv 2106.00170; Humbert, Gazin, Heller and Roquain, arXiv 2508.10336.
    """

    def __init__(self, limits: RiskLimits) -> None:
        self.limits = limits
        self.budget = BUDGET_START
        """Number of slips that are affordable now, b."""
        self.lifts = 0
        """`stable` lifts whose outcome is known."""
        self.slips = 0
        """Slips among them."""
        self.proven = 0
        """Outcomes of any lift since the start or the last exchange of a sensor."""

    @property
    def warm_up_left(self) -> int:
        """Outcomes that are missing until the warm-up is over."""
        return max(self.limits.warm_up - self.proven, 0)

    @property
    def bound(self) -> float | None:
        """Upper bound of `slips`, to which lifts without an outcome may add. None: no rule."""
        alpha = self.limits.max_slip_when_stable
        if alpha is None:
            return None
        return alpha * self.lifts + BUDGET_START + max(-self.budget, 0.0)

    @property
    def threshold(self) -> float:
        """Highest log-odds of slip that may be called `stable` now; -inf: none; inf: no rule."""
        alpha = self.limits.max_slip_when_stable
        if alpha is None:
            return math.inf
        left = self.budget - (1.0 - alpha)
        if left <= ROUNDING:
            return -math.inf
        known = min(self.proven / PROVEN_FROM, 1.0)
        share = min(alpha * (SHARE_YOUNG + (SHARE_PROVEN - SHARE_YOUNG) * known), 0.5)
        odds = share / (1.0 - share) * left / (BUDGET_START - (1.0 - alpha))
        return min(math.log(odds), 0.0)

    def figures(self, outstanding: int, announced: int, awaited: int) -> RiskOutcomes:
        """Return the outcomes until now, with numbers of the lift book.

        `outstanding`: `stable` lifts without an outcome. `announced`: lifts that were announced.
        `awaited`: those of them without an outcome.
        """
        return RiskOutcomes(
            target=self.limits.max_slip_when_stable,
            lifts=self.lifts,
            slips=self.slips,
            outstanding=outstanding,
            bound=self.bound,
            warm_up_left=self.warm_up_left,
            announced=announced,
            awaited=awaited,
        )

    def decide(self, log_odds: float, awaited: int = 0) -> Permission:
        """Return whether a grasp with these log-odds of slip may be called `stable`.

        `awaited`: announced lifts of other grasps without an outcome.
        """
        threshold = self.threshold
        if threshold == math.inf:
            return Permission.ALLOWED
        if threshold == -math.inf:
            return Permission.RISK_EXCEEDED
        if not log_odds <= threshold:  # true for NaN
            return Permission.UNPROVEN if self.warm_up_left else Permission.WITHHELD
        return Permission.UNPROVEN if awaited >= self.limits.outstanding_max else Permission.ALLOWED

    def supervised(self, permission: Permission, seed: str, grasp: int) -> bool:
        """Return True to request a lift under supervision: of each unproven grasp, and of withheld
        ones with the probability `explore`, drawn by a hash of `seed` and `grasp`, its number."""
        if permission is not Permission.WITHHELD:
            return permission is Permission.UNPROVEN
        digest = hashlib.blake2b(f"{seed} {grasp}".encode(), digest_size=8).digest()
        return int.from_bytes(digest) / 2.0**64 < self.limits.explore

    def take(self, *, stable: bool, slipped: bool, proves: bool) -> None:
        """Take in an outcome. `stable`: True if the grasp had been called `stable`.

        `proves`: False for lifts with former sensors, which do not count for the warm-up.
        """
        self.proven += proves
        if not stable:
            return
        self.lifts += 1
        self.slips += slipped
        alpha = self.limits.max_slip_when_stable
        if alpha is not None:
            self.budget = min(self.budget + alpha - slipped, BUDGET_MAX)

    def take_untold(self) -> None:
        """Count an announced lift as a slip, because its outcome can no longer come; without
        `max_slip_when_stable` do nothing."""
        if self.limits.max_slip_when_stable is not None:
            self.take(stable=True, slipped=True, proves=False)

    def exchanged(self, proven: int = 0, budget: float | None = None) -> None:
        """Keep the slips but not the saved-up budget. Call when a sensor was exchanged.

        `proven`: number of known outcomes with the new sensors. `budget`: number of slips that were
        still allowed when they were last used; None: not known.
        """
        self.budget = min(self.budget, BUDGET_START)
        if budget is not None:  # not below the budget that follows from the counted slips
            self.budget = min(self.budget, max(budget, -float(self.slips)))
        self.proven = proven

    def state(self) -> RiskState:
        """Return what `restore` needs."""
        alpha = self.limits.max_slip_when_stable
        return RiskState(alpha, self.lifts, self.slips, self.proven, self.budget)

    def restore(self, state: RiskState) -> None:
        """Continue from an earlier state; with another `max_slip_when_stable`, take only `proven`.

        Raises `ValueError`, and changes nothing, if no outcomes lead to such a state.
        """
        alpha = state.max_slip_when_stable
        if alpha != self.limits.max_slip_when_stable:
            self.proven = state.proven
            return
        if state.slips > state.lifts:
            raise ValueError("counts more slips than lifts")
        earned = 0.0 if alpha is None else alpha * state.lifts - state.slips
        highest = min(BUDGET_START + earned, BUDGET_MAX)
        rounding = ROUNDING * (state.lifts + 1)
        if not -float(state.slips) <= state.budget <= highest + rounding:  # also true for NaN
            raise ValueError("has a budget that these outcomes do not lead to")
        self.budget, self.lifts, self.slips = state.budget, state.lifts, state.slips
        self.proven = state.proven
