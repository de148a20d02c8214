"""The limits of each part with their defaults, and the final word: nothing else makes a verdict.

A scene's `[gate]` takes its defaults from the limits here, in its own units.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import msgspec

from graspd.daemon.judge.reasons import Decision, Moment, Reason
from graspd.daemon.trust.risk import Permission
from graspd.models.contract import Finger

MEDIAN_SWEEPS: Final = 3
WITHHELD: Final = {
    Permission.ALLOWED: None,
    Permission.WITHHELD: Reason.LOW_CONFIDENCE,
    Permission.UNPROVEN: Reason.UNPROVEN,
    Permission.RISK_EXCEEDED: Reason.RISK_EXCEEDED,
}
"""Why a grasp must not be called `stable`, by what the risk permits."""


# Without slots, so that a default can be read from the class.
@dataclass(frozen=True)
class ContactLimits:
    """What a touch is: the larger of both, for the third deepest electrode of a finger."""

    counts: float = 20.0
    """Fall below the baseline, counts. In 9.8 s of three untouched sensors it was 10 at most; from
    24 on a touch of three electrodes was always seen there (thresholds were 20 to 22)."""
    sigmas: float = 5.0
    """The same in standard deviations of the finger's median electrode."""


@dataclass(frozen=True)
class GateLimits:
    """When a grasp has settled, and when it is another one. Times in ns, counts raw."""

    false_alarms: float = 0.03
    """Share of the sweeps of a settled hand that holds in which it may be said to move. Until it
    has settled the limit is stricter. The larger, the slower the slides that are seen:
    deploy/JUDGING.md."""
    early: bool = False
    """True if a grasp is judged as soon as fast motion is excluded, and again when slow slides
    are."""
    change_counts: float = 40.0
    """Mean distance of a finger's electrodes from where they were judged, above which it is another
    grasp."""
    gap_ns: int = 100_000_000
    """Time without a usable reading after which the grasp must settle again."""
    release_ns: int = 100_000_000
    """How long the gate stays in `released` before `idle`, ns."""
    request_ns: int = 1_000_000_000
    """Time after which a request that cannot be met is dropped."""


@dataclass(frozen=True)
class JointLimits:
    """When joints keep still, and how long they are waited for."""

    rad_per_s: float = 0.1
    """A joint that turns faster is moving. One count of a Hall sensor is 0.0006 rad, so noise in
    a window shows up to 0.02."""
    window_ns: int = 80_000_000
    """Speed is the difference to angles that are at least this old, ns."""
    late_ns: int = 150_000_000
    """Angles that are older than this speak against settling, ns ..."""
    lost_ns: int = 1_000_000_000
    """... until they are this old, ns: then the stream is lost, and judging goes on without it."""
    frozen_ns: int = 1_000_000_000
    """Angles of which none changes by a bit for this long, ns, are old ones, sent again. A
    Hall sensor's noise is one count, so even a single joint changes many times in it."""


@dataclass(frozen=True)
class HandLimits:
    """All conditions of the moment before the lift."""

    on_request: bool = False
    """True if a settled grasp is judged only when the controller asks."""
    sweeps: int = MEDIAN_SWEEPS
    """What is judged: 1, the reading at hand; 3, the median of three fresh sweeps."""
    required: tuple[Finger, ...] | None = None
    """Fingers that must touch; all unless given."""
    contact: ContactLimits = field(default_factory=ContactLimits)
    gate: GateLimits = field(default_factory=GateLimits)
    joints: JointLimits | None = None
    """None for a hand without joint angles."""


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
    """A grasp that was judged otherwise is `stable` only once all judgements have said so for this
    long, ns: nothing flickers at a threshold, and asking often does not help."""


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
"""A hand that holds still: what a judgement says of a grasp by itself, whatever follows."""


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
