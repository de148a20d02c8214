"""What each part of the judge finds in one reading, in the order in which the reading comes to it.

    health -> Watched -> grip -> Felt -> plausibility -> Examined -> network -> Opinion -> decision

Each is a value: the next part needs nothing else of those before it. Those that most readings have
are structs or tuples, which take a fifth of the time of a frozen dataclass to make.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon.judge.decision import NO_DOUBT, Doubt
from daemon.judge.reasons import GateChange, GateState, Reason
from daemon.trust.trust import Assessment
from models.contract import Finger

Number = Annotated[int, msgspec.Meta(ge=0, le=1 << 62)]
"""Of readings or grasps so far; bounded, for a part's memory may come from a recording."""


@dataclass(frozen=True, slots=True, eq=False)
class Watched:
    """What is wrong with a reading and its electrodes."""

    reasons: tuple[Reason, ...]
    """Against using it at all."""
    broken: NDArray[np.bool_]
    """Shape (fingers, 24): electrodes that mean nothing in it."""


class Felt(NamedTuple):
    """Where in a grasp the hand is; the defaults are those of a reading that is a grasp itself."""

    grasp: int
    """Number of the grasp at hand."""
    counts: NDArray[np.uint16] | None
    """Shape (fingers, 24): what is to be judged; None if nothing is, for now."""
    judged: bool = True
    """Whether this very reading is one to judge, sound or not, and not only to judge anew."""
    in_contact: bool = True
    """Whether all required fingers touch."""
    settled: bool = True
    """Whether the grasp has settled, was judged, and still keeps still."""
    reasons: tuple[Reason, ...] = ()
    """Why it has not."""
    gate: GateState | None = None
    touching: tuple[Finger, ...] | None = None
    """Fingers that touch."""
    changes: tuple[GateChange, ...] = ()
    """What the gate did since it was asked last, oldest first."""
    still_ns: int | None = None
    """For how long the hand has touched and kept still."""
    early: bool = False
    """Whether it was judged while something might still slide slowly."""
    motion: dict[Finger, float | None] | None = None
    """How each finger moves, in units of its noise; None where that is not known."""
    motion_limits: dict[Finger, float] | None = None
    """What it may be at most for a finger that is still."""


class Examined(msgspec.Struct, frozen=True, eq=False, gc=False):
    """Whether counts look like a grasp of the training, with what was broken repaired."""

    reasons: tuple[Reason, ...]
    """Against judging it; none if it is sound, or has been repaired."""
    counts: NDArray[np.generic]
    """Shape (fingers, 24), with the broken electrodes repaired; as read where there are reasons."""
    repaired: tuple[str, ...] = ()
    """Electrodes that were replaced, such as `ff_7`."""
    grasp: NDArray[np.generic] | None = None
    """Shape (fingers, 24): what a session may take in, even if it is like nothing that was seen
    before, because that is how a drifted sensor starts. Only electrodes that are certainly broken
    are repaired in it. None where the reading tells nothing."""


class Opinion(msgspec.Struct, frozen=True, gc=False):
    """What the network said of a grasp, and what stands against its being asked."""

    p_slip: float | None
    """Probability of slip as the network says it, softened as far as its session is young."""
    reasons: tuple[Reason, ...]
    repaired: tuple[str, ...] = ()
    margin: float = 0.0
    """The network's log-odds of slip, before softening; 0 where it was not asked."""
    assessment: Assessment | None = None
    """What `p_slip` is worth by the outcomes that are known; None where nobody asks."""


NO_OPINION = Opinion(None, ())


@dataclass(slots=True, eq=False)
class PipelineMemory:
    """What is known of the grasps judged so far."""

    to_learn: NDArray[np.float64]
    """Shape (fingers, 24): counts that the session is to take in; means nothing if none are."""
    is_to_learn: bool = False
    to_learn_slip: bool | None = None
    """Whether they were judged to slip."""
    readings: Number = 0
    learnt_grasp: Number = 0
    """The grasp that the session took in last, or is about to."""
    opinion: Opinion = NO_OPINION
    """Of the grasp at hand."""
    doubt: Doubt = NO_DOUBT


def any_of(which: NDArray[np.bool_]) -> bool:
    """Whether any is true. To search the bytes takes a tenth of the time of `which.any()`."""
    return 1 in which.tobytes()


def all_of(which: NDArray[np.bool_]) -> bool:
    """Whether all are true, as quickly."""
    return 0 not in which.tobytes()


def electrode_name(finger: Finger, place: int) -> str:
    """Such as `ff_7`, of the electrode at place 6 of 0..23."""
    return f"{finger}_{place + 1}"
