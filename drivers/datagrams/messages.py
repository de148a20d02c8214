"""JSON datagrams, one object each, put in order by the sender's number and time."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from graspd.drivers.link import SenderClock
from graspd.drivers.udp import DatagramCounters

DATAGRAM_BYTES_MAX = 4096
"""Longest message, bytes; 28 joints in full precision or five fingers take about 900."""
SHOWN_BYTES_MAX: Final = 80
"""Most bytes of a message in the log."""
SILENCE_NS: Final = 500_000_000
"""Timeout of a link, ns: 50 messages at 100 Hz. A sender of 10 Hz passes."""
NUMBER_MAX: Final = (1 << 63) - 1
"""Largest absolute value of a number that is read."""
SEQ_JUMP_MAX: Final = 1000
"""Most messages that a gap in `seq` counts as lost; at a larger gap the sender restarted."""
OLD_MESSAGES_MAX: Final = 10
"""Most old messages in a row, each newer than the last, that count as delayed. With one more the
sender has restarted."""

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class MessageCounters(DatagramCounters):
    """Counters of messages. `missed_readings` stays 0 if the sender sends no `seq`."""

    bad_messages: int = 0
    old_messages: int = 0
    """Messages that arrived twice or after a later one; dropped."""
    restarts: int = 0
    unknown_names: int = 0
    """Names that no joint or finger of a Shadow hand has; left out."""


class Stamp(NamedTuple):
    """Place of a message in its sender's stream."""

    seq: int | None
    """Number of the message, one more each time; None if the sender sends none."""
    t_s: float | None
    """Sender's own time, s, from any zero; None if the sender sends none."""

    def is_after(self, other: Stamp) -> bool:
        """Return False if the number or the time, where both stamps have one, is not greater than
        the other's."""
        pairs = zip(self, other, strict=True)
        return all(own is None or its is None or own > its for own, its in pairs)


UNSTAMPED: Final = Stamp(None, None)


class Message(NamedTuple):
    """One message."""

    stamp: Stamp
    hand: object
    """Name of the hand; None if the sender sends none."""
    values: Mapping[str, Any]
    """Measured values by name."""


def write_message(stamp: Stamp, **fields: object) -> bytes:
    """Return the datagram of a JSON object with `stamp` as `seq` and `t`, and `fields`.

    Fields of None are left out. Raises `ValueError` for NaN.
    """
    whole = {"seq": stamp.seq, "t": stamp.t_s, **fields}
    message = {name: value for name, value in whole.items() if value is not None}
    return json.dumps(message, allow_nan=False, separators=(",", ":")).encode()


def read_message(data: bytes, key: str, counters: MessageCounters) -> Message | None:
    """Return a datagram's message, whose values are the object `key`; None if it is not valid.

    Invalid messages are counted, and the log says what is wrong with the first. If `key` is
    `counts`, the message must have `seq` or `t`.
    """
    try:
        return _message(data, key)
    except (ValueError, RecursionError) as error:  # not UTF-8, not JSON, or nested without end
        drop(data, error, counters)
        return None


def drop(data: bytes, why: object, counters: MessageCounters) -> None:
    """Count a message that is not valid, and log the reason, `why`, for the first one."""
    if not counters.bad_messages:
        shown = data[:SHOWN_BYTES_MAX].decode(errors="replace")
        _log.warning("datagrams: a message is dropped: %s: %r", why, shown)
    counters.bad_messages += 1


def _message(data: bytes, key: str) -> Message:
    if len(data) > DATAGRAM_BYTES_MAX:
        raise ValueError(f"it is longer than {DATAGRAM_BYTES_MAX} bytes")
    # JSON has no NaN. As text it makes only its own value invalid.
    fields = json.loads(data.decode(), object_pairs_hook=_without_doubles, parse_constant=str)
    if not isinstance(fields, dict) or not isinstance(fields.get(key), dict):
        raise ValueError(f"it is not an object with an object `{key}`")
    seq, t_s = fields.get("seq"), fields.get("t")
    if seq is not None and (type(seq) is not int or not 0 <= seq <= NUMBER_MAX):
        raise ValueError(f"`seq` is {seq!r}, and not an integer from 0 on")
    if t_s is not None:
        t_s = number(t_s)
        if math.isnan(t_s):
            raise ValueError(f"`t` is {fields['t']!r}, and not a number of seconds")
    if key == "counts" and seq is None and t_s is None:
        raise ValueError("it has neither `seq` nor `t`")
    return Message(Stamp(seq, t_s), fields.get("hand"), fields[key])


def number(value: object) -> float:
    """Return `value` if it is a number up to +-`NUMBER_MAX`, else NaN; also NaN for booleans."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    return float(value) if abs(value) <= NUMBER_MAX else math.nan


class Order:
    """Finds which messages of a sender are new and when they were made, and counts lost ones."""

    def __init__(self, counters: MessageCounters) -> None:
        self.interrupted = False
        """True if the sender's stream was interrupted since the last `take_interrupted`."""
        self._clock = SenderClock()
        self._counters = counters
        self._last = UNSTAMPED
        """Newest number and time."""
        self._last_old = UNSTAMPED
        self._old_in_a_row = 0

    def made_ns(self, data: bytes, stamp: Stamp, t_ns: int) -> int | None:
        """Return when a message that arrived at `t_ns` was made, by its `t` and the quickest
        message; None if it is dropped: it is not new, or its `t` leaps. `data`: for the log."""
        restarts = self._counters.restarts
        if not self.admits(stamp):
            return None
        self.interrupted |= self._counters.restarts > restarts
        leaps = self._clock.leaps(stamp.t_s, t_ns)
        made_ns = self._clock.made_ns(stamp.t_s, t_ns)
        if not leaps:
            return made_ns
        drop(data, "`t` leaps: is it in seconds?", self._counters)
        self.interrupted = True
        return None

    def take_interrupted(self) -> bool:
        """Return `interrupted`, and clear it: the reading that is made now has it."""
        interrupted, self.interrupted = self.interrupted, False
        return interrupted

    def admits(self, stamp: Stamp) -> bool:
        """Return True if the message is newer than all before, or the first after a restart.

        Counts old messages, restarts, and messages missed before this one.
        """
        if not stamp.is_after(self._last):
            if not self._has_restarted(stamp):
                self._counters.old_messages += 1
                return False
            self._counters.restarts += 1
            self._last = UNSTAMPED
        last = self._last
        if stamp.seq is not None and last.seq is not None:
            self._count_gap(stamp.seq - last.seq - 1)
        seq = last.seq if stamp.seq is None else stamp.seq
        self._last = Stamp(seq, last.t_s if stamp.t_s is None else stamp.t_s)
        self._old_in_a_row = 0
        return True

    def _has_restarted(self, stamp: Stamp) -> bool:
        if not stamp.is_after(self._last_old):
            self._old_in_a_row = 0
        self._old_in_a_row += 1
        self._last_old = stamp
        return self._old_in_a_row > OLD_MESSAGES_MAX

    def _count_gap(self, missed: int) -> None:
        if missed > SEQ_JUMP_MAX:
            self._counters.restarts += 1
        else:
            self._counters.missed_readings += missed


def _without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    by_key = dict(pairs)
    if len(by_key) < len(pairs):
        raise ValueError("a key stands twice")
    return by_key
