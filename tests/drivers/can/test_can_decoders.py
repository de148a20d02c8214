"""Whose frames are taken, and under which counter every other one is dropped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.drivers.can.formats import CanFormat, SweepFrame, SweepStatus, encode_sample
from graspd.drivers.can.frames import EXTENDED, FD, CanFrame
from graspd.drivers.can.readings import CanCounters
from graspd.drivers.can.stream import make_decoder
from graspd.drivers.twins.can import SAMPLE_ID
from tests.drivers.can.can_standin import decoder
from tests.drivers.can.can_words import samples, truth, word
from tests.drivers.can.test_can_formats import E1_SAMPLE, SWEEP_EXAMPLE


@pytest.mark.parametrize(
    ("frame", "counter"),
    [
        (CanFrame(0x101, E1_SAMPLE), "foreign_frames"),
        (CanFrame(0x100, E1_SAMPLE, EXTENDED), "foreign_frames"),
        (CanFrame(0x100, E1_SAMPLE[:5]), "wrong_length_frames"),
        (CanFrame(0x100, E1_SAMPLE + b"\0"), "wrong_length_frames"),
        (CanFrame(0x100, b""), "wrong_length_frames"),
        (CanFrame(0x100, b"\xa1" + E1_SAMPLE[1:]), "unknown_commands"),
        (CanFrame(0x100, b"\x61" + E1_SAMPLE[1:]), "unknown_commands"),  # reads a parameter
        (CanFrame(0x100, b"\x88" + E1_SAMPLE[1:]), "unknown_commands"),  # even parity
        (CanFrame(0x100, E1_SAMPLE, FD), "malformed_frames"),
        (CanFrame(0x100, E1_SAMPLE), "accepted_frames"),
    ],
)
def test_every_dropped_sample_frame_is_counted_by_its_reason(frame: CanFrame, counter: str) -> None:
    made, counters = decoder(CanFormat.SYNTOUCH)
    made.push(frame, 0)
    assert getattr(counters, counter) == 1
    assert sum(counters.as_dict().values()) == 1


def changed(at: int, value: int) -> bytes:
    return SWEEP_EXAMPLE[:at] + bytes((value,)) + SWEEP_EXAMPLE[at + 1 :]


@pytest.mark.parametrize(
    ("frame", "counter"),
    [
        (CanFrame(0x104, SWEEP_EXAMPLE, FD), "accepted_frames"),
        (CanFrame(0x105, SWEEP_EXAMPLE, FD), "foreign_frames"),
        (CanFrame(0x102, SWEEP_EXAMPLE, FD), "foreign_frames"),  # rf, which the scene lacks
        (CanFrame(0x104, SWEEP_EXAMPLE, FD | EXTENDED), "foreign_frames"),
        (CanFrame(0x100, SWEEP_EXAMPLE, FD), "malformed_frames"),  # the id of ff, the data of th
        (CanFrame(0x104, SWEEP_EXAMPLE), "malformed_frames"),
        *((CanFrame(0x104, changed(0, it), FD), "unknown_versions") for it in (0, 2)),
        *(
            (CanFrame(0x104, changed(at, value), FD), "malformed_frames")
            for at, value in ((1, 2), (1, 5), (56, 8), (57, 1), (58, 1), (63, 1), (63, 0x80))
        ),
        *(
            (CanFrame(0x104, SWEEP_EXAMPLE[:length], FD), "wrong_length_frames")
            for length in (0, 1, 8, 48, 63)
        ),
    ],
)
def test_every_dropped_sweep_frame_is_counted_by_its_reason(frame: CanFrame, counter: str) -> None:
    made, counters = decoder(CanFormat.SWEEP_FD)
    made.push(frame, 0)
    assert getattr(counters, counter) == 1
    assert sum(counters.as_dict().values()) == 1


@pytest.mark.parametrize(
    "unsound",
    [
        CanFrame(0x7FF, bytes(7)),
        CanFrame(0x7FF, E1_SAMPLE[:6]),
        CanFrame(0x7FF, b"\x00" + E1_SAMPLE[1:]),
        CanFrame(0x7FF, E1_SAMPLE[:1] + b"\xff" * 6),  # no sensor is there
        CanFrame(0x7FF, E1_SAMPLE[:1] + bytes.fromhex("A52D A8C8 94B9")),  # an error word
        CanFrame(0x7FF, E1_SAMPLE[:1] + bytes.fromhex("A250 A8C8 94B9")),  # even parity
        CanFrame(0x7FF, E1_SAMPLE, FD),
    ],
)
def test_without_an_id_that_of_the_first_sound_sample_is_taken(unsound: CanFrame) -> None:
    made, counters = decoder(CanFormat.SYNTOUCH, None)
    made.push(unsound, 0)
    assert made.arbitration_id is None
    assert counters.foreign_frames == 1
    made.push(CanFrame(0x321, E1_SAMPLE[:1] + bytes.fromhex("FFFF A8C8 94B9")), 0)
    assert made.arbitration_id == 0x321
    made.push(CanFrame(0x322, E1_SAMPLE), 0)
    made.push(CanFrame(0x321, E1_SAMPLE, EXTENDED), 0)
    made.push(CanFrame(0x321, E1_SAMPLE[:6]), 0)
    made.push(CanFrame(0x321, bytes(7)), 0)
    assert (counters.accepted_frames, counters.foreign_frames) == (1, 3)
    assert (counters.wrong_length_frames, counters.unknown_commands) == (1, 1)


@pytest.mark.parametrize("configured", [None, 0x100])
def test_an_id_that_was_heard_is_forgotten_with_the_link(configured: int | None) -> None:
    made, counters = decoder(CanFormat.SYNTOUCH, configured)
    made.push(CanFrame(0x100, E1_SAMPLE), 0)
    made.interrupt()
    assert made.arbitration_id == configured
    made.push(CanFrame(0x12345, E1_SAMPLE, EXTENDED), 0)
    assert counters.foreign_frames == (configured is not None)


def test_a_board_that_pads_its_frames_is_read_when_told_so() -> None:
    made, counters = decoder(CanFormat.SYNTOUCH, data_length=8)
    readings: list[TactileReading] = []
    for channel, words, t_ns in samples(0):
        readings += made.push(CanFrame(SAMPLE_ID, encode_sample(channel, words) + b"\x55"), t_ns)
    assert (readings[0].counts == truth(0)).all()
    assert counters.faulty_readings == 0


ORDER = ("th", "ff", "mf")
"""The board's sensors: its first word is the thumb's."""


def with_sensors(
    fingers: Sequence[str], spoilt: Mapping[int, bytes] | None = None
) -> tuple[list[TactileReading], CanCounters]:
    """What becomes of two sweeps of `ORDER`. `spoilt`: words of channels of the first sweep."""
    counters = CanCounters()
    made = make_decoder(
        fingers, counters, sensors=ORDER, arbitration_id=SAMPLE_ID, sequence="electrodes"
    )
    changed = [(at, (spoilt or {}).get(at, words), t_ns) for at, words, t_ns in samples(0)]
    readings: list[TactileReading] = []
    for channel, words, t_ns in (*changed, *samples(1)):
        readings += made.push(CanFrame(SAMPLE_ID, encode_sample(channel, words)), t_ns)
    assert (len(readings), counters.wrong_length_frames, counters.lost_frames) == (2, 0, 0)
    return readings, counters


@pytest.mark.parametrize("fingers", [("ff", "mf", "th"), ("th", "ff", "mf"), ("mf", "th"), ("ff",)])
def test_rows_are_fingers_and_words_are_sensors(fingers: Sequence[str]) -> None:
    readings, _ = with_sensors(fingers)
    rows = [ORDER.index(finger) for finger in fingers]
    for sweep, reading in enumerate(readings):
        assert not reading.faults.any()
        assert (reading.counts == truth(sweep)[rows]).all()


@pytest.mark.parametrize(("fingers", "flagged"), [(("ff", "mf", "th"), [[2, 4]]), (("ff",), [])])
def test_a_damaged_word_is_flagged_at_its_finger_only(
    fingers: Sequence[str], flagged: list[list[int]]
) -> None:
    channel, words, _ = samples(0)[4]
    readings, counters = with_sensors(fingers, {channel: bytes([words[0] ^ 1]) + words[1:]})
    assert np.argwhere(readings[0].faults == ElectrodeFault.PARITY).tolist() == flagged
    assert np.count_nonzero(readings[0].faults) == len(flagged)
    assert counters.parity_words == counters.faulty_readings == len(flagged)


@pytest.mark.parametrize(
    ("sensors", "says"),
    [(("ff", "mf"), "not in"), (("ff", "mf", "th", "rf"), "9 bytes cannot carry 4 sensors")],
)
def test_sensors_that_cannot_be_are_refused(sensors: Sequence[str], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        make_decoder(("ff", "mf", "th"), CanCounters(), sensors=sensors)


def test_a_tick_that_stands_and_a_sweep_that_began_late_are_counted() -> None:
    made, counters = decoder(CanFormat.SWEEP_FD)
    for sequence in range(3):
        for finger in (0, 1, 4):
            sweep = SweepFrame(finger, sequence, 77, word(2602) * 24, SweepStatus.OVERRUN)
            made.push(CanFrame(SAMPLE_ID + finger, sweep.to_bytes(), FD), sequence)
    assert (counters.stuck_ticks, counters.faulty_readings) == (6, 2)
    assert counters.overruns == 9
    assert counters.readings == 3
