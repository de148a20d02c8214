"""The final word: from probability, health and gate to a verdict. Nothing else makes one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import msgspec
from msgspec.structs import replace

from daemon.judge.reasons import Decision, Reason
from daemon.trust.risk import Permission

WITHHELD: Final = {
    Permission.ALLOWED: None,
    Permission.WITHHELD: Reason.LOW_CONFIDENCE,
    Permission.UNPROVEN: Reason.UNPROVEN,
    Permission.RISK_EXCEEDED: Reason.RISK_EXCEEDED,
}
"""What is against calling a grasp `stable`, by what the risk permits."""


# Without slots, so that a default can be read from the class.
@dataclass(frozen=True)
class Limits:
    """What a verdict other than `unknown` must keep to."""

    max_age_ns: int = 100_000_000
    """Age of the reading at the end of judging, ns."""
    slip_threshold: float = 0.5
    """`p_slip` from here on is slip, in 0..1."""
    min_confidence: float = 0.0
    """Of what is judged, in 0..1: `p_slip` for slip, `1 - p_slip` for stable."""
    steady_ns: int = 1_000_000_000
    """A grasp that was judged otherwise is `stable` only when each judging of so long, ns, says so:
    some twenty. So nothing flickers at a threshold, and who asks on gets no lucky draw."""


class Case(msgspec.Struct, frozen=True, gc=False):
    """All that a verdict depends on."""

    p_slip: float | None
    """What the network says, 0..1; None if it was not asked or gave no number."""
    health: tuple[Reason, ...]
    """What speaks against the reading at hand, or against the one that was judged."""
    in_contact: bool
    """All required fingers touch."""
    settled: bool
    """The grasp has settled and keeps still."""
    gate: tuple[Reason, ...]
    """Why not, where one of both is missing."""
    age_ns: int
    """Of the reading, ns."""
    against_stable: Reason | None = None
    """Why it must not be called `stable`, whatever the network says; None: nothing is against."""
    doubt: Decision = Decision.STABLE
    """What it was judged to be within `steady_ns`, if that was not `stable`."""


class Doubt(msgspec.Struct, frozen=True, gc=False):
    """The latest judging by which a grasp was not `stable`."""

    grasp: int
    made_ns: int
    """Of the reading that was judged."""
    decision: Decision

    def on(self, case: Case, grasp: int, made_ns: int, limits: Limits) -> Case:
        """The case of a grasp at a reading, in which this still counts."""
        if grasp != self.grasp or made_ns - self.made_ns >= limits.steady_ns:
            return case
        return replace(case, doubt=self.decision)


NO_DOUBT = Doubt(0, 0, Decision.STABLE)
"""Grasps are numbered from 1."""


def alone(case: Case, limits: Limits) -> Decision:
    """What a judging says of a grasp, by itself, whatever the hand does since."""
    return decide(replace(case, in_contact=True, settled=True, age_ns=0), limits)[0]


def decide(case: Case, limits: Limits) -> tuple[Decision, tuple[Reason, ...]]:
    """Decision, and the reasons if it is unknown: whatever is not clearly well is unknown."""
    reasons = [*case.health]
    if not (case.in_contact and case.settled):
        reasons += case.gate or (Reason.MOVING,)
    if not 0 <= case.age_ns <= limits.max_age_ns:
        reasons.append(Reason.STALE)
    p_slip = case.p_slip
    if p_slip is not None and 0.0 <= p_slip <= 1.0:  # false for NaN
        slips = p_slip >= limits.slip_threshold or case.doubt is Decision.SLIP
        decision = Decision.SLIP if slips else Decision.STABLE
        confidence = p_slip if decision is Decision.SLIP else 1.0 - p_slip
        withheld = case.against_stable if decision is Decision.STABLE else None
        doubted = decision is Decision.STABLE and case.doubt is Decision.UNKNOWN
        if confidence < limits.min_confidence or (doubted and withheld is None):
            reasons.append(Reason.LOW_CONFIDENCE)
        if withheld is not None:
            reasons.append(withheld)
        if not reasons:
            return decision, ()
    return Decision.UNKNOWN, tuple(reasons) or (Reason.MODEL_FAILED,)
