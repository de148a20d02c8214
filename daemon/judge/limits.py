"""When a grasp touches, keeps still and is judged: each limit with its default, stated only here.

A scene's `[gate]` takes its defaults from these classes, in its own units; what a verdict must keep
to stands beside the rule, in `decision.Limits`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from models.contract import Finger

MEDIAN_SWEEPS = 3


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
    """Share of the sweeps of a hand that holds in which it may be said to move. A slower slide is
    told from a held touch by a larger share; deploy/JUDGING.md has the curve."""
    early: bool = False
    """Whether a grasp is judged as soon as fast motion is excluded, and again when slow slides
    are."""
    change_counts: float = 40.0
    """A finger whose electrodes are so far from where they were judged, in the mean, is another
    grasp."""
    gap_ns: int = 100_000_000
    """After so long without a usable reading the grasp must settle anew."""
    release_ns: int = 100_000_000
    """`released` lasts so long."""
    request_ns: int = 1_000_000_000
    """A request that cannot be met by then is dropped."""


@dataclass(frozen=True)
class JointLimits:
    """When joints keep still, and how long they are waited for."""

    rad_per_s: float = 0.1
    """A joint that turns faster is moving. One count of a Hall sensor is 0.0006 rad, so noise in
    a window shows up to 0.02."""
    window_ns: int = 80_000_000
    """Speed is the difference to the angles at least so long ago, ns."""
    late_ns: int = 150_000_000
    """Angles that are older than this speak against settling, ns ..."""
    lost_ns: int = 1_000_000_000
    """... until they are this old, ns: then the stream is lost, and judging goes on without it."""
    frozen_ns: int = 1_000_000_000
    """When none of them has changed by a bit for so long, ns, somebody repeats old ones. A Hall
    sensor's noise is one count, so that even a single joint changes many times in it."""


@dataclass(frozen=True)
class HandLimits:
    """All conditions of the moment before the lift."""

    on_request: bool = False
    """Whether a settled grasp is judged only when somebody asks."""
    sweeps: int = MEDIAN_SWEEPS
    """What is judged: 1, the reading at hand; 3, the median of three fresh sweeps."""
    required: tuple[Finger, ...] | None = None
    """Fingers that must touch; all unless given."""
    contact: ContactLimits = field(default_factory=ContactLimits)
    gate: GateLimits = field(default_factory=GateLimits)
    joints: JointLimits | None = None
    """None for a hand without joint angles."""
