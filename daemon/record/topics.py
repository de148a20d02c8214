"""What a recording holds: its topics, and the messages that no socket sends."""

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
from drivers.base import ELECTRODES, JointReading, TactileReading


class Joints(msgspec.Struct, frozen=True, kw_only=True):
    """Joint angles as they came."""

    v: Literal[1] = WIRE_VERSION
    seq: int
    t_mono_ns: int
    """Monotonic time, ns, of the reading's last byte."""
    names: tuple[str, ...]
    position_rad: list[float | None]
    """By name, rad; null where a joint has no valid angle."""

    @classmethod
    def of(cls, reading: JointReading) -> Self:
        """The message of a reading."""
        angles = [None if angle != angle else angle for angle in reading.position_rad.tolist()]
        return cls(
            seq=reading.seq, t_mono_ns=reading.t_ns, names=reading.names, position_rad=angles
        )


class Judged(msgspec.Struct, frozen=True, kw_only=True):
    """The counts that a grasp was judged by."""

    v: Literal[1] = WIRE_VERSION
    boot_id: str
    t_mono_ns: Count
    """As in the verdict."""
    grasp: Count
    """As in the verdict; judged again, the later message counts."""
    counts: list[list[Count]]
    """By finger of the header, electrodes 1 to 24: medians of fresh sweeps or one reading, as the
    scene wants it; nothing repaired."""
    repaired: list[str] = []
    """Electrodes that were replaced before judging, as in the verdict."""

    @classmethod
    def of(cls, boot_id: str, judgement: Judgement) -> Self:
        """The message of a judgement that has `judged_counts`."""
        counts = judgement.judged_counts
        return cls(
            boot_id=boot_id,
            t_mono_ns=judgement.t_ns,
            grasp=judgement.grasp,
            counts=[] if counts is None else counts.tolist(),
            repaired=list(judgement.repaired),
        )


class Topic(StrEnum):
    """First part of a topic's name, `<kind>.<hand>`, with the struct of its messages.

    A topic without a struct is an event: all there is to say is that it happened.
    """

    message: type[msgspec.Struct] | None

    def __new__(cls, kind: str, message: type[msgspec.Struct] | None = None) -> Self:
        """Make a member that is equal to its kind."""
        topic = str.__new__(cls, kind)
        topic._value_ = kind
        topic.message = message
        return topic

    # What the outbox sends, whoever subscribes:
    TACTILE = "tactile", Tactile  # read by replay
    VERDICT = "verdict", Verdict  # for other tools, as is what follows
    GATE = "gate", GateMessage
    STATUS = "status", Status
    OUTCOME = "outcome", OutcomeMessage  # read by export
    # What the recorder is told by the loop:
    JOINTS = "joints", Joints  # read by replay
    JUDGED = "judged", Judged  # read by export
    ASKED = "asked"  # read by replay: the controller has asked for a judgement
    EXCHANGED = "exchanged"  # read by replay: a sensor is another one than before
    SKIPPED = "skipped"  # read by replay: readings were left out before the next one


EVENTS: Final = frozenset(topic for topic in Topic if topic.message is None)
EVENT: Final = b"{}"
"""Payload of each of them."""

_decode_joints = msgspec.json.Decoder(Joints).decode
decode_judged = msgspec.json.Decoder(Judged).decode


def tactile_reading(payload: bytes, fingers: Sequence[str]) -> TactileReading:
    """The reading in a `tactile` message, with these fingers, in their order.

    Raises `ValueError` (`msgspec.DecodeError` is one) or `OverflowError` for what is none.
    """
    message = decode_tactile(payload)
    names: Sequence[str] = message.fingers
    rows = [names.index(finger) for finger in fingers]
    shape = (len(names), ELECTRODES)
    counts = np.array(message.counts, dtype=np.uint16).reshape(shape)
    faults = np.array(message.faults, dtype=np.uint8).reshape(shape)
    return TactileReading(message.t_mono_ns, message.seq, counts[rows], faults[rows])


def joint_reading(payload: bytes) -> JointReading:
    """The reading in a `joints` message; NaN where a joint has no angle. Raises `ValueError`."""
    message = _decode_joints(payload)
    if len(message.names) != len(message.position_rad):
        raise ValueError("as many names as angles are needed")
    angles = np.array(message.position_rad, dtype=np.float64)  # None becomes NaN
    return JointReading(message.t_mono_ns, message.seq, message.names, angles)
