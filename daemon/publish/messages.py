"""The messages on the wire, version 1, as JSON objects without NaN.

`graspd schema` prints their JSON Schema; golden messages stand in `tests/daemon/publish/golden/`.
Fields are only ever added; `v` changes when a meaning does.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec.structs import replace

from graspd.biotac import Finger
from graspd.daemon.judge.reasons import Decision, FingerState, GateCause, GateState, Reason
from graspd.daemon.trust.lift_book import OutcomeStatus

WIRE_VERSION: Final = 1

Count = Annotated[int, msgspec.Meta(ge=0)]
Duration = Annotated[float, msgspec.Meta(ge=0.0)]
Probability = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
OBJECT_PATTERN: Final = r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}"
"""Pattern of an object's name; safe as a word of a message and as a cell of a CSV file."""
ObjectName = Annotated[str, msgspec.Meta(pattern=rf"^{OBJECT_PATTERN}$(?!\n)")]
_HAND = msgspec.Meta(max_length=5)
Motion = Annotated[dict[Finger, Duration | None], _HAND]


DECISION_CODE: dict[Decision, Literal[0, 1, 2]] = {
    Decision.UNKNOWN: 0,
    Decision.STABLE: 1,
    Decision.SLIP: 2,
}
"""Number of each decision, for plotting tools, which skip text."""


Owner = Literal["you", "another"]
"""Owner of a grasp: `you`, the peer that asks, or `another`, also if the asker may not lift."""


