"""The topics of a recording, their schemas, and the messages that are not published.

Viewers read neither null nor nested lists, so recorded messages have neither, and schemas are
plain.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from enum import StrEnum
from functools import cache
from itertools import chain
from typing import Annotated, Any, Final, Literal, Self

import msgspec
import numpy as np
from msgspec import inspect

from graspd.biotac import ELECTRODES
from graspd.daemon.judge.exchange import Exchanged
from graspd.daemon.judge.pipeline import Judgement
from graspd.daemon.publish import messages
from graspd.daemon.publish.messages import WIRE_VERSION, Count, Tactile
from graspd.daemon.record.viewers import Log, RawImage
from graspd.drivers.base import JOINTS, JointReading, TactileReading

JsonSchema = dict[str, Any]
TABLE: Final = (
    f"Shape (fingers, {ELECTRODES}), row by row: finger f's electrode e is at "
    f"{ELECTRODES} * f + e - 1, with f from 0 and e from 1."
)
UNKNOWN: Final = "unknown"
"""State of a finger that is not known. Without a value a viewer would continue the last state."""
_ANGLES = msgspec.Meta(
    extra_json_schema={"properties": {name: {"type": "number"} for name in sorted(JOINTS)}}
)
"""Schema of joint angles with all names, so that a viewer can list them."""


class Joints(msgspec.Struct, frozen=True, kw_only=True):
    """A reading of joint angles."""

    v: Literal[1] = WIRE_VERSION
    seq: int
    t_mono_ns: int
    """Monotonic time of the reading's last byte, ns."""
    names: tuple[str, ...]
    position_rad: Annotated[dict[str, float], _ANGLES]
    """Valid angles by joint, rad."""

    @classmethod
    def of(cls, reading: JointReading) -> Self:
        pairs = zip(reading.names, reading.position_rad.tolist(), strict=True)
        angles = {name: angle for name, angle in pairs if angle == angle}
        return cls(
            seq=reading.seq, t_mono_ns=reading.t_ns, names=reading.names, position_rad=angles
        )


class Judged(msgspec.Struct, frozen=True, kw_only=True):
    """Counts that the network judged, with the original counts of repaired electrodes."""

    v: Literal[1] = WIRE_VERSION
    boot_id: str
    t_mono_ns: Count
    """`t_mono_ns` of the verdict: time of the reading's last byte, ns."""
    grasp: Count
    """Number of the verdict's grasp. Later messages on a grasp may be of an object in the air."""
    counts: list[list[Count]]
    """Counts by finger and electrode, in the header's order, before repair."""
    repaired: list[str] = []
    """Names of the electrodes that the verdict calls repaired."""

    @classmethod
    def of(cls, boot_id: str, judgement: Judgement) -> Self:
        """Return the message of a judgement that has `judged_counts`."""
        counts = judgement.judged_counts
        return cls(
            boot_id=boot_id,
            t_mono_ns=judgement.t_ns,
            grasp=judgement.moment.grasp,
            counts=[] if counts is None else counts.tolist(),
            repaired=list(judgement.opinion.repaired),
        )


class Late(msgspec.Struct, frozen=True):
    """Mark that the last reading was late, so its verdict is `stale` in a replay too."""

    judged: bool
    """True if the network judged the reading all the same."""


class Said(msgspec.Struct, frozen=True):
    """Part of a verdict by which a replay is compared with the recorded run."""

    verdict: str
    judged: bool = True


class TakenBack(msgspec.Struct, frozen=True):
    """Mark that no lift follows an announcement. An old recording does not say of which grasp:
    of the newest that was announced."""

    boot_id: str = ""
    grasp: int | None = None


class Event(msgspec.Struct, frozen=True):
    """An event; its topic is its kind."""


