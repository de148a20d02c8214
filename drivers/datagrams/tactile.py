"""The tactile stream: one JSON object of counts per datagram; see deploy/wire/TACTILE.md."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from graspd.biotac import COUNT_MAX, ELECTRODES, FINGERS
from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.drivers.datagrams.messages import (
    DATAGRAM_BYTES_MAX,
    SHOWN_BYTES_MAX,
    SILENCE_NS,
    Message,
    MessageCounters,
    Order,
    read_message,
)
from graspd.drivers.udp import DatagramDriver

_log = logging.getLogger(__name__)

LATE_NS: Final = 100_000_000
"""Delay from which on a message counts as late, ns: the usual age limit."""


@dataclass(slots=True)
class TactileCounters(MessageCounters):
    """Counters of tactile messages."""

    other_hands: int = 0
    """Messages that name another hand; dropped."""
    late_messages: int = 0
    """Messages that took over 100 ms longer than the quickest; their readings have that age."""
    absent_fingers: int = 0
    """Fingers of the hand that a message lacks, or with all counts 0 or all 4095."""
    wrong_sizes: int = 0
    """Fingers whose value is not a list of 24 counts, such as those of another sensor."""
    bad_counts: int = 0
    """Values that are not a whole number in 0..4095."""


class TactileStream:
    """Decoder of one sender's tactile messages into readings. A `DatagramStream`."""

    sender_kind = "tactile stream"

    def __init__(self, fingers: Sequence[str], hand: str) -> None:
        """`fingers`: the rows of a reading. `hand`: its name; messages of another are dropped."""
        self.counters = TactileCounters()
        self._fingers = tuple(fingers)
        self._hand = hand
        self._order = Order(self.counters)

    def interrupt(self) -> None:
        """Mark the next reading as interrupted. The last number and time stay, so that no old
        message is mistaken for new."""
        self._order.interrupted = self.counters.readings > 0

    def receive(self, data: bytes, t_ns: int) -> list[TactileReading] | None:
        """Return the reading of a message that arrived at `t_ns`; None if it is dropped.

        The reading's time is when the message was made, by its `t` and the quickest message.
        """
        counters = self.counters
        message = read_message(data, "counts", counters)
        if message is None:
            return None
        if message.hand not in (None, self._hand):
            if not counters.other_hands:
                _log.warning("datagrams: a message names the hand %r: dropped", message.hand)
            counters.other_hands += 1
            return None
        made_ns = self._order.made_ns(data, message.stamp, t_ns)
        if made_ns is None:
            return None
        counters.late_messages += t_ns - made_ns > LATE_NS
        return [self._reading(message, made_ns)]

    def _reading(self, message: Message, t_ns: int) -> TactileReading:
        counters = self.counters
        counters.unknown_names += sum(name not in FINGERS for name in message.values)
        shape = (len(self._fingers), ELECTRODES)
        counts, faults = np.zeros(shape, dtype=np.uint16), np.zeros(shape, dtype=np.uint8)
        for row, finger in enumerate(self._fingers):
            values = self._counts(message.values.get(finger))
            if values is None:
                faults[row] = ElectrodeFault.MISSING
                continue
            bad = [value is None for value in values]
            counters.bad_counts += sum(bad)
            faults[row, bad] = ElectrodeFault.NOT_A_COUNT
            counts[row] = [value or 0 for value in values]
        seq = counters.readings + counters.missed_readings
        counters.readings += 1
        if faults.any():
            if not counters.faulty_readings:
                shown = str(dict(message.values))[:SHOWN_BYTES_MAX]
                _log.warning("datagrams: not 24 counts in 0..4095 of each finger: %s", shown)
            counters.faulty_readings += 1
        interrupted = self._order.take_interrupted()
        return TactileReading(t_ns, seq, counts, faults, interrupted=interrupted)

    def _counts(self, values: object) -> list[int | None] | None:
        """Return the 24 counts of a finger's `values` in a message, None in place of a wrong one.

        None if there are not 24, or the finger has no sensor: no values, all 0, or all 4095.
        """
        if values is None:
            self.counters.absent_fingers += 1
            return None
        if not isinstance(values, list) or len(values) != ELECTRODES:
            self.counters.wrong_sizes += 1
            return None
        counts = [_count(value) for value in values]
        if set(counts) in ({0}, {COUNT_MAX}):
            self.counters.absent_fingers += 1
            return None
        return counts


def _count(value: object) -> int | None:
    """Return a whole number in 0..4095, such as 2795 or 2795.0; None for anything else."""
    if type(value) is float and value.is_integer():
        value = int(value)
    return value if type(value) is int and 0 <= value <= COUNT_MAX else None


class TactileStreamDriver(DatagramDriver[TactileStream]):
    """Driver of the tactile stream: one `TactileReading` per message."""

    name = "datagrams"
    bytes_max = DATAGRAM_BYTES_MAX
    silence_ns = SILENCE_NS
    period_ns: int | None = None

    def __init__(
        self,
        source: str,
        fingers: Sequence[str] = ("ff", "mf", "th"),
        hand: str = "right",
        *,
        only_from: str | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`source`: `udp://ADDRESS:PORT` to receive on. `fingers`: the rows of a reading. `hand`:
        its name; messages that name another one are dropped. `only_from`: IP address whose
        datagrams are taken; None: any. `clock`: monotonic ns."""
        self._fingers = tuple(fingers)
        self._hand = hand
        super().__init__(source, only_from=only_from, clock=clock)

    def _new_stream(self) -> TactileStream:
        return TactileStream(self._fingers, self._hand)
