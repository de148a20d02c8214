"""What all drivers have in common: counters, fingers, readings, links, words of a BioTac SP."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES, FINGERS
from graspd.drivers.base import (
    Driver,
    ElectrodeFault,
    Fact,
    LinkCause,
    TactileReading,
    sensor_rows,
)
from graspd.drivers.biotac import (
    CHANNELS,
    ERROR_WORDS,
    FORBIDDEN_COMMAND,
    PAC,
    PDC,
    SEQUENCES,
    TAC,
    TDC,
    channel_of,
    decode_words,
    encode_word,
    sample_command,
)
from graspd.drivers.can.driver import CanBridgeDriver
from graspd.drivers.datagrams.joints import JointStreamDriver
from graspd.drivers.link import Link, LinkState
from graspd.drivers.palm.stream import PalmDriver
from graspd.drivers.spi.driver import SpiBridgeDriver
from tests.kit.clock import Clock


@pytest.mark.parametrize(
    ("fingers", "sensors", "rows"),
    [
        (("ff", "mf", "th"), None, (0, 1, 2)),
        (("th", "ff"), ("ff", "mf", "th"), (2, 0)),
        (("lf",), FINGERS, (3,)),
    ],
)
def test_each_finger_maps_to_its_sensor_number_at_the_device(
    fingers: tuple[str, ...], sensors: tuple[str, ...] | None, rows: tuple[int, ...]
) -> None:
    assert sensor_rows(fingers, sensors) == rows


@pytest.mark.parametrize(
    ("counts", "faults"),
    [((3, 23), (3, 23)), ((3, 25), (3, 25)), ((24,), (24,)), ((3, 24), (2, 24))],
)
def test_counts_or_faults_of_a_wrong_shape_are_refused(
    counts: tuple[int, ...], faults: tuple[int, ...]
) -> None:
    assert ELECTRODES == 24
    with pytest.raises(ValueError, match="counts"):
        TactileReading(0, 0, np.zeros(counts, np.uint16), np.zeros(faults, np.uint8))


def test_fault_bits_have_the_values_stored_in_recordings() -> None:
    assert {fault.name: int(fault) for fault in ElectrodeFault} == {
        **{"MISSING": 1, "NOT_A_COUNT": 2, "PARITY": 4},
        **{"ERROR_WORD": 8, "HELD": 16, "CUT_OFF": 32},
    }


def test_made_ns_is_the_recorded_time_or_else_t_ns() -> None:
    arrays = np.zeros((1, 24), np.uint16), np.zeros((1, 24), np.uint8)
    assert TactileReading(5, 0, *arrays).made_ns == 5
    assert TactileReading(5, 0, *arrays, recorded_ns=0).made_ns == 0


@pytest.mark.parametrize(
    ("driver", "name", "period_ns", "silence_ns"),
    [
        (SpiBridgeDriver("/dev/serial/by-id/none", FINGERS), "spi", None, None),
        (CanBridgeDriver("virtual", "test-closed"), "can", None, None),
        (PalmDriver("udp://127.0.0.1:0"), "palm", 14_000_000, 140_000_000),
        (JointStreamDriver("udp://127.0.0.1:0"), "joints", None, 500_000_000),
    ],
    ids=["spi", "can", "palm", "joints"],
)
def test_an_unopened_driver_reports_closed_and_raises_on_reading(
    driver: Driver, name: str, period_ns: int | None, silence_ns: int | None
) -> None:
    assert (driver.name, driver.period_ns, driver.live) == (name, period_ns, True)
    assert getattr(driver, "silence_ns", None) == silence_ns
    assert driver.fileno() is driver.due_ns() is None
    assert not driver.exhausted
    assert driver.describe()["link"] == Fact("closed", LinkCause.UNKNOWN)
    assert driver.serials == {}
    assert not any(driver.counters.as_dict().values())
    with pytest.raises(RuntimeError, match="not open"):
        driver.read_ready()
    driver.close()
    driver.close()


def test_retry_waits_grow_to_one_second_until_link_is_up() -> None:
    clock = Clock()
    link = Link("spi")
    link.start(clock.now_ns)
    assert link.retry_ns == clock.now_ns
    waits_s = []
    for _ in range(2000):  # half an hour
        link.failed(LinkCause.UNKNOWN, "not there", clock.now_ns)
        assert link.retry_ns is not None
        waits_s.append((link.retry_ns - clock.now_ns) / 1e9)
        assert not link.is_due(link.retry_ns - 1)
        clock.now_ns = link.retry_ns
        assert link.is_due(clock.now_ns)
        assert link.is_due(clock.now_ns + 1)
    # From 50 ms on, each 1.8 times the one before.
    first_s = [0.05, 0.09, 0.162, 0.2916, 0.52488, 0.944784, 1.0]
    assert waits_s == pytest.approx(first_s + [1.0] * (2000 - 7))
    link.greeting()
    assert link.is_due(0), "nothing to wait for"
    link.up("a device", clock.now_ns)
    link.failed(LinkCause.UNKNOWN, "gone", clock.now_ns)
    assert link.retry_ns == clock.now_ns + 50_000_000


def test_each_reason_is_one_warning_per_outage(caplog: pytest.LogCaptureFixture) -> None:
    link = Link("spi")
    with caplog.at_level(logging.DEBUG):
        link.start(2_000_000_000)
        for _ in range(50):
            link.failed(LinkCause.UNKNOWN, "not there", 2_100_000_000)
            link.failed(LinkCause.UNKNOWN, "wrong version", 2_100_000_000)
        assert link.losses == 0, "it was never up"
        link.up("a device", 5_250_000_000)
        assert (link.state, link.reason, link.retry_ns) == (LinkState.UP, None, None)
        link.failed(LinkCause.UNKNOWN, "gone", 8_000_000_000)
        link.failed(LinkCause.UNKNOWN, "not there", 8_100_000_000)
        assert (link.losses, link.reason) == (1, "not there")
        link.up("a device", 9_000_000_000)
    told = [record.getMessage() for record in caplog.records if record.levelno >= logging.INFO]
    assert told == [
        "spi: not there; trying again",
        "spi: wrong version; trying again",
        "spi: up after 3.25 s: a device",
        "spi: gone; trying again",
        "spi: not there; trying again",
        "spi: up after 1.00 s: a device",
    ]


def test_at_most_eight_reasons_per_outage_are_warnings(
    caplog: pytest.LogCaptureFixture,
) -> None:
    link = Link("spi")
    link.start(0)
    with caplog.at_level(logging.WARNING):
        for number in range(1000):
            link.failed(LinkCause.UNKNOWN, f"reason {number}", 0)
    assert len(caplog.records) == 8


# Manual table 7.
COMMANDS = {
    **{0: 0x80, 1: 0x83, 2: 0x85, 3: 0x86},
    **{17: 0xA2, 18: 0xA4, 19: 0xA7, 20: 0xA8, 21: 0xAB, 22: 0xAD, 23: 0xAE, 24: 0xB0},
    **{25: 0xB3, 26: 0xB5, 27: 0xB6, 28: 0xB9, 29: 0xBA, 30: 0xBC, 31: 0xBF, 32: 0xC1},
    **{33: 0xC2, 34: 0xC4, 35: 0xC7, 36: 0xC8, 37: 0xCB, 38: 0xCD, 39: 0xCE, 40: 0xD0},
}
# Cross-checked with the table of the C library, compiled and run.
WORDS = """
0:0101 1:0108 31:01F8 32:0201 63:02F8 64:0401 100:0720 137:0849 500:1FA1 981:3DA8 1000:3E40
1234:4C91 1760:6E01 2047:7FF8 2048:8001 2602:A251 2815:AEF8 3000:BAC1 3099:C1D9 4000:FB01
4064:FE01 4094:FEF1 4095:FEF8 2713:A8C8 2391:94B9
"""
VECTORS = {int(count): int(word, 16) for count, word in (pair.split(":") for pair in WORDS.split())}


def words(*values: int) -> NDArray[np.uint16]:
    return np.array(values, dtype=np.uint16)


def test_channels_and_commands_are_those_of_the_manual() -> None:
    assert set(CHANNELS) == set(COMMANDS)
    assert {channel: sample_command(channel) for channel in COMMANDS} == COMMANDS
    channels = {command: channel_of(command) for command in range(256)}
    known = {channel: command for command, channel in channels.items() if channel is not None}
    assert known == COMMANDS


def test_the_command_that_hangs_a_sensor_is_never_made() -> None:
    assert FORBIDDEN_COMMAND == 0xA1
    assert channel_of(0xA1) is None
    made = []
    for channel in range(-1, 300):
        try:
            made.append(sample_command(channel))
        except ValueError:
            assert channel not in COMMANDS
    assert 0xA1 not in made
    with pytest.raises(ValueError, match="no channel 16"):
        sample_command(16)


def test_counts_become_the_response_words_of_the_manual_and_back() -> None:
    assert {count: encode_word(count) for count in VECTORS} == VECTORS
    counts, faults = decode_words(words(*VECTORS.values()))
    assert counts.tolist() == list(VECTORS)
    assert not faults.any()


def test_an_error_word_never_becomes_a_count() -> None:
    codes = {0xA52D, 0xA558, 0xA552, 0xA545, 0xA53F, 0xA52E, 0xA55F, 0xA557}
    assert set(ERROR_WORDS) == codes
    counts, faults = decode_words(words(*codes))
    assert faults.tolist() == [ElectrodeFault.ERROR_WORD] * 8
    assert not counts.any()


def test_words_of_an_undriven_line_are_flagged_missing() -> None:
    counts, faults = decode_words(words(0x0000, 0xFFFF))
    assert faults.tolist() == [ElectrodeFault.MISSING] * 2
    assert not counts.any()


def test_every_count_decodes_and_any_single_bit_error_is_flagged() -> None:
    _, faults = decode_words(np.arange(1 << 16, dtype=np.uint16))
    assert (faults == 0).mean() == 0.0625
    good = words(*(encode_word(count) for count in range(4096)))
    counts, faults = decode_words(good)
    assert counts.tolist() == list(range(4096))
    assert not faults.any()
    for bit in range(16):
        counts, faults = decode_words(good ^ np.uint16(1 << bit))
        assert faults.all()
        assert not counts.any()


def test_sequences_are_those_of_the_manual() -> None:
    electrodes = list(range(17, 41))
    assert list(SEQUENCES["electrodes"]) == electrodes
    assert sorted(SEQUENCES["all"]) == [0, 1, 2, 3, *electrodes]
    lengths = (SEQUENCES["interleaved"], SEQUENCES["all"], SEQUENCES["electrodes"])
    assert [len(sequence) for sequence in lengths] == [54, 28, 24]
    assert set(SEQUENCES["interleaved"][1::2]) == {PAC}
    assert list(SEQUENCES["interleaved"][::2]) == [*electrodes, PDC, TAC, TDC]
