"""Sweeps of a bridge -> readings, from one START to the loss of the link. No I/O."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.base import ELECTRODES, DriverCounters, ElectrodeFault, TactileReading
from drivers.biotac import COUNT_OF_WORD, FAULT_OF_WORD, channel_of, electrode_columns
from drivers.spi.clock import DeviceClock
from drivers.spi.messages import Hello, Sweep

SEQ_HALF, SEQ_END = 1 << 31, 1 << 32
SEQ_FIRST_MAX = 1_000
"""A first sweep with a higher number was not lost after START: the bridge was sweeping before."""


@dataclass(slots=True)
class BridgeCounters(DriverCounters):
    """What a bridge's driver counts since `open`: every kind of drop and fault."""

    bytes: int = 0
    frames: int = 0
    bad_cobs: int = 0
    bad_crc: int = 0
    too_long: int = 0
    """Damaged frames by what gave them away, see `drivers.spi.framing`. All are dropped."""
    unknown_frames: int = 0
    """Whole frames of a type that no bridge of version 1 sends."""
    bad_frames: int = 0
    """Whole frames whose content makes no sense or does not fit the HELLO."""
    duplicates: int = 0
    """Sweeps that came twice, the second dropped."""
    reordered: int = 0
    """Sweeps that came after a later one, dropped, and so also counted as missed."""
    stale_sweeps: int = 0
    """Sweeps from before START, dropped."""
    parity_words: int = 0
    """Words of electrodes with bad parity, never a reading, and so on."""
    error_words: int = 0
    missing_words: int = 0
    """Words of electrodes that nothing drove; those of absent sensors are not counted."""
    absent_sensors: int = 0
    """Sensors without serial number, one per sweep and sensor."""
    link_losses: int = 0
    """Times that the link was up and was lost."""
    link_failures: int = 0
    """Times that opening or greeting failed or the link was lost."""
    refused_bridges: int = 0
    """Greetings of a bridge with another version, layout or number of sensors."""
    restarts: int = 0
    """Times that the bridge said in the middle that it was reset."""
    unanswered_pings: int = 0
    host_tx_dropped: int = 0
    """Frames to the bridge for which there was no room."""
    clock_faults: int = 0
    """Times that the bridge's clock stopped being trusted."""
    clock_fallbacks: int = 0
    """Readings whose time is a cautious guess from their arrival."""
    bridge_overruns: int = 0
    bridge_tx_dropped: int = 0
    bridge_rx_errors: int = 0
    """The bridge's own counters, since its reset, as it last told them."""


class SweepDecoder:
    """Makes readings of the sweeps after one HELLO, which tells slots, sensors and clock."""

    def __init__(
        self, hello: Hello, sensors: Sequence[int], counters: BridgeCounters, next_seq: int
    ) -> None:
        """`sensors` names the bridge's sensor, from 0, of each row of a reading.

        The first reading made has number `next_seq`.
        """
        self.clock = DeviceClock(hello.tick_hz)
        self.next_seq = next_seq
        self.hello = hello
        """What the bridge said of itself at the start."""
        self.longest_ticks = 0
        """Longest time that a sweep took, ticks."""
        self._sensors = tuple(sensors)
        self._counters = counters
        self._bridge_seq: int | None = None
        columns = electrode_columns(map(channel_of, hello.commands))
        samples = hello.slots * hello.sensors
        # Where each electrode's word is in a sweep; one that is not sampled gets the word after
        # the last, which nothing drives.
        self._source = np.full((len(sensors), ELECTRODES), samples, dtype=np.intp)
        for row, sensor in enumerate(sensors):
            self._source[row, columns[:, 1]] = columns[:, 0] * hello.sensors + sensor
        self._words = np.zeros(samples + 1, dtype=np.intp)
        self._is_sampled = self._source < samples
        self._sound = bytes(self._source.size)
        """Faults of a reading without any."""
        self._sweep = self._words[:-1].reshape(hello.slots, hello.sensors)

    def fits(self, hello: Hello) -> bool:
        """Whether a later HELLO describes the same sampling."""
        ours = self.hello
        return (hello.sensors, hello.commands, hello.tick_hz, hello.period_ticks) == (
            ours.sensors,
            ours.commands,
            ours.tick_hz,
            ours.period_ticks,
        )

    def round_trip(self, hello: Hello, sent_ns: int, received_ns: int) -> None:
        """Take in the answer to a PING, for the clock."""
        faults = self.clock.faults
        self.clock.round_trip(hello.tick, sent_ns, received_ns)
        self._counters.clock_faults += self.clock.faults - faults

    def reading(self, sweep: Sweep, arrival_ns: int, idle_ns: int) -> TactileReading | None:
        """The reading of a sweep, or None for one that is not newer or does not fit.

        `idle_ns` is when nothing was waiting to be read for the last time before its arrival.
        """
        if sweep.words.shape != self._sweep.shape:
            self._counters.bad_frames += 1
            return None
        if not self._is_next(sweep):
            return None
        self.longest_ticks = max(self.longest_ticks, sweep.tick_end - sweep.tick_start)
        faults, fallbacks = self.clock.faults, self.clock.fallbacks
        t_ns = self.clock.host_ns(sweep.tick_end, arrival_ns, idle_ns)
        self._counters.clock_faults += self.clock.faults - faults
        self._counters.clock_fallbacks += self.clock.fallbacks - fallbacks
        return TactileReading(t_ns, self.next_seq - 1, *self._counts_and_faults(sweep))

    def _is_next(self, sweep: Sweep) -> bool:
        """Whether the sweep is newer than all before it; counts what is missing between."""
        if self._bridge_seq is None:
            if sweep.tick_start < self.hello.tick:
                self._counters.stale_sweeps += 1  # it was under way when STOP arrived
                return False
            missed = sweep.seq if sweep.seq <= SEQ_FIRST_MAX else 0
        else:
            step = (sweep.seq - self._bridge_seq) % SEQ_END
            if step == 0 or step >= SEQ_HALF:
                self._counters.duplicates += step == 0
                self._counters.reordered += step != 0
                return False
            missed = step - 1
        self._bridge_seq = sweep.seq
        self._counters.missed_readings += missed
        self.next_seq += missed + 1
        return True

    def _counts_and_faults(self, sweep: Sweep) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        """Shape (fingers, 24) each; whatever is not sampled or not there is missing."""
        self._sweep[...] = sweep.words
        words = self._words[self._source]
        counts, faults = COUNT_OF_WORD[words], FAULT_OF_WORD[words]
        present = [sweep.present >> sensor & 1 for sensor in self._sensors]
        absent = [row for row, is_there in enumerate(present) if not is_there]
        if absent:
            counts[absent] = 0
            faults[absent] = int(ElectrodeFault.MISSING)
        self._count(faults, absent)
        return counts, faults

    def _count(self, faults: NDArray[np.uint8], absent: list[int]) -> None:
        counters = self._counters
        counters.readings += 1
        counters.absent_sensors += len(absent)
        if faults.tobytes() == self._sound:
            return
        counters.faulty_readings += 1
        read = self._is_sampled.copy()
        read[absent] = False
        of_words = faults[read]
        counters.parity_words += int((of_words == ElectrodeFault.PARITY).sum())
        counters.error_words += int((of_words == ElectrodeFault.ERROR_WORD).sum())
        counters.missing_words += int((of_words == ElectrodeFault.MISSING).sum())
