"""The bytes of CAN frames: golden vectors, the DBC file, and what is refused."""

from __future__ import annotations

import cantools.database
import numpy as np
import pytest
from cantools.database.can.database import Database
from hypothesis import given
from hypothesis import strategies as st

from graspd.drivers.base import FINGERS
from graspd.drivers.biotac import decode_words
from graspd.drivers.can.formats import (
    SWEEP_BASE_ID,
    Reject,
    SweepFrame,
    SweepStatus,
    encode_sample,
    parse_sample,
    parse_sweep,
)
from graspd.drivers.can.frames import (
    ERROR,
    EXTENDED,
    FD,
    REMOTE,
    CanFrame,
    describe_error,
    is_bus_off,
    is_overflow,
    unpack_frame,
)
from tests.conftest import ROOT
from tests.drivers.can.can_words import word

E1_SAMPLE = bytes.fromhex("A2 A251 A8C8 94B9")
"""Electrode 1 of three sensors: 2602, 2713, 2391."""
SWEEP_EXAMPLE = bytes.fromhex("01 04 3412 40420F00" + "A251" * 24 + "0000 000000000000")
"""The example in deploy/can/PROTOCOL.md."""


@pytest.fixture(scope="module")
def dbc() -> Database:
    loaded = cantools.database.load_file(ROOT / "deploy" / "can" / "graspd.dbc")
    assert isinstance(loaded, Database)
    return loaded


def test_the_real_formats_sample_is_read() -> None:
    sample = parse_sample(E1_SAMPLE, 3, 7)
    assert not isinstance(sample, Reject)
    channel, words = sample
    counts, faults = decode_words(np.frombuffer(words, dtype=">u2").astype(np.uint16))
    assert channel == 17
    assert counts.tolist() == [2602, 2713, 2391]
    assert not faults.any()


def test_the_real_formats_sample_is_written() -> None:
    words = word(2602) + word(2713) + word(2391)
    assert encode_sample(17, words) == E1_SAMPLE


def test_the_protocols_example_of_a_sweep_frame_is_read_and_written() -> None:
    sweep = SweepFrame(4, 0x1234, 1_000_000, bytes.fromhex("A251") * 24)
    assert len(SWEEP_EXAMPLE) == 64
    assert parse_sweep(SWEEP_EXAMPLE) == sweep
    assert sweep.to_bytes() == SWEEP_EXAMPLE


@given(
    st.integers(0, 4),
    st.integers(0, 65535),
    st.integers(0, (1 << 32) - 1),
    st.binary(min_size=48, max_size=48),
    st.integers(0, 7),
)
def test_every_sweep_frame_comes_back_as_it_went(
    finger: int, sequence: int, tick_us: int, words: bytes, status: int
) -> None:
    sweep = SweepFrame(finger, sequence, tick_us, words, status)
    assert parse_sweep(sweep.to_bytes()) == sweep


def test_the_dbc_file_reads_the_real_formats_sample(dbc: Database) -> None:
    values = dbc.get_message_by_name("SynTouchSample").decode(E1_SAMPLE)
    assert values == {"Command": "E1", "E1_S1": 0xA251, "E1_S2": 0xA8C8, "E1_S3": 0x94B9}


def test_the_dbc_file_knows_every_channel_of_the_manual(dbc: Database) -> None:
    commands = "80 83 85 86 A2 A4 A7 A8 AB AD AE B0 B3 B5 B6 B9 BA BC BF C1 C2 C4 C7 C8 CB CD CE D0"
    names = ["PAC", "PDC", "TAC", "TDC", *(f"E{electrode}" for electrode in range(1, 25))]
    message = dbc.get_message_by_name("SynTouchSample")
    for command, name in zip(bytes.fromhex(commands), names, strict=True):
        values = message.decode(bytes((command,)) + E1_SAMPLE[1:])
        assert isinstance(values, dict)
        assert values["Command"] == name
        assert values[f"{name}_S2"] == 0xA8C8


