"""The messages on the wire, version 1, as JSON objects without NaN.

`graspd schema` prints their JSON Schema; golden messages stand in `tests/daemon/publish/golden/`.
Fields are only ever added; `v` changes when a meaning does.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, Final, Literal

import msgspec

from graspd.daemon.judge.reasons import Decision, FingerState, GateCause, GateState, Reason
from graspd.daemon.trust.lift_book import OutcomeStatus
from graspd.daemon.trust.risk import RiskReport
from graspd.models.contract import Finger

WIRE_VERSION: Final = 1

Count = Annotated[int, msgspec.Meta(ge=0)]
Duration = Annotated[float, msgspec.Meta(ge=0.0)]
Probability = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
OBJECT_PATTERN: Final = r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}"
"""One word of a message and bare cell of a CSV file; no formula, no path."""
ObjectName = Annotated[str, msgspec.Meta(pattern=rf"^{OBJECT_PATTERN}$(?!\n)")]
_HAND = msgspec.Meta(max_length=5)
Motion = Annotated[dict[Finger, Duration | None], _HAND]


DECISION_CODE: dict[Decision, Literal[0, 1, 2]] = {
    Decision.UNKNOWN: 0,
    Decision.STABLE: 1,
    Decision.SLIP: 2,
}
"""The same as a number, because plotting tools draw numbers and skip text."""


class _Message(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """How every message begins."""

    v: Literal[1] = WIRE_VERSION
    boot_id: str
    """Identifies this start of the daemon, from which `seq` and `grasp` count."""
    seq: Count
    """Counts up per message of this topic; a gap is a loss, or a `tactile` not wanted."""
    t: float
    """Wall-clock seconds since 1970, for plots and people only."""
    t_mono_ns: Count
    """Monotonic time, ns."""


class Verdict(_Message, frozen=True, kw_only=True):
    """The verdict on the grasp by one reading, on topic `verdict.<hand>`."""

    t_mono_ns: Count
    """Monotonic time, ns, of the reading's last byte; of the start where none has come yet."""
    grasp: Count
    """Counts up per contact episode (with gate mode `every`: per reading), from 1; 0 before."""
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
    """From `t_mono_ns` to publishing, ms."""
    latency_us: Duration
    """From the driver handing the reading over to encoding this message, us."""
    repaired: Annotated[list[str], msgspec.Meta(max_length=120)] = []
    """Electrodes that were replaced by what the others let expect, such as `ff_7` (1 to 24)."""
    session_calibrated: bool | None = None
    """False: the grasps are too few yet, so it is less sure; null: the model needs none."""
    judged: bool = True
    """True: the network was asked about this reading. False: it confirms the standing verdict, or
    is `unknown`."""
    gate: GateState | None = None
    """Null: each reading is a grasp of its own."""
    contact: Annotated[list[Finger], msgspec.Meta(max_length=5)] | None = None
    """Fingers that touch; null with a null `gate`."""
    silence_ms: Duration
    """If no message comes for longer than this, take the grasp for unknown."""
    model: str
    model_sha: str
    """First 12 hex digits of the model file's SHA-256."""
    p_slip_model: Probability | None = None
    """`p_slip` of the network alone, without outcomes; null exactly when `p_slip` is."""
    outcomes: Count = 0
    """Outcomes since the start of the session that `p_slip` rests on."""
    supervised: bool = False
    """Lift it under supervision, whatever the verdict, and tell the outcome: it teaches."""
    risk: RiskReport | None = None
    """Outcomes of `stable` lifts so far; null: without learning and without a risk."""
    early: bool = False
    """Judged while something might still slide slowly; a surer verdict follows.

    An `unknown` has it only if it is `supervised`.
    """
    still_ms: Duration | None = None
    """How long the hand has kept still, ms; null with a null `gate`.

    From 100 on nothing moves fast, from 240 on nothing slides; 0 while something moves.
    """
    motion: Motion | None = None
    """Motion of each finger, in units of its noise; null: not known, or nothing touches."""
    motion_limits: Annotated[dict[Finger, Duration], _HAND] | None = None
    """Most motion of a finger that is still."""
    fingers: Annotated[dict[Finger, FingerState | None], _HAND] | None = None
    """State of each finger; null: not known. Null with a null `gate`."""


class GateMessage(_Message, frozen=True, kw_only=True):
    """The gate changed its state, on topic `gate.<hand>`; comes before the reading's verdict."""

    t_mono_ns: Count
    """Monotonic time, ns, of the last byte of the reading that made the change."""
    grasp: Count
    former: GateState
    state: GateState
    cause: GateCause
    still_ms: Duration | None = None
    """By the reading that made the change, as in its verdict; null where none did."""
    motion: Motion | None = None
    """Likewise."""
    motion_limits: Annotated[dict[Finger, Duration], _HAND] | None = None
    """Likewise."""


