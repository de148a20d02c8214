"""The topics of a recording, and those of its messages that are not published."""

from __future__ import annotations

import json
from collections.abc import Sequence
from enum import StrEnum
from functools import cache
from typing import Annotated, Any, Final, Literal, Self

import msgspec
import numpy as np

from daemon.judge.pipeline import Judgement
from daemon.publish.messages import (
    WIRE_VERSION,
    Count,
    GateMessage,
    OutcomeMessage,
    Status,
    Tactile,
    Verdict,
)
from daemon.record.flat import schema_of, table
from daemon.record.viewers import Log, RawImage
from daemon.trust.learner import LearnerState
from drivers.base import ELECTRODES, JointReading, TactileReading
from drivers.hand import JOINTS
from models.session_statistics import SessionState

_ANGLES = msgspec.Meta(
    extra_json_schema={"properties": {name: {"type": "number"} for name in sorted(JOINTS)}}
)
"""So that a viewer offers them by name."""


class Joints(msgspec.Struct, frozen=True, kw_only=True):
    """A reading of joint angles."""

    v: Literal[1] = WIRE_VERSION
    seq: int
    t_mono_ns: int
    """Monotonic time, ns, of the reading's last byte."""
    names: tuple[str, ...]
    position_rad: Annotated[dict[str, float], _ANGLES]
    """Of each joint that has a valid angle, rad."""

    @classmethod
    def of(cls, reading: JointReading) -> Self:
        """The message for `reading`."""
        pairs = zip(reading.names, reading.position_rad.tolist(), strict=True)
        angles = {name: angle for name, angle in pairs if angle == angle}
        return cls(
            seq=reading.seq, t_mono_ns=reading.t_ns, names=reading.names, position_rad=angles
        )


class Judged(msgspec.Struct, frozen=True, kw_only=True):
    """The counts by which the network judged a grasp, unless electrodes were broken."""

    v: Literal[1] = WIRE_VERSION
    boot_id: str
    t_mono_ns: Count
    """Of the verdict."""
    grasp: Count
    """Of the verdict. A grasp that is judged again has several messages; the last one holds."""
    counts: list[list[Count]]
    """By finger, in the header's order, and electrode 1 to 24: medians of fresh sweeps or one
    reading, as the scene says; before any repair."""
    repaired: list[str] = []
    """Electrodes that the verdict names as replaced before judging."""

    @classmethod
    def of(cls, boot_id: str, judgement: Judgement) -> Self:
        """The message for a judgement with `judged_counts`, in the run `boot_id`."""
        counts = judgement.judged_counts
        return cls(
            boot_id=boot_id,
            t_mono_ns=judgement.t_ns,
            grasp=judgement.moment.grasp,
            counts=[] if counts is None else counts.tolist(),
            repaired=list(judgement.opinion.repaired),
        )


class Event(msgspec.Struct, frozen=True):
    """Something has happened; what, the topic says."""


class Exchanged(msgspec.Struct, frozen=True, omit_defaults=True):
    """A sensor is another one than before; empty unless that one was known already."""

    session: SessionState | None = None
    """What was known of them."""
    learned: LearnerState | None = None
    """What outcomes had taught of them."""


class Topic(StrEnum):
    """First part of a topic's name, `<kind>.<hand>`, and the struct of its messages."""

    message: type[msgspec.Struct]

    def __new__(cls, kind: str, message: type[msgspec.Struct] = Event) -> Self:
        """A member is the string `kind`, with the attribute `message`."""
        topic = str.__new__(cls, kind)
        topic._value_ = kind
        topic.message = message
        return topic

    # Written by the outbox:
    TACTILE = "tactile", Tactile  # read by replay
    VERDICT = "verdict", Verdict  # read by other tools
    GATE = "gate", GateMessage  # read by other tools
    STATUS = "status", Status  # read by other tools
    OUTCOME = "outcome", OutcomeMessage  # read by replay and export
    # Written by the recorder:
    JOINTS = "joints", Joints  # read by replay
    JUDGED = "judged", Judged  # read by export
    ASKED = "asked"  # read by replay: somebody asked for a judgement
    EXCHANGED = "exchanged", Exchanged  # read by replay
    SKIPPED = "skipped"  # read by replay: readings before the next one were left out

    # Made of them for people, read by viewers:
    IMAGE = "image", RawImage
    LOG = "log", Log


_FAMILY: Final = {Topic.IMAGE: "foxglove", Topic.LOG: "foxglove"}
"""Whose schema a topic has, if it is not ours: viewers know it by its name."""

EVENTS: Final = frozenset(topic for topic in Topic if topic.message is Event)
EVENT: Final = b"{}"
"""Payload of an event."""

decode_exchanged = msgspec.json.Decoder(Exchanged).decode
_decode = msgspec.json.Decoder(dict[str, Any]).decode


@cache
def schemas() -> dict[str, tuple[str, bytes]]:
    """By topic: name and JSON Schema of its messages."""
    return {
        topic.value: (
            f"{_FAMILY.get(topic, 'graspd')}.{topic.message.__name__}",
            json.dumps(schema_of(topic.message)).encode(),
        )
        for topic in Topic
    }


def decode_judged(payload: bytes) -> Judged:
    """A `judged` message. Raises `ValueError` if the payload is not one."""
    content = _decode(payload)
    content["counts"] = table(content.get("counts"))
    return msgspec.convert(content, Judged)


def tactile_reading(payload: bytes, fingers: Sequence[str]) -> tuple[TactileReading, bool]:
    """The reading of a `tactile` message, reduced to `fingers`, in their order; and whether
    somebody asked for a judgement before it, as older recordings say in it.

    Raises `ValueError` or `OverflowError` if the payload is not such a message.
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
    reading = TactileReading(message.t_mono_ns, message.seq, counts[rows], faults[rows])
    return reading, content.get("asked") is True


def joint_reading(payload: bytes) -> JointReading:
    """The reading of a `joints` message. Raises `ValueError` if the payload is not one."""
    content = _decode(payload)
    angles = content.get("position_rad")
    if isinstance(angles, list):  # as older recordings have them
        if len(angles) != len(content.get("names", ())):
            raise ValueError("as many names as angles are needed")
        pairs = zip(content["names"], angles, strict=True)
        content["position_rad"] = {name: angle for name, angle in pairs if angle is not None}
    message = msgspec.convert(content, Joints)
    if not message.position_rad.keys() <= set(message.names):
        raise ValueError("an angle of no joint")
    position_rad = [message.position_rad.get(name, np.nan) for name in message.names]
    return JointReading(
        message.t_mono_ns, message.seq, message.names, np.array(position_rad, dtype=np.float64)
    )