class _Message(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """First fields of every message."""

    v: Literal[1] = WIRE_VERSION
    boot_id: str
    """Identifies this start of the daemon, from which `seq` and `grasp` count."""
    seq: Count
    """Number of the message in its topic. A gap is a loss; for `tactile` it may be the rate limit.
    """
    t: float
    """Wall-clock time, seconds since 1970, for plots and people only."""
    t_mono_ns: Count
    """Monotonic time, ns."""


class RiskReport(msgspec.Struct, frozen=True):
    """Outcomes of `stable` lifts so far, for a controller that decides to lift."""

    target: Probability | None
    """`[risk] max_slip_when_stable`; null: none is set."""
    lifts: Count
    """Lifts of `stable` verdicts whose outcome was told."""
    slips: Count
    """Slips among them."""
    outstanding: Count
    """`stable` verdicts whose outcome can still come; each may add one slip to the bound."""
    bound: Annotated[float, msgspec.Meta(ge=0.0)] | None
    """Upper bound of `slips` without `outstanding`; null: no risk is set."""
    warm_up_left: Count
    """Outcomes that are missing until the warm-up is over; 0 without a risk."""
    announced: Count = 0
    """`lift` questions that were answered `stable`, one a grasp."""
    awaited: Count = 0
    """Announced lifts without an outcome yet. At `[risk] outstanding_max` no other is `stable`."""


class Verdict(_Message, frozen=True, kw_only=True):
    """The verdict on the grasp by one reading, on topic `verdict.<hand>`."""

    t_mono_ns: Count
    """Monotonic time, ns, of the reading's last byte; before the first reading, of the start."""
    grasp: Count
    """Number of the grasp, from 1 (with gate mode `every`, of the reading); 0 before the first."""
    verdict: Decision
    verdict_code: Literal[0, 1, 2]
    """0 unknown, 1 stable, 2 slip."""
    p_slip: Probability | None
    """Probability of slip; null exactly when the verdict is `unknown`."""
    valid: bool
    """False exactly when the verdict is `unknown`."""
    reasons: list[Reason]
    """Why it is `unknown`; empty otherwise."""
    age_ms: Duration
    """Time from `t_mono_ns` to this message, ms."""
    latency_us: Duration
    """Time from the reading's arrival in the daemon to this message, us."""
    repaired: Annotated[list[str], msgspec.Meta(max_length=120)] = []
    """Electrodes whose counts were replaced by an estimate from the others, such as `ff_7`."""
    session_calibrated: bool | None = None
    """False: the session has too few grasps, so the verdict is less sure; null: no session."""
    judged: bool = True
    """True for a grasp's first judgement and for the answer to a question.

    False: the verdict confirms or refreshes the last one, or is `unknown`.
    """
    gate: GateState | None = None
    """Null: each reading is a grasp of its own."""
    contact: Annotated[list[Finger], msgspec.Meta(max_length=5)] | None = None
    """Fingers that touch; null with a null `gate`."""
    silence_ms: Duration
    """Time without a message after which a subscriber must take the grasp for unknown, ms."""
    model: str
    model_sha: str
    """First 12 hex digits of the model file's SHA-256."""
    p_slip_model: Probability | None = None
    """Probability of slip by the network alone, without outcomes; null exactly when `p_slip` is."""
    outcomes: Count = 0
    """Number of outcomes that `p_slip` has learned from, since the start of the session."""
    supervised: bool = False
    """True: lift under supervision, whatever the verdict, and tell the outcome, to teach."""
    risk: RiskReport | None = None
    """State of the risk; null: without learning and without a risk."""
    early: bool = False
    """True: something might still slide slowly; a surer verdict follows.

    An `unknown` has it only if it is `supervised`.
    """
    still_ms: Duration | None = None
    """Time for which the hand has kept still, ms; null with a null `gate`.

    From 100 on nothing moves fast, from 240 on nothing slides; 0 while something moves.
    """
    motion: Motion | None = None
    """Motion of each finger, in units of its noise; null: not known, or nothing touches."""
    motion_limits: Annotated[dict[Finger, Duration], _HAND] | None = None
    """Largest motion of each finger that counts as still, in the same units."""
    fingers: Annotated[dict[Finger, FingerState | None], _HAND] | None = None
    """State of each finger; null: not known. Null with a null `gate`."""
    owner: Owner | msgspec.UnsetType = msgspec.UNSET
    """Peer that owns the grasp; only in an answer to `lift` by which a hand may lift."""


class GateMessage(_Message, frozen=True, kw_only=True):
    """The gate changed its state, on topic `gate.<hand>`; comes before the reading's verdict."""

    t_mono_ns: Count
    """Monotonic time, ns, of the last byte of the reading that made the change."""
    grasp: Count
    former: GateState
    state: GateState
    cause: GateCause
    still_ms: Duration | None = None
    """Value in the verdict of the reading that made the change; null: no reading made it."""
    motion: Motion | None = None
    """Value in the same verdict, as `still_ms`."""
    motion_limits: Annotated[dict[Finger, Duration], _HAND] | None = None
    """Value in the same verdict, as `still_ms`."""


class Tactile(_Message, frozen=True, kw_only=True):
    """A reading as judged, on topic `tactile.<hand>`; comes before its verdict.

    Sent only while a peer subscribes to it.
    """

    t_mono_ns: Count
    """Monotonic time, ns, of the reading's last byte, as in its verdict."""
    fingers: Annotated[list[Finger], msgspec.Meta(max_length=5)]
    counts: Annotated[list[Annotated[list[Count], msgspec.Meta(max_length=24)]], _HAND]
    """Counts 0..4095 of electrodes 1 to 24 of each finger, as read, without repair."""
    faults: Annotated[list[Annotated[list[Count], msgspec.Meta(max_length=24)]], _HAND]
    """Faults of each electrode, 0 if it is well. Bits: 1 missing, 2 not a count, 4 parity, 8 error
    word, 16 held, 32 cut off."""
    joints: dict[str, float] = {}
    """Newest angle of each joint that has one, rad; none older than 0.15 s."""


class OutcomeMessage(_Message, frozen=True, kw_only=True):
    """How a lift ended, as the controller has told it, on topic `outcome.<hand>`."""

    t_mono_ns: Count
    """Monotonic time, ns, when the controller told it."""
    grasp: Count
    """Number of the grasp in the verdict that permitted the lift."""
    outcome: Literal["stable", "slip"]
    object: ObjectName | None = None
    """Name of the lifted object; null: not told."""
    grasp_boot_id: str | None = None
    """`boot_id` of the earlier start in which the grasp was judged; null: this start."""


class State(StrEnum):
    """State of the daemon."""

    RUNNING = "running"
    SILENT = "silent"
    """No reading arrives; every verdict is `unknown`."""
    STOPPING = "stopping"


class Lifts(msgspec.Struct, frozen=True, kw_only=True):
    """Outcomes of the `stable` grasps since the risk was set."""

    reported: Count
    """Lifts whose outcome was told."""
    outstanding: Count
    """Grasps whose outcome can still come."""
    unreported: Count
    """Grasps forgotten before an outcome came.

    With a risk, announced ones count as slips; no bound covers the others.
    """
    announced: Count = 0
    """Grasps for which a `lift` question was answered `stable`."""
    awaited: Count = 0
    """Announced grasps whose outcome is not told yet."""
    covered: bool | None = None
    """False: no lift was announced, so the risk covers only lifts whose outcome was told.

    Null: no risk is set.
    """


class LearnerHealth(msgspec.Struct, frozen=True, kw_only=True):
    """State of the learner."""

    enabled: bool
    """`[learn] enabled`."""
    outcomes: Count
    """Outcomes learned from since the start of the session."""
    told: dict[OutcomeStatus, Count]
    """Outcomes told since the start of the session, by their status; without zeros."""
    uncertainty: Probability
    """Share of the first uncertainty that is left: 1 at the start, towards 0 with outcomes."""


class Status(_Message, frozen=True, kw_only=True):
    """How the daemon is, once a second even when idle, on topic `status.<hand>`."""

    t_mono_ns: Count
    """Monotonic time, ns, of this message."""
    state: State
    readings_hz: Duration
    """Tactile readings per second since the last status."""
    verdicts: dict[Decision, Count]
    """Verdicts since start, by decision."""
    reasons: dict[Reason, Count]
    """Reasons given since start; only those that occurred."""
    drivers: dict[str, dict[str, Count]]
    """Counters of each driver, by driver name."""
    repaired: Annotated[dict[str, Count], msgspec.Meta(max_length=120)] = {}
    """Number of repairs of each electrode since start; without zeros."""
    session_grasps: Count | None = None
    """Grasps that the session has learned from; null: the model has no session."""
    session_calibrated: bool | None = None
    """True if these grasps are enough; null: the model has no session."""
    gate: GateState | None = None
    """Null: each reading is a grasp of its own."""
    tared: Annotated[list[Finger], msgspec.Meta(max_length=5)] | None = None
    """Fingers whose resting counts are known; null with a null `gate`."""
    health: Annotated[dict[str, Reason], msgspec.Meta(max_length=130)] = {}
    """Current problems: `ff_7`, `ff`, `link`, `joints`, `model` or `session`, and why."""
    latency_us: dict[Literal["p50", "p99", "max"], Duration]
    """Time from reading to verdict since start; all zero before the first verdict."""
    jitter_us: dict[Literal["p50", "p99", "max"], Duration] = {}
    """Difference of the time between two readings and the driver's period; empty: not known."""
    late_readings: Count = 0
    """Readings since start whose verdict came more than a period after their last byte."""
    worst_age_ms: Duration = 0.0
    """Longest time since start from a reading's last byte to its verdict, ms."""
    skipped_readings: Count = 0
    """Readings since start that were not judged because newer ones were there already."""
    overloaded: bool = False
    """True if readings come faster than they are judged, or did within the last five seconds."""
    lifts: Lifts | None = None
    """Null: without learning and without a risk."""
    learner: LearnerHealth | None = None
    """Null: without learning and without a risk."""
    model: str
    model_sha: str
    versions: dict[str, str]


Message = Verdict | GateMessage | Tactile | OutcomeMessage | Status
MESSAGES: Final[dict[str, type[Message]]] = {
    "verdict": Verdict,
    "gate": GateMessage,
    "tactile": Tactile,
    "outcome": OutcomeMessage,
    "status": Status,
}
"""Type of each message, by the first part of its topic."""

encode = msgspec.json.Encoder().encode
"""Return the JSON payload of a message."""


def withheld(verdict: Verdict, *reasons: Reason) -> bytes:
    """Return the JSON of a verdict, changed to `unknown` for these reasons, not `supervised`."""
    unsure = replace(verdict, verdict=Decision.UNKNOWN, verdict_code=0, reasons=[*reasons])
    without = replace(unsure, p_slip=None, p_slip_model=None, valid=False, judged=False)
    return encode(replace(without, supervised=False, early=False))


decode_outcome = msgspec.json.Decoder(OutcomeMessage).decode
"""Decode the payload of an outcome. Raises `ValueError`."""


def schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of all messages, by name in `$defs`."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "graspd wire messages, version 1",
        "anyOf": [{"$ref": f"#/$defs/{message.__name__}"} for message in MESSAGES.values()],
        "$defs": msgspec.json.schema_components(MESSAGES.values())[1],
    }
