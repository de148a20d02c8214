"""The joint stream: one JSON object of angles per datagram; see deploy/wire/JOINTS.md."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.drivers.base import JointReading, joint_name
from graspd.drivers.udp import DatagramCounters, DatagramDriver

DATAGRAM_BYTES_MAX = 4096
"""Longest message, bytes; all 28 joints in full precision take about 900."""
ANGLE_MAX_RAD: Final = math.radians(200)
"""Largest angle, rad: J0, the sum of two joints, reaches 180 degrees. More is another unit."""
SEQ_MAX: Final = (1 << 63) - 1
SEQ_JUMP_MAX: Final = 1000
"""Largest jump ahead of `seq` that counts as a loss; after a larger one the sender restarted."""
OLD_MESSAGES_MAX: Final = 10
"""Old messages in a row, with rising numbers, that may have been delayed; one more: a restart."""
_joint_of: Final = functools.lru_cache(maxsize=64)(joint_name)
"""Cache of 64 names: 28 joints with and without prefix, and a few unknown ones."""


@dataclass(slots=True)
class JointCounters(DatagramCounters):
    """Counters of joint messages. `missed_readings` stays 0 if the sender sends no `seq`."""

    bad_messages: int = 0
    old_messages: int = 0
    """Messages that came again or after a later one; dropped."""
    restarts: int = 0
    unknown_names: int = 0
    """Names that no joint of a Shadow hand has; left out."""
    bad_angles: int = 0
    """Values that are not an angle in radians; handed over as NaN."""


@dataclass(frozen=True, slots=True, eq=False)
class JointMessage:
    """One message of the joint stream."""

    seq: int | None
    """Number of the message, one more each time; None if the sender sends none."""
    t_s: float | None
    """Sender's own time, s, with any zero; None if the sender sends none."""
    names: tuple[str, ...]
    """Joint names without hand prefix, in the order of the message."""
    position_rad: NDArray[np.float64]
    """Shape (joints,); NaN for a value that is no angle."""

    def to_bytes(self) -> bytes:
        """Return the datagram. Raises `ValueError` for NaN."""
        joints = dict(zip(self.names, self.position_rad, strict=True))
        fields = {"seq": self.seq, "t": self.t_s, "joints": joints}
        message = {name: value for name, value in fields.items() if value is not None}
        return json.dumps(message, allow_nan=False, separators=(",", ":")).encode()


class JointStream:
    """Decoder of one sender's joint messages into readings. A `DatagramStream`."""

    sender_kind = "joint stream"

    def __init__(self) -> None:
        self.counters = JointCounters()
        self.interrupt()

    def interrupt(self) -> None:
        """Forget the last message; the next one counts as the first."""
        self._last: float | None = None
        self._counted = False
        self._last_old: float | None = None

    def receive(self, data: bytes, t_ns: int) -> list[JointReading] | None:
        """Return the reading, none if no joint is known; None if the message is dropped."""
        message, restarts = self.parse(data), self.counters.restarts
        if message is None or not self.admits(message):
            return None
        if not message.names:
            return []
        seq = self.counters.readings + self.counters.missed_readings
        self.counters.readings += 1
        names, angles, restarted = message.names, message.position_rad, self.counters.restarts
        return [JointReading(t_ns, seq, names, angles, interrupted=restarted > restarts)]

    def parse(self, data: bytes) -> JointMessage | None:
        """Return the message of a datagram; None, and count it, if it is not valid."""
        try:
            message = _message(data)
        except (ValueError, RecursionError):  # not UTF-8, not JSON, or nested without end
            message = None
        if message is None:
            self.counters.bad_messages += 1
            return None
        seq, t_s, values = message
        angles: dict[str, float] = {}
        for name, value in values.items():
            joint = _joint_of(name)
            if joint is None:
                self.counters.unknown_names += 1
                continue
            angle = _angle(value)
            self.counters.bad_angles += math.isnan(angle)
            # `rh_FFJ3` beside `FFJ3` is one joint with two angles: neither is trusted.
            self.counters.bad_angles += joint in angles
            angles[joint] = math.nan if joint in angles else angle
        return JointMessage(seq, t_s, tuple(angles), np.array(list(angles.values()), dtype=float))

    def admits(self, message: JointMessage) -> bool:
        """Return True if it is newer than the last, by number, else by time."""
        counted = message.seq is not None
        now = message.seq if counted else message.t_s
        if now is None:
            return True
        last = self._last if counted == self._counted else None
        if last is not None and now <= last and not self._has_restarted(now):
            self.counters.old_messages += 1
            return False
        if last is not None and now > last and counted:
            self._count_gap(int(now - last) - 1)
        self._last, self._counted, self._last_old = now, counted, None
        return True

    def _has_restarted(self, now: float) -> bool:
        if self._last_old is None or now <= self._last_old:
            self._old_in_a_row = 0
        self._old_in_a_row += 1
        self._last_old = now
        has_restarted = self._old_in_a_row > OLD_MESSAGES_MAX
        self.counters.restarts += has_restarted
        return has_restarted

    def _count_gap(self, missed: int) -> None:
        if missed > SEQ_JUMP_MAX:
            self.counters.restarts += 1
        else:
            self.counters.missed_readings += missed


def _message(data: bytes) -> tuple[int | None, float | None, Mapping[str, Any]] | None:
    """Return number, time and joints. For other data, return None or raise `ValueError`."""
    if len(data) > DATAGRAM_BYTES_MAX:
        return None
    # JSON has no NaN; as text it costs only the joint that has it.
    message = json.loads(data.decode(), object_pairs_hook=_without_doubles, parse_constant=str)
    if not isinstance(message, dict) or not isinstance(message.get("joints"), dict):
        return None
    seq, t_s = message.get("seq"), message.get("t")
    if seq is not None and (type(seq) is not int or not 0 <= seq <= SEQ_MAX):
        return None
    if t_s is None:
        return seq, None, message["joints"]
    time_s = _finite(t_s)
    return None if math.isnan(time_s) else (seq, time_s, message["joints"])


def _without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    by_key = dict(pairs)
    if len(by_key) < len(pairs):
        raise ValueError("a key stands twice")
    return by_key


def _finite(value: object) -> float:
    """Return `value` if it is a finite number, else NaN. Booleans and text are no numbers."""
    if type(value) is int:
        return float(value) if abs(value) <= SEQ_MAX else math.nan
    return value if type(value) is float and math.isfinite(value) else math.nan


def _angle(value: object) -> float:
    angle = _finite(value)
    return angle if abs(angle) <= ANGLE_MAX_RAD else math.nan


class JointStreamDriver(DatagramDriver[JointStream]):
    """Driver of the joint stream: one `JointReading` per message."""

    name = "joints"
    bytes_max = DATAGRAM_BYTES_MAX
    silence_ns = 500_000_000
    """Timeout, ns: 50 messages at 100 Hz. A sender of 10 Hz passes."""
    period_ns: int | None = None

    def _new_stream(self) -> JointStream:
        return JointStream()
