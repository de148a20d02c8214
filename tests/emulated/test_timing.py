"""Times on the sensors' bus keep the manual's limits at every clock of the chip."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from graspd.daemon.commands.doctor import BRIDGE_VENDOR
from graspd.drivers.biotac import ERROR_WORDS
from tests.drivers.spi.bridge_c import (
    ELECTRODE_COMMANDS,
    PAC,
    PDC,
    SWEEP,
    TAC,
    TDC,
    counts_of,
    pattern,
    seq_of,
    words_of,
)
from tests.emulated.board import (
    BOARD_ID,
    Board,
    Timing,
    Transaction,
    serials,
    sweeps,
    timing,
    transactions,
)
from tests.emulated.conftest import Image

pytestmark = pytest.mark.timeout(600)

PERIOD_MS = 10.0
SWEEPS = 20
COMMANDS = {
    "electrodes": ELECTRODE_COMMANDS,
    "all": bytes([PAC, PDC, TAC, TDC]) + ELECTRODE_COMMANDS,
    "interleaved": b"".join(bytes([one, PAC]) for one in (*ELECTRODE_COMMANDS, PDC, TAC, TDC)),
}
"""First command byte of each slot, by the sequence's name (manual table 12)."""
SETTLE_US, GAP_US = 50.0, 5.0
"""Least times between a command and an answer, and after an answer (manual figure 14)."""
SPI_HZ_MIN, SPI_HZ_ASKED = 500_000, 4_400_000
"""Slowest SPI clock of a sensor (manual section 8.2), and the clock that the firmware requests."""
LATE_US = 20.0
"""Most by which a sweep may begin late, us: a round of the firmware's loop, with USB."""
OWN_TIME = 1.25
"""Longest time of a sweep, as a multiple of that of its bits and waits."""


@dataclass(frozen=True)
class Setting:
    clock_mhz: int = 125
    sensors: int = 3
    sequence: str = "electrodes"

    def __str__(self) -> str:
        return f"{self.clock_mhz}MHz-{self.sensors}-{self.sequence}"


SETTINGS = (
    Setting(),
    Setting(133, 1, "all"),
    Setting(200, 5, "interleaved"),
)


@dataclass(frozen=True)
class Run:
    """Result of a board with this setting: its state, the greeting, then some sweeps."""

    setting: Setting
    state: dict[str, Any]
    hello: bytes
    greeting: list[Transaction]
    """Transactions on the bus while the board searched for sensors."""
    said: list[bytes]
    """Payloads of the SWEEPs that the host received."""
    swept: list[list[Transaction]]
    """Transactions on the bus, by sweep."""

    @property
    def timing(self) -> Timing:
        return timing(self.swept, PERIOD_MS * 1000.0)


@pytest.fixture(scope="module", params=SETTINGS, ids=str)
def run(
    request: pytest.FixtureRequest, image: Image, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Run]:
    setting: Setting = request.param
    folder = tmp_path_factory.mktemp("events")
    with Board() as board:
        board.power(image(setting.sensors, setting.clock_mhz, setting.sequence))
        with board.recording(folder) as greeting:
            hello = board.hello()
        board.start()
        with board.recording(folder) as swept:
            board.run(PERIOD_MS * SWEEPS)
        commands = COMMANDS[setting.sequence]
        yield Run(
            setting,
            board.do("state"),
            hello,
            transactions(greeting()),
            board.take(SWEEP),
            sweeps(transactions(swept()), len(commands), setting.sensors),
        )


def test_the_emulated_board_reports_its_build_options(run: Run) -> None:
    sensors = run.setting.sensors
    assert run.state["sys_hz"] == run.setting.clock_mhz * 1_000_000
    assert (run.state["spi_mode"], run.state["spi_bits"]) == (0, 8)
    assert run.state["resets"] == 0
    device = bytes.fromhex(run.state["device"])
    assert int.from_bytes(device[8:10], "little") == BRIDGE_VENDOR
    assert run.state["strings"][-1] == BOARD_ID
    assert run.hello[23:39].decode() == BOARD_ID
    assert list(serials(run.hello)) == [b"BTSP%012d" % (at + 1) for at in range(sensors)]
    assert struct.unpack_from("<IBB", run.hello, 39) == (
        10_000,
        sensors,
        len(COMMANDS[run.setting.sequence]),
    )
    assert run.hello[45 + 16 * sensors :] == COMMANDS[run.setting.sequence]