class Tactile(_Message, frozen=True, kw_only=True):
    """A reading as judged, on topic `tactile.<hand>`; comes before its verdict.

    Sent only while a peer subscribes to it.
    """

    t_mono_ns: Count
    """Monotonic time, ns, of the reading's last byte, as in its verdict."""
    fingers: Annotated[list[Finger], msgspec.Meta(max_length=5)]
    counts: Annotated[list[Annotated[list[Count], msgspec.Meta(max_length=24)]], _HAND]
    """By finger, electrodes 1 to 24, 0..4095; as read, nothing repaired."""
    faults: Annotated[list[Annotated[list[Count], msgspec.Meta(max_length=24)]], _HAND]
    """By finger and electrode, bits: 1 missing, 2 not a count, 4 parity, 8 error word, 16 held, 32
    cut off; 0 is well."""
    joints: dict[str, float] = {}
    """Newest angle of each joint that has one, rad."""


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
    """The earlier start under which the grasp was judged; null: this one."""


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
    """Grasps forgotten before an outcome came. With a risk, announced ones count as slips;
    others are in no bound."""
    announced: Count = 0
    """`lift` questions that were answered `stable`, one a grasp."""
    awaited: Count = 0
    """Those of them whose outcome is out."""
    covered: bool | None = None
    """False: no lift was announced, so the risk that is set covers only lifts that were told. Null:
    no risk is set."""


class LearnerHealth(msgspec.Struct, frozen=True, kw_only=True):
    """State of the learner."""

    enabled: bool
    """`[learn] enabled`."""
    outcomes: Count
    """Learned from since the start of the session."""
    told: dict[OutcomeStatus, Count]
    """Outcomes since the start of the session, by what became of them; only what occurred."""
    uncertainty: Probability
    """1: nothing is learned yet; towards 0: what is learned hardly changes any more."""


class Status(_Message, frozen=True, kw_only=True):
    """How the daemon is, once a second even when idle, on topic `status.<hand>`."""

    t_mono_ns: Count
    """Monotonic time, ns, of this message."""
    state: State
    readings_hz: Duration
    """Tactile readings per second since the last status."""
    verdicts: dict[Decision, Count]
    """Verdicts since start, by outcome."""
    reasons: dict[Reason, Count]
    """Reasons given since start; only those that occurred."""
    drivers: dict[str, dict[str, Count]]
    """Counters of each driver, by driver name."""
    repaired: Annotated[dict[str, Count], msgspec.Meta(max_length=120)] = {}
    """How often each electrode was repaired since start; only those that were."""
    session_grasps: Count | None = None
    """Grasps by which the session is calibrated; null: the model needs none."""
    session_calibrated: bool | None = None
    """Whether they are enough."""
    gate: GateState | None = None
    """Null: each reading is a grasp of its own."""
    tared: Annotated[list[Finger], msgspec.Meta(max_length=5)] | None = None
    """Fingers of which it is known where they rest; null with a null `gate`."""
    health: Annotated[dict[str, Reason], msgspec.Meta(max_length=130)] = {}
    """Current problems: `ff_7`, `ff`, `link`, `joints`, `model` or `session`, and why."""
    latency_us: dict[Literal["p50", "p99", "max"], Duration]
    """Reading to publish since start; all zero before the first verdict."""
    jitter_us: dict[Literal["p50", "p99", "max"], Duration] = {}
    """Time between two readings less the driver's period; empty while that is not known."""
    late_readings: Count = 0
    """Readings since start whose verdict came more than a period after their last byte."""
    worst_age_ms: Duration = 0.0
    """Longest time since start from a reading's last byte to its verdict, ms."""
    skipped_readings: Count = 0
    """Readings since start that were not judged because newer ones were there already."""
    overloaded: bool = False
    """Whether readings come faster than they are judged, or did within the last five seconds."""
    lifts: Lifts | None = None
    """Null where nothing learns and no risk is set."""
    learner: LearnerHealth | None = None
    """Likewise."""
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
"""Messages by the first part of their topic."""

encode = msgspec.json.Encoder().encode
"""JSON payload of a message."""
decode_outcome = msgspec.json.Decoder(OutcomeMessage).decode
"""Decode the payload of an outcome. Raises `msgspec.DecodeError`."""


def schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of all messages, by name in `$defs`."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "graspd wire messages, version 1",
        "anyOf": [{"$ref": f"#/$defs/{message.__name__}"} for message in MESSAGES.values()],
        "$defs": msgspec.json.schema_components(MESSAGES.values())[1],
    }
