"""The final word: from probability, health and gate to a verdict. Nothing else makes one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import msgspec

from daemon.judge.reasons import Decision, Moment, Reason
from daemon.trust.risk import Permission

WITHHELD: Final = {
    Permission.ALLOWED: None,
    Permission.WITHHELD: Reason.LOW_CONFIDENCE,
    Permission.UNPROVEN: Reason.UNPROVEN,
    Permission.RISK_EXCEEDED: Reason.RISK_EXCEEDED,
}
"""Why a grasp must not be called `stable`, by what the risk permits."""


# Without slots, so that a default can be read from the class.
@dataclass(frozen=True)
class Limits:
    """What a verdict other than `unknown` must keep to."""

    max_age_ns: int = 100_000_000
    """Age of the reading at the end of judging, ns."""
    slip_threshold: float = 0.5
    """`p_slip` from here on is slip, in 0..1."""
    min_confidence: float = 0.0
    """Least `p_slip` of a slip, or `1 - p_slip` of a stable grasp, in 0..1."""
    steady_ns: int = 1_000_000_000
    """A grasp that was judged otherwise is `stable` only after this long, ns, in which every
    judgement says so: some twenty. So nothing flickers at a threshold, and who asks on gets no
    lucky draw."""


class RecentVerdict(msgspec.Struct, frozen=True, gc=False):
    """The latest judgement by which a grasp was not `stable`."""

    grasp: int
    made_ns: int
    """Time of the reading that was judged."""
    decision: Decision

    def of(self, grasp: int, made_ns: int, limits: Limits) -> Decision:
        """Return what still counts against calling a grasp stable now; `stable`: nothing does."""
        if grasp != self.grasp or made_ns - self.made_ns >= limits.steady_ns:
            return Decision.STABLE
        return self.decision


NO_RECENT_VERDICT = RecentVerdict(0, 0, Decision.STABLE)
"""Grasps are numbered from 1."""
HELD: Final = Moment(0)
"""A hand that holds still."""


def without_gate(
    p_slip: float | None, objections: tuple[Reason, ...], withheld: Reason | None, limits: Limits
) -> Decision:
    """Return what a judgement says of a grasp by itself, whatever the hand does since."""
    return decide(p_slip, objections, HELD, 0, limits, withheld=withheld)[0]


def decide(
    p_slip: float | None,
    objections: tuple[Reason, ...],
    moment: Moment,
    age_ns: int,
    limits: Limits,
    *,
    withheld: Reason | None = None,
    recent: Decision = Decision.STABLE,
) -> tuple[Decision, tuple[Reason, ...]]:
    """Return the decision, and the reasons if it is unknown: all that is not clearly well is.

    `p_slip`: probability of slip, 0..1; None if the network gave none. `objections`: what speaks
    against the reading, or against the one that was judged. `age_ns`: age of the reading.
    `withheld`: why the grasp must not be called stable; None: it may. `recent`: what it was judged
    to be within `steady_ns`, if that was not stable.
    """
    reasons = [*objections]
    if not (moment.in_contact and moment.settled):
        reasons += moment.reasons or (Reason.MOVING,)
    if not 0 <= age_ns <= limits.max_age_ns:
        reasons.append(Reason.STALE)
    if p_slip is not None and 0.0 <= p_slip <= 1.0:  # false for NaN
        slips = p_slip >= limits.slip_threshold or recent is Decision.SLIP
        decision = Decision.SLIP if slips else Decision.STABLE
        confidence = p_slip if slips else 1.0 - p_slip
        withheld = None if slips else withheld
        doubted = recent is Decision.UNKNOWN and not slips
        if confidence < limits.min_confidence or (doubted and withheld is None):
            reasons.append(Reason.LOW_CONFIDENCE)
        if withheld is not None:
            reasons.append(withheld)
        if not reasons:
            return decision, ()
    return Decision.UNKNOWN, tuple(reasons) or (Reason.MODEL_FAILED,)
