"""The topics of a recording, and those of its messages that are not published."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import Final, Literal, Self

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
    decode_tactile,
)
from daemon.trust.learner import LearnerState
from drivers.base import ELECTRODES, JointReading, TactileReading
from models.session_statistics import SessionState


class Joints(msgspec.Struct, frozen=True, kw_only=True):
    """A reading of joint angles."""

    v: Literal[1] = WIRE_VERSION
    seq: int
    t_mono_ns: int
    """Monotonic time, ns, of the reading's last byte."""
    names: tuple[str, ...]
    position_rad: list[float | None]
    """By name, rad; null where a joint has no valid angle."""

    @classmethod
    def of(cls, reading: JointReading) -> Self:
        """The message for `reading`."""
        angles = [None if angle != angle else angle for angle in reading.position_rad.tolist()]
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
            grasp=judgement.grasp,
            counts=[] if counts is None else counts.tolist(),
            repaired=list(judgement.repaired),
        )


class Exchanged(msgspec.Struct, frozen=True, omit_defaults=True):
    """A sensor is another one than before: an event, empty unless that one was known already."""

    session: SessionState | None = None
    """What was known of them."""
    learned: LearnerState | None = None
    """What outcomes had taught of them."""


class Topic(StrEnum):
    """First part of a topic's name, `<kind>.<hand>`, and the struct of its messages.

    A topic without a struct is an event: its messages are empty objects, mostly.
    """

    message: type[msgspec.Struct] | None
    """None for an event."""

    def __new__(cls, kind: str, message: type[msgspec.Struct] | None = None) -> Self:
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
    ASKED = "asked"  # read by replay: somebody has asked for a judgement
    EXCHANGED = "exchanged"  # read by replay: a sensor was exchanged, see `Exchanged`
    SKIPPED = "skipped"  # read by replay: readings before the next one were left out


EVENTS: Final = frozenset(topic for topic in Topic if topic.message is None)
EVENT: Final = b"{}"
"""Payload of an event."""

_decode_joints = msgspec.json.Decoder(Joints).decode
decode_exchanged = msgspec.json.Decoder(Exchanged).decode
decode_judged = msgspec.json.Decoder(Judged).decode


def tactile_reading(payload: bytes, fingers: Sequence[str]) -> TactileReading:
    """The reading of a `tactile` message, reduced to `fingers`, in their order.

    Raises `ValueError` or `OverflowError` if the payload is not such a message.
    """
    message = decode_tactile(payload)
    names: Sequence[str] = message.fingers
    rows = [names.index(finger) for finger in fingers]
    shape = (len(names), ELECTRODES)
    counts = np.array(message.counts, dtype=np.uint16).reshape(shape)
    faults = np.array(message.faults, dtype=np.uint8).reshape(shape)
    return TactileReading(message.t_mono_ns, message.seq, counts[rows], faults[rows])


def joint_reading(payload: bytes) -> JointReading:
    """The reading of a `joints` message. Raises `ValueError` if the payload is not one."""
    message = _decode_joints(payload)
    if len(message.names) != len(message.position_rad):
        raise ValueError("as many names as angles are needed")
    angles = np.array(message.position_rad, dtype=np.float64)  # None becomes NaN
    return JointReading(message.t_mono_ns, message.seq, message.names, angles)