class Topic(StrEnum):
    """Kind of a message: the first part of its topic, `<kind>.<hand>`."""

    # Written by the outbox:
    TACTILE = "tactile"
    VERDICT = "verdict"
    GATE = "gate"
    STATUS = "status"
    OUTCOME = "outcome"
    # Written by the recorder:
    JOINTS = "joints"
    JUDGED = "judged"
    ASKED = "asked"
    """A controller asked for a judgement."""
    EXCHANGED = "exchanged"
    LATE = "late"
    """The last reading was late."""
    DROPPED = "dropped"
    """Entries before the next one were not recorded: the disk was slow."""
    SKIPPED = "skipped"
    """Readings before the next one were skipped."""
    ANNOUNCED = "announced"
    """A controller that asked may lift, as the verdict is `stable` or `supervised`."""
    TAKEN_BACK = "taken-back"
    """No lift follows an announcement."""
    # Made from these for viewers:
    IMAGE = "image"
    LOG = "log"


MESSAGES: Final[dict[str, type[msgspec.Struct]]] = {
    **messages.MESSAGES,
    "joints": Joints,
    "judged": Judged,
    "asked": Event,
    "exchanged": Exchanged,
    "late": Late,
    "dropped": Event,
    "skipped": Event,
    "announced": Event,
    "taken-back": TakenBack,
    "image": RawImage,
    "log": Log,
}
"""Type of the messages by the first part of their topic."""
EVENTS: Final = (Topic.ASKED, Topic.SKIPPED, Topic.ANNOUNCED)
PLAYED: Final = (
    *EVENTS,
    Topic.TACTILE,
    Topic.JOINTS,
    Topic.OUTCOME,
    Topic.EXCHANGED,
    Topic.TAKEN_BACK,
)
"""Topics that a replay plays in their order; it plays `late`, `gate` and `verdict` before their
reading, and `dropped` as `skipped`."""
EVENT: Final = b"{}"
MALFORMED: Final = ValueError, OverflowError, RecursionError
"""Exceptions for a malformed message; huge counts and deeply nested JSON cause the last two."""

decode_exchanged = msgspec.json.Decoder(Exchanged).decode
decode_taken_back = msgspec.json.Decoder(TakenBack).decode
decode_late = msgspec.json.Decoder(Late).decode
decode_gate = msgspec.json.Decoder(messages.GateMessage).decode
decode_said = msgspec.json.Decoder(Said).decode
_decode_joints = msgspec.json.Decoder(Joints).decode
_decode = msgspec.json.Decoder(dict[str, Any]).decode


@cache
def schemas() -> dict[str, tuple[str, bytes]]:
    """Return name and JSON Schema by first part of topic. Viewers know names in `foxglove`."""
    described = {}
    for topic, message in MESSAGES.items():
        family = "foxglove" if message in (RawImage, Log) else "graspd"
        schema = json.dumps(schema_of(message)).encode()
        described[topic] = f"{family}.{message.__name__}", schema
    return described


def decode_judged(payload: bytes) -> Judged:
    """Decode a `judged` message. Raises `ValueError`."""
    content = _decode(payload)
    content["counts"] = table(content.get("counts"))
    return msgspec.convert(content, Judged)


def tactile_reading(payload: bytes, fingers: Sequence[str]) -> TactileReading:
    """Return the reading of a `tactile` message, with rows in the order of `fingers`.

    Raises `ValueError`, also if a finger is missing, or `OverflowError` for a huge count.
    """
    content = _decode(payload)
    content["counts"] = table(content.get("counts"))
    content["faults"] = table(content.get("faults"))
    message = msgspec.convert(content, Tactile)
    names: Sequence[str] = message.fingers
    rows = [names.index(finger) for finger in fingers]
    shape = (len(names), ELECTRODES)
    counts = np.array(message.counts, dtype=np.uint16).reshape(shape)
    faults = np.array(message.faults, dtype=np.uint8).reshape(shape)
    return TactileReading(message.t_mono_ns, message.seq, counts[rows], faults[rows])


