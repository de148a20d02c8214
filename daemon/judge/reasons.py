"""Enumerations of a verdict: decisions, reasons for `unknown`, and states of the gate.

A new reason needs a member of `Reason`, a line of `ADVICE`, a line in deploy/wire/README.md, and
`graspd schema > deploy/wire/messages.schema.json`. The part that notices it adds it to the
`reasons` of its `Checked` or `Moment`; a `Refusal` of `GraspJudge` has the same text here. Any of
them makes the verdict `unknown`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from graspd.biotac import ELECTRODES, Finger


class Decision(StrEnum):
    """Decision about a grasp."""

    STABLE = "stable"
    SLIP = "slip"
    UNKNOWN = "unknown"


class Reason(StrEnum):
    """Why a verdict is `unknown`, or a part is not well; `ADVICE` says what to do about each."""

    STALE = "stale"
    SENSOR_MISSING = "sensor-missing"
    NOT_A_COUNT = "not-a-count"
    CUT_OFF = "cut-off"
    PARITY = "parity"
    ERROR_WORD = "error-word"
    HELD = "held"
    FROZEN = "frozen"
    SATURATED = "saturated"
    FLAT = "flat"
    NEVER_SEEN = "never-seen"
    ELECTRODES_BROKEN = "electrodes-broken"
    ELECTRODE_DEAD = "electrode-dead"
    ELECTRODE_JUMPS = "electrode-jumps"
    ELECTRODE_IMPLAUSIBLE = "electrode-implausible"
    NOT_TARED = "not-tared"
    NO_CONTACT = "no-contact"
    MOVING = "moving"
    SETTLING = "settling"
    SEQUENCE_GAP = "sequence-gap"
    JOINTS_LATE = "joints-late"
    JOINTS_FROZEN = "joints-frozen"
    NOT_ASKED = "not-asked"
    NOT_CALIBRATED = "not-calibrated"
    LOW_CONFIDENCE = "low-confidence"
    UNPROVEN = "unproven"
    RISK_EXCEEDED = "risk-exceeded"
    OUTCOME_TOLD = "outcome-told"
    NOT_KEPT = "not-kept"
    MODEL_MISMATCH = "model-mismatch"
    MODEL_FAILED = "model-failed"
    HEARD_LATE = "heard-late"
    """Only a problem in `health`, never a reason of a verdict."""


ADVICE: dict[Reason, str] = {
    Reason.STALE: "no fresh reading within the age limit: check cable, power and bus load",
    Reason.SENSOR_MISSING: "electrodes without a sample: check the finger's plug and chip select",
    Reason.NOT_A_COUNT: "values outside 0..4095: the recording or the sensor is broken",
    Reason.CUT_OFF: "the recording ends in the middle of a line: copy it again",
    Reason.PARITY: "words with bad parity: check the SPI wiring and clock",
    Reason.ERROR_WORD: "the sensor answers with error words: check the sampling delay",
    Reason.HELD: "values repeat an earlier sweep: wait for a fresh sweep",
    Reason.FROZEN: "a finger repeats a sweep to the count: power-cycle it; who sends old data?",
    Reason.SATURATED: "electrodes at 0 or 4095: a dead electrode or far too much force",
    Reason.FLAT: "a finger's electrodes read about the same: it touches nothing or does not work",
    Reason.NEVER_SEEN: "counts unlike all grasps of the training: check sensor, reset session",
    Reason.ELECTRODES_BROKEN: "too many electrodes to repair: check finger and plug",
    Reason.ELECTRODE_DEAD: "an electrode keeps its count: repaired; exchange the finger",
    Reason.ELECTRODE_JUMPS: "an electrode jumps alone: repaired; a loose contact in finger or plug",
    Reason.ELECTRODE_IMPLAUSIBLE: "an electrode contradicts the others: repaired; does it stay?",
    Reason.NOT_TARED: "where the fingers rest is not known yet: open the hand for two seconds",
    Reason.NO_CONTACT: "not all fingers touch: close the hand; or open it once, to tare",
    Reason.MOVING: "fingers or object move: wait until they are still",
    Reason.SETTLING: "still for too short a time yet: keep the hand as it is",
    Reason.SEQUENCE_GAP: "readings were lost, so motion is not known: check cable, bus and PC load",
    Reason.JOINTS_LATE: "joint angles are late: check their sender; soon judged without them",
    Reason.JOINTS_FROZEN: "no joint angle changes by a bit: restart their sender",
    Reason.NOT_ASKED: "settled; gate.mode is request: ask for a judgement",
    Reason.NOT_CALIBRATED: "the session has too few grasps: grasp more; if it is kept, "
    "`graspd session seed` also helps",
    Reason.LOW_CONFIDENCE: "too close to call for min_confidence or for [risk]: grasp again",
    Reason.UNPROVEN: "too few outcomes are known for [risk], or too many lifts have no outcome: "
    "lift under supervision, tell outcomes",
    Reason.RISK_EXCEEDED: "more `stable` lifts slipped than [risk] can make good: find out why, "
    "then `graspd session reset`",
    Reason.OUTCOME_TOLD: "the outcome of its lift is known: release the object, then grasp again",
    Reason.NOT_KEPT: "the lift cannot be noted on the disk: is it full, slow or read-only?",
    Reason.MODEL_MISMATCH: "the reading has other fingers than the model",
    Reason.MODEL_FAILED: "the network gave no probability: check the model file",
    Reason.HEARD_LATE: "subscribers receive messages late: check PC load; who floods the socket?",
}


OF_THE_HAND = frozenset(
    {Reason.NO_CONTACT, Reason.MOVING, Reason.SETTLING, Reason.NOT_TARED, Reason.NOT_ASKED}
)
"""Reasons of an open hand, or of a grasp that moves, settles or waits for a request."""


class Need(StrEnum):
    """Whether a person has to do something about a reason."""

    NORMAL = "normal"
    """Ordinary work."""
    WAIT = "wait"
    """It passes by itself, or with the next ordinary steps."""
    ACT = "act"


NEEDS = {
    Reason.NO_CONTACT: Need.NORMAL,
    Reason.NOT_ASKED: Need.NORMAL,
    Reason.LOW_CONFIDENCE: Need.NORMAL,
    Reason.OUTCOME_TOLD: Need.NORMAL,
    Reason.MOVING: Need.WAIT,
    Reason.SETTLING: Need.WAIT,
    Reason.NOT_TARED: Need.WAIT,
    Reason.NOT_CALIBRATED: Need.WAIT,
    Reason.UNPROVEN: Need.WAIT,
}
"""Need of each reason; of reasons that are not here, it is `Need.ACT`."""


def need_of(reasons: Iterable[Reason]) -> Need:
    """Return the most urgent need of several reasons; `NORMAL` without any."""
    needs = {NEEDS.get(reason, Need.ACT) for reason in reasons}
    return next((need for need in reversed(Need) if need in needs), Need.NORMAL)


UNREADABLE = frozenset(
    {
        Reason.STALE,
        Reason.SENSOR_MISSING,
        Reason.NOT_A_COUNT,
        Reason.CUT_OFF,
        Reason.PARITY,
        Reason.ERROR_WORD,
        Reason.HELD,
        Reason.FROZEN,
        Reason.SATURATED,
        Reason.ELECTRODES_BROKEN,
        Reason.MODEL_MISMATCH,
    }
)
"""Reasons for which the sensors cannot be read, so that the state of the hand is not known."""
FOLLOWING = {*NEEDS, Reason.JOINTS_LATE}
"""Reasons that cannot end while no readings come, so there is nothing to do about them then."""
_ORDER = {reason: (reason in NEEDS, place) for place, reason in enumerate(Reason)}
"""Sort key of each reason: as in `Reason`, but those that are not `Need.ACT` come last."""
WATCHED_LIFT = frozenset({Reason.LOW_CONFIDENCE, Reason.UNPROVEN})
"""Reasons that still permit a supervised lift; any other reason forbids it."""


def to_act_on(reasons: Iterable[Reason]) -> list[Reason]:
    """Return the reasons to show to a person, in the order in which to act on them.

    Reasons in `OF_THE_HAND` are left out while the sensors cannot be read.
    """
    shown = set(reasons)
    if not UNREADABLE.isdisjoint(shown):
        shown -= OF_THE_HAND
    return sorted(shown, key=_ORDER.__getitem__)


def parts_to_act_on(health: Mapping[str, Reason]) -> dict[Reason, list[str]]:
    """Return the parts with a problem by its reason, in the order in which to act on them.

    A finger's name stands for its electrodes if all 24 are listed. Reasons that only follow from
    a silent link or from such a finger are left out.
    """
    fingers: dict[str, list[Reason]] = {}
    for part, reason in health.items():
        finger, _, electrode = part.partition("_")
        if electrode:
            fingers.setdefault(finger, []).append(reason)
    unread = {finger for finger, reasons in fingers.items() if len(reasons) == ELECTRODES}
    is_silent = Reason.STALE in health.values()
    parts: dict[Reason, dict[str, None]] = {}
    for part, reason in health.items():
        finger, _, electrode = part.partition("_")
        follows = FOLLOWING if is_silent else OF_THE_HAND if finger in unread else ()
        if reason not in follows:
            name = finger if finger in unread else part
            parts.setdefault(reason, {})[name] = None
    return {reason: list(parts[reason]) for reason in sorted(parts, key=_ORDER.__getitem__)}


class GateState(StrEnum):
    """State of the gate: phase of the grasp."""

    IDLE = "idle"
    """Nothing touches."""
    CLOSING = "closing"
    """Some finger touches; not all do, or something moves, or too little time has passed."""
    SETTLED = "settled"
    """All fingers touch and are still; waits to be judged."""
    JUDGED = "judged"
    """The verdict stands, and is refreshed while readings confirm that the grasp is the same."""
    RELEASED = "released"
    """The last finger let go less than `gate.RELEASE_NS` ago; a new touch may follow."""


OPEN = frozenset({GateState.IDLE, GateState.RELEASED})
"""States of an open hand: no grasp lasts."""


class FingerState(StrEnum):
    """State of a finger in a word: free, in touch or sliding."""

    FREE = "free"
    """It does not touch."""
    TOUCH = "touch"
    """It touches, and its counts move no more than those of a finger that holds."""
    SLIDE = "slide"
    """It touches, and its counts move: the object slides, or the finger presses or lets go."""


class GateCause(StrEnum):
    """Why the gate changed its state."""

    CONTACT = "contact"
    STILL = "still"
    JUDGED = "judged"
    MOVED = "moved"
    CHANGED = "changed"
    """The grasp is no longer the one that was judged."""
    CONTACT_LOST = "contact-lost"
    GAP = "gap"
    """No usable reading for too long."""
    TIME = "time"


@dataclass(frozen=True, slots=True)
class GateChange:
    """A change of the gate's state."""

    t_ns: int
    """Time of the reading that caused it, ns."""
    grasp: int
    former: GateState
    state: GateState
    cause: GateCause