def test_sweeps_have_the_simulated_sensors_counts_and_no_error_words(run: Run) -> None:
    assert [seq_of(sweep) for sweep in run.said] == list(range(len(run.said)))
    assert len(run.said) in (SWEEPS, SWEEPS - 1)  # the last may be under way
    at = [COMMANDS[run.setting.sequence].index(command) for command in ELECTRODE_COMMANDS]
    for row, sweep in enumerate(run.said):
        words = words_of(sweep)
        counts = counts_of(sweep)[:, at]
        assert (counts == pattern(row, run.setting.sensors)).all()
        assert not set(words.ravel().tolist()) & {*ERROR_WORDS, 0x0000, 0xFFFF}


def test_sensors_get_50_us_before_an_answer_and_5_after(run: Run) -> None:
    assert run.timing.settle_us >= SETTLE_US
    assert run.timing.gap_us >= GAP_US
    assert run.timing.late_us < LATE_US
    reads = [one for one in run.greeting if not one.is_command]
    assert len(reads) == 2 * 3 * run.setting.sensors  # firmware version twice, serial number
    for ask, answer in zip(reads[::2], reads[1::2], strict=True):
        assert ask.mosi[0] == 0x61
        assert answer.low_ns - ask.high_ns >= SETTLE_US * 1e3
    for answer, ask in zip(reads[1::2], reads[2::2], strict=False):
        assert ask.low_ns - answer.high_ns >= GAP_US * 1e3


def test_the_spi_clock_is_within_a_sensors_limits(run: Run) -> None:
    clocks = {hz for sweep in run.swept for one in sweep for hz in one.hz}
    assert len(clocks) == 1
    assert SPI_HZ_MIN <= min(clocks) <= SPI_HZ_ASKED
    assert max(clocks) > 0.9 * SPI_HZ_ASKED


def test_chip_selects_change_between_bytes_and_never_within_one(run: Run) -> None:
    everyone = (1 << run.setting.sensors) - 1
    slot = [everyone, *(1 << sensor for sensor in range(run.setting.sensors))]
    assert len(run.swept) >= SWEEPS - 1
    for sweep in run.swept:
        assert [one.sensors for one in sweep] == slot * len(COMMANDS[run.setting.sequence])
        for one in sweep:
            byte_ns = 8e9 / one.hz[0]
            first, second = one.byte_ns
            assert one.low_ns <= first
            assert first + byte_ns <= second
            assert second + byte_ns <= one.high_ns


def test_commands_are_sent_to_all_and_answers_read_from_each(run: Run) -> None:
    for sweep in run.swept:
        told = [one.mosi for one in sweep if one.is_command]
        assert told == [bytes([command, 0]) for command in COMMANDS[run.setting.sequence]]
        assert {one.mosi for one in sweep if not one.is_command} == {b"\x01\x00"}


def test_a_sweep_takes_little_longer_than_its_bits_and_waits(run: Run) -> None:
    sensors, slots = run.setting.sensors, len(COMMANDS[run.setting.sequence])
    bits_us = 16e6 * (1 + sensors) / run.timing.spi_hz
    least_us = slots * (bits_us + SETTLE_US + GAP_US * sensors)
    shortest_us, longest_us = run.timing.duration_us
    assert least_us - GAP_US <= shortest_us <= longest_us <= OWN_TIME * least_us
    for sweep, on_the_bus in zip(run.said, run.swept, strict=False):
        start, end = struct.unpack_from("<QQ", sweep, 4)
        seen_us = (on_the_bus[-1].high_ns - on_the_bus[0].low_ns) / 1e3
        assert 0.0 <= end - start - seen_us < 20.0
