"""The topics of a recording, and the messages that are not published."""

from __future__ import annotations

import json
from collections.abc import Sequence
from enum import StrEnum
from functools import cache
from typing import Annotated, Any, Final, Literal, Self

import msgspec
import numpy as np

from graspd.daemon.judge.pipeline import Judgement
from graspd.daemon.publish import messages
from graspd.daemon.publish.messages import WIRE_VERSION, Count, Tactile
from graspd.daemon.record.flat import schema_of, table
from graspd.daemon.record.viewers import Log, RawImage
from graspd.daemon.trust.learner import LearnerState
from graspd.drivers.base import ELECTRODES, JointReading, TactileReading
from graspd.drivers.hand import JOINTS
from graspd.models.session_statistics import SessionState

_ANGLES = msgspec.Meta(
    extra_json_schema={"properties": {name: {"type": "number"} for name in sorted(JOINTS)}}
)
"""Lets a viewer offer the joints by name."""


class Joints(msgspec.Struct, frozen=True, kw_only=True):
    """A reading of joint angles."""

    v: Literal[1] = WIRE_VERSION
    seq: int
    t_mono_ns: int
    """Of the reading's last byte, ns."""
    names: tuple[str, ...]
    position_rad: Annotated[dict[str, float], _ANGLES]
    """Valid angles, rad."""

    @classmethod
    def of(cls, reading: JointReading) -> Self:
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
    """Of the verdict. If it is judged again, the last message holds."""
    counts: list[list[Count]]
    """By finger and electrode, in the header's order, before any repair."""
    repaired: list[str] = []
    """Electrodes that the verdict names as replaced."""

    @classmethod
    def of(cls, boot_id: str, judgement: Judgement) -> Self:
        """Return the message for a judgement with `judged_counts`."""
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
    """A sensor was exchanged; empty unless the new one was known."""

    session: SessionState | None = None
    learned: LearnerState | None = None


class Topic(StrEnum):
    """First part of a topic's name, `<kind>.<hand>`."""

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
    """A controller has asked for a judgement."""
    EXCHANGED = "exchanged"
    SKIPPED = "skipped"
    """Readings before the next one were left out."""
    ANNOUNCED = "announced"
    """A controller asked whether it may lift, and the answer was `stable`."""
    # Made of them for viewers:
    IMAGE = "image"
    LOG = "log"


MESSAGES: Final[dict[str, type[msgspec.Struct]]] = {
    **messages.MESSAGES,
    "joints": Joints,
    "judged": Judged,
    "asked": Event,
    "exchanged": Exchanged,
    "skipped": Event,
    "announced": Event,
    "image": RawImage,
    "log": Log,
}
"""Messages by the first part of their topic."""
EVENTS: Final = (Topic.ASKED, Topic.SKIPPED, Topic.ANNOUNCED)
EVENT: Final = b"{}"

decode_exchanged = msgspec.json.Decoder(Exchanged).decode
_decode = msgspec.json.Decoder(dict[str, Any]).decode


@cache
def schemas() -> dict[str, tuple[str, bytes]]:
    """Return name and JSON Schema by topic. Viewers know those of `foxglove` by name."""
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


def tactile_reading(payload: bytes, fingers: Sequence[str]) -> tuple[TactileReading, bool]:
    """Return the reading of a `tactile` message, of these fingers.

    The second value is True if an older recording says that a controller asked before it. Raises
    `ValueError` or `OverflowError`.
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
    """Return the reading of a `joints` message. Raises `ValueError`."""
    content = _decode(payload)
    angles = content.get("position_rad")
    if isinstance(angles, list):  # as older recordings have them
        pairs = zip(map(str, content.get("names", "")), angles, strict=True)
        content["position_rad"] = {name: angle for name, angle in pairs if angle is not None}
    message = msgspec.convert(content, Joints)
    if not message.position_rad.keys() <= set(message.names):
        raise ValueError("an angle of no joint")
    position_rad = [message.position_rad.get(name, np.nan) for name in message.names]
    return JointReading(
        message.t_mono_ns, message.seq, message.names, np.array(position_rad, dtype=np.float64)
    )
