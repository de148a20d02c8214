"""The joint stream: one JSON object of angles per datagram; see deploy/wire/JOINTS.md."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.drivers.base import ANGLE_MAX_RAD, JointReading, joint_name
from graspd.drivers.datagrams.messages import (
    DATAGRAM_BYTES_MAX,
    SILENCE_NS,
    MessageCounters,
    Order,
    Stamp,
    number,
    read_message,
    write_message,
)
from graspd.drivers.udp import DatagramDriver

_joint_of: Final = functools.lru_cache(maxsize=64)(joint_name)
"""`joint_name` with a cache of 64 names: 28 joints with and without prefix, a few unknown ones."""


@dataclass(slots=True)
class JointCounters(MessageCounters):
    """Counters of joint messages."""

    bad_angles: int = 0
    """Values that are not an angle in radians, or a joint's second; handed over as NaN."""


@dataclass(frozen=True, slots=True, eq=False)
class JointMessage:
    """One message of the joint stream."""

    stamp: Stamp
    names: tuple[str, ...]
    """Joint names without hand prefix, in the order of the message."""
    position_rad: NDArray[np.float64]
    """Shape (joints,); NaN for a value that is not an angle."""

    def to_bytes(self) -> bytes:
        """Return the datagram. Raises `ValueError` for NaN."""
        joints = dict(zip(self.names, self.position_rad, strict=True))
        return write_message(self.stamp, joints=joints)


class JointStream:
    """Decoder of one sender's joint messages into readings. A `DatagramStream`."""

    sender_kind = "joint stream"

    def __init__(self) -> None:
        self.counters = JointCounters()
        self._order = Order(self.counters)

    def interrupt(self) -> None:
        """Do nothing: the last number and time stay, so that no old message is mistaken for new."""

    def receive(self, data: bytes, t_ns: int) -> list[JointReading] | None:
        """Return the reading of a message that arrived at `t_ns`; [] if no joint is known; None if
        it is dropped.

        The reading's time is when the message was made, by its `t` and the quickest message.
        """
        counters, message = self.counters, self.parse(data)
        if message is None:
            return None
        made_ns = self._order.made_ns(data, message.stamp, t_ns)
        if made_ns is None:
            return None
        if not message.names:
            return []
        seq = counters.readings + counters.missed_readings
        counters.readings += 1
        names, angles = message.names, message.position_rad
        interrupted = self._order.take_interrupted()
        return [JointReading(made_ns, seq, names, angles, interrupted=interrupted)]

    def parse(self, data: bytes) -> JointMessage | None:
        """Return the message of a datagram; None, and count it, if it is not valid."""
        message = read_message(data, "joints", self.counters)
        if message is None:
            return None
        angles: dict[str, float] = {}
        for name, value in message.values.items():
            joint = _joint_of(name)
            if joint is None:
                self.counters.unknown_names += 1
                continue
            angle = _angle(value)
            self.counters.bad_angles += math.isnan(angle)
            # `rh_FFJ3` and `FFJ3` are one joint with two angles, of which neither is trusted.
            self.counters.bad_angles += joint in angles
            angles[joint] = math.nan if joint in angles else angle
        position_rad = np.array(list(angles.values()), dtype=float)
        return JointMessage(message.stamp, tuple(angles), position_rad)


def _angle(value: object) -> float:
    angle = number(value)
    return angle if abs(angle) <= ANGLE_MAX_RAD else math.nan


class JointStreamDriver(DatagramDriver[JointStream]):
    """Driver of the joint stream: one `JointReading` per message."""

    name = "joints"
    bytes_max = DATAGRAM_BYTES_MAX
    silence_ns = SILENCE_NS
    period_ns: int | None = None

    def _new_stream(self) -> JointStream:
        return JointStream()