@pytest.mark.parametrize("finger", FINGERS)
def test_the_dbc_file_reads_a_sweep_frame_field_by_field(dbc: Database, finger: str) -> None:
    message = dbc.get_message_by_name(f"Sweep_{finger}")
    words = b"".join(word(100 * electrode) for electrode in range(24))
    number = FINGERS.index(finger)
    status = int(SweepStatus.ABSENT | SweepStatus.OVERRUN)
    values = message.decode(SweepFrame(number, 513, 70_000, words, status).to_bytes())
    assert (message.frame_id, message.length, message.is_fd) == (SWEEP_BASE_ID + number, 64, True)
    assert values == {
        "Version": 1,
        "Finger": finger,
        "Sequence": 513,
        "Tick": 70_000,
        "Absent": 1,
        "Repeated": 0,
        "Overrun": 1,
        **{
            f"E{electrode + 1}": int.from_bytes(word(100 * electrode), "big")
            for electrode in range(24)
        },
    }


@pytest.mark.parametrize(
    ("raw", "frame"),
    [
        ("00010000 07 000000 A2A251A8C894B9 00", CanFrame(0x100, E1_SAMPLE)),
        ("34120080 02 000000 0102 000000000000", CanFrame(0x1234, b"\1\2", EXTENDED)),
        ("00010040 07 000000 0000000000000000", CanFrame(0x100, b"", REMOTE)),
        (
            "40000020 08 000000 0000000000000000",
            CanFrame(0x40, bytes(8), ERROR),
        ),
        ("B0050000 40 01 0000" + "55" * 64, CanFrame(0x5B0, b"\x55" * 64, FD)),
    ],
)
def test_the_kernels_structs_are_read(raw: str, frame: CanFrame) -> None:
    """Layout by linux/can.h, on a little-endian machine."""
    assert unpack_frame(bytes.fromhex(raw)) == frame


@pytest.mark.parametrize(
    "raw",
    [
        *(bytes(length) for length in (0, 15, 17, 71, 73)),
        bytes.fromhex("00010000 09") + bytes(11),
        bytes.fromhex("00010000 41") + bytes(67),
    ],
)
def test_what_is_no_struct_of_the_kernel_is_no_frame(raw: bytes) -> None:
    assert unpack_frame(raw) is None


def test_error_frames_say_what_happened() -> None:
    """Classes and bits of linux/can/error.h."""
    bus_off = CanFrame(0x040, bytes(8), ERROR)
    overflow = CanFrame(0x004, bytes.fromhex("0001000000000000"), ERROR)
    passive = CanFrame(0x204, bytes.fromhex("0010000000008000"), ERROR)
    assert is_bus_off(bus_off)
    assert not is_bus_off(CanFrame(0x040, bytes(8)))
    assert is_overflow(overflow)
    assert not is_overflow(passive)
    assert not is_overflow(CanFrame(0x004, b"\0", ERROR))
    assert is_overflow(CanFrame(0x004, b"\0\1", ERROR))
    assert not is_overflow(CanFrame(0x080, b"\0\1", ERROR))
    assert not is_overflow(CanFrame(0x004, b"\0\1"))
    assert describe_error(bus_off) == "bus-off"
    assert describe_error(passive) == "controller problem, error counters"
    assert describe_error(CanFrame(0, b"", ERROR)) == "unknown error class"
    # CAN_ERR_TX_TIMEOUT, _LOSTARB, _CRTL, _PROT, _TRX, _ACK, _BUSOFF, _BUSERROR, _RESTARTED, _CNT
    words = ["timeout", "arbitration", "controller", "protocol", "transceiver", "acknowledgement"]
    for bit, cause in enumerate([*words, "bus-off", "bus error", "restarted", "counters"]):
        told = describe_error(CanFrame(1 << bit, b"", ERROR))
        assert cause in told
        assert "," not in told
