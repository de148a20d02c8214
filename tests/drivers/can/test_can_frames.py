"""Bytes of CAN frames, the DBC file, which frames are decoded, and which options are refused."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

import can
import cantools.database
import pytest
from can.interfaces.seeedstudio import SeeedBus
from can.interfaces.slcan import slcanBus
from cantools.database.can.database import Database

from graspd.drivers.base import DriverError, TactileReading
from graspd.drivers.biotac import SEQUENCES
from graspd.drivers.can.driver import CanBridgeDriver
from graspd.drivers.can.frames import (
    ERROR,
    EXTENDED,
    REMOTE,
    CanFrame,
    describe_error,
    encode_sample,
    is_bus_off,
    is_overflow,
    unpack_frame,
)
from graspd.drivers.can.stream import CanStream
from graspd.drivers.link import LinkState
from graspd.drivers.twins.can import SAMPLE_ID
from tests.conftest import ROOT
from tests.drivers.can.can_standin import (
    channel,
    decoder,
    message,
    sweep_messages,
    sweep_of_frames,
)
from tests.drivers.can.can_words import samples
from tests.drivers.one_sweep import counts_of, tactile
from tests.kit.clock import Clock

E1_SAMPLE = bytes.fromhex("A2 A251 A8C8 94B9")
"""Electrode 1 of three sensors: 2602, 2713, 2391."""


@pytest.fixture(scope="module")
def dbc() -> Database:
    loaded = cantools.database.load_file(ROOT / "deploy" / "can" / "graspd.dbc")
    assert isinstance(loaded, Database)
    return loaded


def test_the_dbc_file_knows_every_channel_of_the_manual(dbc: Database) -> None:
    commands = "80 83 85 86 A2 A4 A7 A8 AB AD AE B0 B3 B5 B6 B9 BA BC BF C1 C2 C4 C7 C8 CB CD CE D0"
    names = ["PAC", "PDC", "TAC", "TDC", *(f"E{electrode}" for electrode in range(1, 25))]
    message = dbc.get_message_by_name("SynTouchSample")
    for command, name in zip(bytes.fromhex(commands), names, strict=True):
        values = message.decode(bytes((command,)) + E1_SAMPLE[1:])
        assert isinstance(values, dict)
        assert values["Command"] == name
        assert values[f"{name}_S2"] == 0xA8C8


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
    ],
)
def test_a_can_frame_of_the_kernel_is_unpacked_with_flags(raw: str, frame: CanFrame) -> None:
    """Layout by linux/can.h, on a little-endian machine."""
    assert unpack_frame(bytes.fromhex(raw)) == frame


@pytest.mark.parametrize("raw", [bytes(15), bytes(17), bytes.fromhex("00010000 09") + bytes(11)])
def test_other_bytes_than_a_kernel_struct_are_not_a_frame(raw: bytes) -> None:
    assert unpack_frame(raw) is None


def test_error_frames_are_recognised_and_described_by_class() -> None:
    """Classes and bits of linux/can/error.h."""
    bus_off = CanFrame(0x040, bytes(8), ERROR)
    overflow = CanFrame(0x004, bytes.fromhex("0001000000000000"), ERROR)
    passive = CanFrame(0x204, bytes.fromhex("0010000000008000"), ERROR)
    assert is_bus_off(bus_off)
    assert not is_bus_off(CanFrame(0x040, bytes(8)))
    assert is_overflow(overflow)
    assert not is_overflow(passive)
    assert not is_overflow(CanFrame(0x004, b"\0", ERROR))
    for bit in range(10):
        error = CanFrame(1 << bit, b"\0\1", ERROR)
        assert (is_overflow(error), is_bus_off(error)) == (bit == 2, bit == 6)
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


@pytest.mark.parametrize(
    ("frame", "counter"),
    [
        (CanFrame(0x101, E1_SAMPLE), "foreign_frames"),
        (CanFrame(0x100, E1_SAMPLE, EXTENDED), "foreign_frames"),
        (CanFrame(0x100, E1_SAMPLE[:5]), "wrong_length_frames"),
        (CanFrame(0x100, E1_SAMPLE + b"\0"), "wrong_length_frames"),
        (CanFrame(0x100, b""), "wrong_length_frames"),
        (CanFrame(0x100, b"\x61" + E1_SAMPLE[1:]), "unknown_commands"),  # reads a parameter
        (CanFrame(0x100, b"\x88" + E1_SAMPLE[1:]), "unknown_commands"),  # even parity
        (CanFrame(0x100, E1_SAMPLE), "accepted_frames"),
    ],
)
def test_each_frame_raises_exactly_one_counter_by_its_kind(frame: CanFrame, counter: str) -> None:
    made, counters = decoder()
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
    ],
)
def test_without_a_configured_id_the_first_sound_sample_sets_one(unsound: CanFrame) -> None:
    made, counters = decoder(None)
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
def test_interrupt_forgets_a_learned_id_but_keeps_a_configured_one(configured: int | None) -> None:
    made, counters = decoder(configured)
    made.push(CanFrame(0x100, E1_SAMPLE), 0)
    made.interrupt()
    assert made.arbitration_id == configured
    made.push(CanFrame(0x12345, E1_SAMPLE, EXTENDED), 0)
    assert counters.foreign_frames == (configured is not None)


def test_padded_frames_are_decoded_with_data_length_set() -> None:
    made, counters = decoder(data_length=8)
    readings: list[TactileReading] = []
    for at, words, t_ns in samples(0):
        readings += made.push(CanFrame(SAMPLE_ID, encode_sample(at, words) + b"\x55"), t_ns)
    assert (readings[0].counts == counts_of(0)).all()
    assert counters.faulty_readings == 0


def test_words_that_are_not_counts_are_flagged_by_kind() -> None:
    made, counters = decoder()
    frames = sweep_of_frames(0)
    frames[0] = CanFrame(SAMPLE_ID, E1_SAMPLE[:1] + bytes.fromhex("A250 A52D FFFF"))
    (reading,) = [reading for at, frame in enumerate(frames) for reading in made.push(frame, at)]
    assert list(reading.faults[:, 0]) == [4, 8, 1], "PARITY, ERROR_WORD, MISSING"
    assert (counters.parity_words, counters.error_words, counters.unplugged_words) == (1, 1, 1)


@pytest.mark.parametrize("scene", ["all", "interleaved"])
@pytest.mark.parametrize("board", sorted(SEQUENCES))
def test_a_sequence_unlike_the_scenes_is_reported_after_twenty_readings(
    scene: str, board: str
) -> None:
    made = CanStream("bus", ("ff", "mf", "th"), arbitration_id=SAMPLE_ID, sequence=scene)
    for sweep in range(20):
        assert "sequence" not in made.describe()
        for at, words, t_ns in samples(sweep, board):
            made.push(CanFrame(SAMPLE_ID, encode_sample(at, words)), t_ns)
    texts = [fact.text for name, fact in made.describe().items() if name == "sequence"]
    assert texts == [f"is not {scene}, as the scene says"] * (board != scene)


ORDER = ("th", "ff", "mf")
"""The board's sensors: its first word is the thumb's."""


@pytest.mark.parametrize("fingers", [("ff", "mf", "th"), ("mf", "th")])
def test_words_in_sensor_order_fill_rows_in_finger_order(fingers: Sequence[str]) -> None:
    made = CanStream("bus", fingers, sensors=ORDER, arbitration_id=SAMPLE_ID, sequence="electrodes")
    readings: list[TactileReading] = []
    for at, words, t_ns in (*samples(0), *samples(1)):
        readings += made.push(CanFrame(SAMPLE_ID, encode_sample(at, words)), t_ns)
    assert len(readings) == 2
    rows = [ORDER.index(finger) for finger in fingers]
    for sweep, reading in enumerate(readings):
        assert not reading.faults.any()
        assert (reading.counts == counts_of(sweep)[rows]).all()


def test_opening_udp_multicast_without_its_package_names_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("can.interfaces.udp_multicast.utils.msgpack", None)
    says = rf"more packages: run {sys.executable} -m pip install 'python-can\[multicast\]'$"
    with pytest.raises(DriverError, match=says) as raised:
        CanBridgeDriver("udp_multicast", "239.74.163.2").open()
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("interface", "says"),
    [
        ("remote", r"pip install 'python-can\[remote\]'$"),
        ("gs_usb", r"'gs_usb' needs more packages: run .* -m pip install 'python-can\[gs-usb\]'$"),
        ("slcan", r"pip install 'python-can\[serial\]'$"),
        ("kvaser", r"needs the library libcanlib\.so"),
    ],
)
def test_an_interface_without_its_package_or_library_is_refused(
    monkeypatch: pytest.MonkeyPatch, interface: str, says: str
) -> None:
    monkeypatch.setattr("graspd.drivers.can.interfaces.find_spec", lambda _name: None)
    monkeypatch.setattr("graspd.drivers.can.interfaces._has_library", lambda _name: False)
    with pytest.raises(ValueError, match=says):
        CanBridgeDriver(interface, "can0")


@pytest.mark.parametrize(
    ("interface", "rates"),
    [("slcan", slcanBus._BITRATES), ("seeedstudio", SeeedBus.BITRATE)],  # noqa: SLF001
)
def test_only_bit_rates_that_python_can_has_are_accepted(
    interface: str, rates: Mapping[int, object]
) -> None:
    for bitrate in rates:
        CanBridgeDriver(interface, "/dev/ttyUSB0", bitrate=bitrate)
    with pytest.raises(ValueError, match=f"has {', '.join(map(str, sorted(rates)))}$"):
        CanBridgeDriver(interface, "/dev/ttyUSB0", bitrate=300_000)


def test_frames_that_are_not_ours_are_counted_and_harm_nothing() -> None:
    where = channel()
    ours = sweep_messages()
    strange: list[tuple[can.Message, str]] = [
        (message(bytes(ours[5].data), is_extended_id=True), "foreign_frames"),
        (message(), "wrong_length_frames"),
        (message(is_remote_frame=True), "remote_frames"),
        (message(bytes(8), 0x80, is_error_frame=True), "error_frames"),
        (message(bytes(range(64)), is_fd=True), "malformed_frames"),
    ]
    clock = Clock()  # a stalled machine would cut the sweep
    options: dict[str, Any] = {"arbitration_id": SAMPLE_ID, "sequence": "electrodes"}
    driver = CanBridgeDriver("virtual", where, clock=clock, wall_clock=clock, **options)
    with driver, can.Bus(interface="virtual", channel=where, ignore_config=True) as bus:
        for at, (sent, _) in enumerate(strange):
            bus.send(ours[at])
            bus.send(sent)
        for sent in ours[len(strange) :]:
            bus.send(sent)
        (reading,) = tactile(driver.read_ready())
        assert (reading.counts == counts_of(0)).all()
        assert not reading.faults.any()
        counted = driver.counters.as_dict()
        names = [name for _, name in strange]
        assert {name: counted[name] for name in names} == {
            name: names.count(name) for name in names
        }
        assert counted["frames"] == len(ours) + len(strange) - 1  # one is not classic
        assert driver.stream.link.state is LinkState.UP
        assert driver.stream.last_error == "bus error"


@pytest.mark.parametrize(
    ("interface", "options", "says"),
    [
        ("serial", {"channel": "rfc2217://here:5"}, "socket://HOST:PORT"),
        ("virtual", {"sensors": ("ff", "mf")}, "not in"),
        ("virtual", {"fingers": ("ff", "mf", "rf", "th")}, "9 bytes cannot carry 4 sensors"),
        ("virtual", {"data_length": 6}, "6 bytes"),
        ("virtual", {"data_length": 9}, "9 bytes"),
        ("virtual", {"options": {"no_such_option": 1}}, "no_such_option"),
        ("socketcan", {"bitrate": 1_000_000}, "ip link set"),
        ("serial", {"bitrate": 250_000}, "options.baudrate"),
        ("virtual", {"bitrate": 250_000}, "takes none"),
    ],
)
def test_arguments_that_can_never_work_are_refused(
    interface: str, options: Mapping[str, Any], says: str
) -> None:
    with pytest.raises(ValueError, match=says):
        CanBridgeDriver(interface, **{"channel": "can0", **options})