def boot_id_of(payload: bytes) -> bytes:
    """Return the `boot_id` of a well-formed `tactile` message."""
    return str(_decode(payload)["boot_id"]).encode()


def joint_reading(payload: bytes) -> JointReading:
    """Return the reading of a `joints` message. Raises `ValueError`."""
    message = _decode_joints(payload)
    if not message.position_rad.keys() <= set(message.names):
        raise ValueError("an angle of no joint")
    position_rad = [message.position_rad.get(name, np.nan) for name in message.names]
    return JointReading(
        message.t_mono_ns, message.seq, message.names, np.array(position_rad, dtype=np.float64)
    )


def flat(value: object) -> object:
    """Return a message without null fields; a finger's null state becomes `UNKNOWN`, and each
    table one list, row by row."""
    if isinstance(value, dict):
        return {name: _part(name, one) for name, one in value.items() if one is not None}
    if isinstance(value, list) and value and isinstance(value[0], list):
        return list(chain.from_iterable(value))
    return value


def _part(name: str, value: object) -> object:
    if name == "fingers" and isinstance(value, dict):  # in a verdict
        return {finger: UNKNOWN if state is None else state for finger, state in value.items()}
    return flat(value)


def table(values: object) -> object:
    """Return a flat list of counts as rows of 24, one per finger; other values as they are."""
    if not isinstance(values, list):
        return values
    return [values[first : first + ELECTRODES] for first in range(0, len(values), ELECTRODES)]


def schema_of(message: type[msgspec.Struct]) -> JsonSchema:
    """Return the schema of a flat message. Raises `TypeError` for an unreadable field."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **_schema(inspect.type_info(message)),
    }


def _schema(kind: inspect.Type) -> JsonSchema:
    match kind:
        case inspect.Metadata():
            return {**_schema(kind.type), **(kind.extra_json_schema or {})}
        case inspect.UnionType(types=(inner, inspect.NoneType())):
            return _schema(inner)
        case inspect.StructType():
            return _object(kind)
        case inspect.DictType():
            more = _schema(kind.value_type)
            if isinstance(kind.value_type, inspect.UnionType) and "enum" in more:
                more["enum"] = [*more["enum"], UNKNOWN]
            named = dict.fromkeys(_values(kind.key_type), more)
            return {"type": "object", "properties": named, "additionalProperties": more}
        case inspect.ListType(item_type=inspect.ListType(item_type=count)):
            return {"type": "array", "description": TABLE, "items": _schema(count)}
        case inspect.ListType() | inspect.VarTupleType():
            return {"type": "array", "items": _schema(kind.item_type)}
        case inspect.EnumType() | inspect.LiteralType():
            values = _values(kind)
            plain = "integer" if isinstance(values[0], int) else "string"
            return {"type": plain, "enum": values}
        case inspect.BytesType():
            return {"type": "string", "contentEncoding": "base64"}
        case inspect.BoolType():
            return {"type": "boolean"}
        case inspect.IntType():
            return {"type": "integer"}
        case inspect.FloatType():
            return {"type": "number"}
        case inspect.StrType():
            return {"type": "string"}
    raise TypeError(f"no viewer can read {kind}")


def _object(kind: inspect.StructType) -> JsonSchema:
    required = [
        field.encode_name
        for field in kind.fields
        if field.required and not isinstance(field.type, inspect.UnionType)
    ]
    return {
        "title": kind.cls.__name__,
        "description": (kind.cls.__doc__ or "").strip(),
        "type": "object",
        "properties": {field.encode_name: _schema(field.type) for field in kind.fields},
        "required": required,
    }


def _values(kind: inspect.Type) -> list[Any]:
    """Return the values of an enumeration or a literal, in order; [] for other types."""
    if isinstance(kind, inspect.EnumType):
        return [member.value for member in kind.cls]
    return list(kind.values) if isinstance(kind, inspect.LiteralType) else []