class Moment(NamedTuple):
    """State of the grasp at a reading. The defaults fit a daemon without a gate."""

    grasp: int
    """Number of the current grasp, from 1; 0 before the first."""
    state: GateState | None = None
    judges: bool = True
    """True if the network is to judge the grasp by this reading."""
    judged: bool = True
    """True for the first judgement after settling and, with `on_request`, the answer to a request.

    False: a refresh, or no judgement. Without a gate it is True for each reading, sound or not.
    """
    in_contact: bool = True
    """True if all required fingers touch."""
    settled: bool = True
    """True if the grasp has settled, was judged, and still keeps still."""
    reasons: tuple[Reason, ...] = ()
    """Why `settled` is false."""
    touching: tuple[Finger, ...] | None = None
    changes: tuple[GateChange, ...] = ()
    """Changes of the gate since the moment before, oldest first."""
    still_ms: float | None = None
    """Time for which the hand has touched and kept still, ms; None: not known."""
    early: bool = False
    """True if it was judged while something might still slide slowly."""
    steady: bool = True
    """True if motion is within the strict limit; only then a session learns from the reading."""
    motion: dict[Finger, float | None] | None = None
    """Motion of each finger, in units of its noise; None: not known."""
    motion_limits: dict[Finger, float] | None = None
    """Largest motion of each finger that counts as still, in the same units."""
    fingers: dict[Finger, FingerState | None] | None = None
    """State of each finger; None: not known."""
