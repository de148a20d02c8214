"""The limits of each part with their defaults, and `decide`, which alone makes a verdict. A scene's
`[gate]` takes its defaults from the limits here, in its own units."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import msgspec

from graspd.biotac import Finger
from graspd.daemon.judge.reasons import Decision, Moment, Reason
from graspd.models.trust.risk import Permission

WITHHELD: Final = {
    Permission.ALLOWED: None,
    Permission.WITHHELD: Reason.LOW_CONFIDENCE,
    Permission.UNPROVEN: Reason.UNPROVEN,
    Permission.RISK_EXCEEDED: Reason.RISK_EXCEEDED,
}
"""Reason against calling a grasp `stable`, by what the risk permits; None: no reason."""
JOINTS_LATE_NS: Final = 150_000_000
"""Age of joint angles above which a grasp cannot settle, ns."""


# Without slots, so that a default can be read from the class.
@dataclass(frozen=True)
class GateLimits:
    """Limits of the gate that a scene may set."""

    false_alarms: float = 0.03
    """Share of sweeps, between 0 and 0.5, in which a hand that holds still may count as moving.

    A larger share lets slower slides be seen: deploy/JUDGING.md. Until the hand has settled the
    limit of motion is stricter.
    """
    early: bool = False
    """True: judge once fast motion is excluded, and again once slow slides are excluded.
    False: judge only once both are."""
    request_ns: int = 1_000_000_000
    """Time after which an unanswered request to judge is dropped, ns."""


@dataclass(frozen=True)
class HandLimits:
    """Limits of a hand's grasp: which fingers must touch, and how still they must keep."""

    on_request: bool = False
    """True if the first judgement of a settled grasp waits until the controller asks."""
    required: tuple[Finger, ...] | None = None
    """Fingers that must touch. None: all."""
    gate: GateLimits = field(default_factory=GateLimits)
    joints: bool = False
    """True if the hand sends joint angles, which must keep still too."""


# Without slots, so that a default can be read from the class.
@dataclass(frozen=True)
class Limits:
    """Limits by which a verdict is `stable`, `slip` or `unknown`."""

    max_age_ns: int = 100_000_000
    """Largest age of the reading at the end of judging, ns."""
    slip_threshold: float = 0.5
    """Smallest `p_slip` that is judged `slip`, 0..1."""
    min_confidence: float = 0.0
    """Smallest `p_slip` of a `slip`, and smallest `1 - p_slip` of a `stable`, 0..1."""
    steady_ns: int = 1_000_000_000
    """Time after a judgement that was not stable before the same grasp may be `stable`, ns.

    The verdict then does not flicker at a threshold, and asking often does not help.
    """


class HoldDown(msgspec.Struct, frozen=True, gc=False):
    """A judgement that was not `stable`: until `until_ns`, its grasp may not be called `stable`."""

    grasp: int
    until_ns: int
    """Time of the first reading to which it no longer applies, ns."""
    decision: Decision

    def at(self, grasp: int, made_ns: int) -> HoldDown:
        """Return itself if it applies to this `grasp` at `made_ns`, else `NOTHING_HELD`."""
        return self if grasp == self.grasp and made_ns < self.until_ns else NOTHING_HELD

    def allows(self, decision: Decision) -> bool:
        """Return False if `decision` is `stable` and that of this judgement is not."""
        return decision is not Decision.STABLE or self.decision is Decision.STABLE


NOTHING_HELD: Final = HoldDown(0, 0, Decision.STABLE)
"""Stands for no hold-down: it allows every decision. Grasps are numbered from 1."""
HELD: Final = Moment(0)
"""Moment of a hand that holds still: `decide` finds nothing in it against a verdict."""


def decide(
    p_slip: float | None,
    objections: tuple[Reason, ...],
    moment: Moment,
    age_ns: int,
    limits: Limits,
    *,
    withheld: Reason | None = None,
    held: HoldDown = NOTHING_HELD,
) -> tuple[Decision, tuple[Reason, ...]]:
    """Return the decision, and the reasons if it is `unknown`. Any doubt makes it `unknown`.

    `p_slip`: probability of slip, 0..1; None: the network gave none. `objections`: reasons against
    this reading, or against the earlier one that the network judged. `moment`: state of the grasp.
    `age_ns`: age of the reading. `withheld`: why the risk forbids `stable`; None: it does not.
    `held`: an earlier judgement; if it was not `stable`, its decision takes the place of `stable`.
    """
    reasons = [*objections]
    if not (moment.in_contact and moment.settled):
        reasons += moment.reasons or (Reason.MOVING,)
    if not 0 <= age_ns <= limits.max_age_ns:
        reasons.append(Reason.STALE)
    if p_slip is not None and 0.0 <= p_slip <= 1.0:  # false for NaN
        decision = Decision.SLIP if p_slip >= limits.slip_threshold else Decision.STABLE
        if not held.allows(decision):
            decision = held.decision
        slips, doubted = decision is Decision.SLIP, decision is Decision.UNKNOWN
        confidence = p_slip if slips else 1.0 - p_slip
        withheld = None if slips else withheld
        if confidence < limits.min_confidence or (doubted and withheld is None):
            reasons.append(Reason.LOW_CONFIDENCE)
        if withheld is not None:
            reasons.append(withheld)
        if not reasons:
            return decision, ()
    return Decision.UNKNOWN, tuple(reasons) or (Reason.MODEL_FAILED,)
