"""The plain joint stream: one JSON object per datagram. Bytes only; see deploy/wire/JOINTS.md."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.hand import joint_name
from drivers.udp.driver import DatagramCounters

DATAGRAM_BYTES_MAX = 4096
"""All 28 joints in full precision have about 900 bytes."""
ANGLE_MAX_RAD: Final = math.radians(200)
"""J0, the sum of two joints, reaches 180 degrees. What is beyond is not an angle in radians."""
SEQ_MAX: Final = (1 << 63) - 1
SEQ_JUMP_MAX: Final = 1000
"""A sender that jumps ahead by more has begun anew."""
OLD_MESSAGES_MAX: Final = 10
"""So many messages with old but rising numbers may be a detour; one more is a sender anew."""
_joint_of: Final = functools.lru_cache(maxsize=64)(joint_name)
"""Remembers 64 names, known or not: 28 joints with and without prefix."""


@dataclass(slots=True)
class JointCounters(DatagramCounters):
    """What happened to joint messages. `readings` are joint readings here.

    `missed_readings` needs a sender that counts.
    """

    bad_messages: int = 0
    """Datagrams that are not such a message; dropped."""
    old_messages: int = 0
    """Messages that came after a later one, or again; dropped."""
    restarts: int = 0
    """Times that the sender began to count anew."""
    unknown_names: int = 0
    """Joints of a name that no Shadow hand has; left out."""
    bad_angles: int = 0
    """Values that are not an angle in radians; handed over as NaN."""


@dataclass(frozen=True, slots=True, eq=False)
class JointMessage:
    """One message."""

    seq: int | None
    """Counts up by one per message, if the sender counts."""
    t_s: float | None
    """The sender's own time, s, from anywhere."""
    names: tuple[str, ...]
    """Without hand prefix, in the order of the message."""
    position_rad: NDArray[np.float64]
    """Shape (joints,); NaN for a value that is no angle."""

    def to_bytes(self) -> bytes:
        """The datagram. Raises `ValueError` for what cannot be sent, NaN among it."""
        message: dict[str, Any] = {"joints": dict(zip(self.names, self.position_rad, strict=True))}
        if self.t_s is not None:
            message = {"t": self.t_s, **message}
        if self.seq is not None:
            message = {"seq": self.seq, **message}
        data = json.dumps(message, allow_nan=False, separators=(",", ":")).encode()
        if len(data) > DATAGRAM_BYTES_MAX:
            raise ValueError(f"{len(data)} bytes are more than {DATAGRAM_BYTES_MAX}")
        return data


class JointParser:
    """Datagrams in, messages out."""

    def __init__(self, counters: JointCounters) -> None:
        self._counters = counters

    def parse(self, data: bytes) -> JointMessage | None:
        """The message, or None if it is none, which is counted."""
        try:
            message = _message(data)
        except (ValueError, RecursionError):  # not UTF-8, not JSON, or nested without end
            message = None
        if message is None:
            self._counters.bad_messages += 1
            return None
        seq, t_s, values = message
        angles: dict[str, float] = {}
        for name, value in values.items():
            joint = _joint_of(name)
            if joint is None:
                self._counters.unknown_names += 1
                continue
            angle = _angle(value)
            self._counters.bad_angles += math.isnan(angle)
            # `rh_FFJ3` beside `FFJ3` is one joint with two angles: neither is to be believed.
            self._counters.bad_angles += joint in angles
            angles[joint] = math.nan if joint in angles else angle
        return JointMessage(seq, t_s, tuple(angles), np.array(list(angles.values()), dtype=float))


class MessageOrder:
    """Keeps late and doubled messages out, by their number or else by their time."""

    def __init__(self, counters: JointCounters) -> None:
        self._counters = counters
        self.forget()

    def forget(self) -> None:
        """Whatever comes next is the first."""
        self._last: float | None = None
        self._counted = False
        self._last_old: float | None = None

    def admits(self, message: JointMessage) -> bool:
        """Whether a message comes after all admitted before."""
        counted = message.seq is not None
        now = message.seq if counted else message.t_s
        if now is None:
            return True
        last = self._last if counted == self._counted else None
        if last is not None and now <= last and not self._began_anew(now):
            self._counters.old_messages += 1
            return False
        if last is not None and now > last and counted:
            self._count_gap(int(now - last) - 1)
        self._last, self._counted, self._last_old = now, counted, None
        return True

    def _began_anew(self, now: float) -> bool:
        """Old messages are a new start if enough of them rise: one that repeats itself does not."""
        if self._last_old is None or now <= self._last_old:
            self._old_in_a_row = 0
        self._old_in_a_row += 1
        self._last_old = now
        began = self._old_in_a_row > OLD_MESSAGES_MAX
        self._counters.restarts += began
        return began

    def _count_gap(self, missed: int) -> None:
        if missed > SEQ_JUMP_MAX:
            self._counters.restarts += 1
        else:
            self._counters.missed_readings += missed


def _message(data: bytes) -> tuple[int | None, float | None, Mapping[str, Any]] | None:
    """The fields of a datagram; None or `ValueError` if it is no message."""
    if len(data) > DATAGRAM_BYTES_MAX:
        return None
    # JSON has no NaN; as text it costs only the joint that has it.
    message = json.loads(data.decode(), object_pairs_hook=_without_doubles, parse_constant=str)
    if not isinstance(message, dict) or not isinstance(message.get("joints"), dict):
        return None
    seq, t_s = message.get("seq"), message.get("t")
    if seq is not None and (type(seq) is not int or not 0 <= seq <= SEQ_MAX):
        return None
    if t_s is not None and math.isnan(number := _number(t_s)):
        return None
    return seq, None if t_s is None else number, message["joints"]


def _without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key stands twice")
    return found


def _number(value: object) -> float:
    """A finite number, else NaN. Truth values and text are none."""
    if type(value) is int:
        return float(value) if abs(value) <= SEQ_MAX else math.nan
    return value if type(value) is float and math.isfinite(value) else math.nan


def _angle(value: object) -> float:
    angle = _number(value)
    return angle if abs(angle) <= ANGLE_MAX_RAD else math.nan
