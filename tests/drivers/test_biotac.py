"""BioTac SP words on SPI, against the manual's tables and vectors checked with its C library."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.drivers.base import ElectrodeFault
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
VECTORS = [
    (int(count), int(word, 16)) for count, word in (pair.split(":") for pair in WORDS.split())
]


def words(*values: int) -> NDArray[np.uint16]:
    return np.array(values, dtype=np.uint16)


@pytest.mark.parametrize(("channel", "command"), COMMANDS.items())
def test_a_channel_has_the_command_of_the_manual(channel: int, command: int) -> None:
    assert sample_command(channel) == command
    assert channel_of(command) == channel


def test_there_are_the_28_channels_of_the_manual_and_no_more() -> None:
    assert set(CHANNELS) == set(COMMANDS)
    assert {command for command in range(256) if channel_of(command) is not None} == set(
        COMMANDS.values()
    )


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


@pytest.mark.parametrize(("count", "word"), VECTORS)
def test_a_count_has_the_word_of_the_manual(count: int, word: int) -> None:
    assert encode_word(count) == word
    counts, faults = decode_words(words(word))
    assert counts.tolist() == [count]
    assert faults.tolist() == [0]


@pytest.mark.parametrize("count", [-1, 4096])
def test_a_count_of_more_than_12_bits_has_no_word(count: int) -> None:
    with pytest.raises(ValueError, match="12-bit"):
        encode_word(count)


def test_every_count_survives_the_way() -> None:
    counts, faults = decode_words(words(*(encode_word(count) for count in range(4096))))
    assert counts.tolist() == list(range(4096))
    assert not faults.any()


@pytest.mark.parametrize("word", [0xA52D, 0xA558, 0xA552, 0xA545, 0xA53F, 0xA52E, 0xA55F, 0xA557])
def test_an_error_word_never_becomes_a_reading(word: int) -> None:
    assert word in ERROR_WORDS
    counts, faults = decode_words(words(word))
    assert faults.tolist() == [ElectrodeFault.ERROR_WORD]
    assert counts.tolist() == [0]
    # What a decoder without parity would make of it: a perfectly plausible electrode.
    assert 2629 <= (word >> 9) * 32 + ((word & 0xFF) >> 3) <= 2635


@pytest.mark.parametrize("word", [0x0000, 0xFFFF])
def test_a_line_that_nothing_drives_is_a_missing_sensor(word: int) -> None:
    counts, faults = decode_words(words(word))
    assert faults.tolist() == [ElectrodeFault.MISSING]
    assert counts.tolist() == [0]


def test_one_random_word_in_16_passes_and_never_with_a_flipped_bit() -> None:
    _, faults = decode_words(np.arange(1 << 16, dtype=np.uint16))
    assert (faults == 0).mean() == 0.0625
    good = words(*(encode_word(count) for count in range(4096)))
    for bit in range(16):
        counts, faults = decode_words(good ^ np.uint16(1 << bit))
        assert faults.all()
        assert not counts.any()


def test_words_keep_their_shape() -> None:
    counts, faults = decode_words(np.full((24, 3), 0xA251, dtype=np.uint16))
    assert counts.shape == faults.shape == (24, 3)
    assert (counts == 2602).all()


def test_sequences_are_those_of_the_manual() -> None:
    electrodes = list(range(17, 41))
    assert list(SEQUENCES["electrodes"]) == electrodes
    assert sorted(SEQUENCES["all"]) == [0, 1, 2, 3, *electrodes]
    lengths = (SEQUENCES["interleaved"], SEQUENCES["all"], SEQUENCES["electrodes"])
    assert [len(sequence) for sequence in lengths] == [54, 28, 24]
    assert set(SEQUENCES["interleaved"][1::2]) == {PAC}
    assert list(SEQUENCES["interleaved"][::2]) == [*electrodes, PDC, TAC, TDC]
