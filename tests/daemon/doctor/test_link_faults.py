"""The doctor reports each fault of a link by its cause alone, and nothing on a healthy link."""

from __future__ import annotations

import errno
import json
import socket
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from graspd.daemon.commands.doctor import examine
from graspd.daemon.doctor.electrodes import ElectrodeStatistics
from graspd.daemon.doctor.finding import Cause, Finding, Level, roots
from graspd.daemon.doctor.link import counter_findings, device_findings, rate_finding
from graspd.drivers.base import TactileReading
from graspd.drivers.biotac import SEQUENCES
from graspd.drivers.can.driver import CanBridgeDriver
from graspd.drivers.can.frames import ERROR, CanFrame
from graspd.drivers.can.stream import READINGS_MIN, CanStream
from graspd.drivers.datagrams.tactile import TactileStreamDriver
from graspd.drivers.spi.messages import FIRMWARE
from graspd.drivers.twins import spi as spi_twin
from graspd.drivers.twins.can import CanTwin
from graspd.drivers.twins.faults import LinkFaults
from tests.daemon.doctor.emulated import (
    CAN,
    FINGERS,
    LINKS,
    SPI,
    STEPS_PER_S,
    Hand,
    faults_told,
    listen,
    look,
    refused,
)
from tests.drivers.can.can_standin import DownSocket, ScriptedBus, SocketBus, stand_in
from tests.drivers.can.test_can_socket import over_socket
from tests.kit.clock import Clock

LOOK_S = 3
QUARTER_S, EVERY_S = 900, 20
HAND_HZ = 10.0
"""Moments of the hand in a second of its own time, which is faster than that of the link."""

LINK_FAULTS: dict[str, tuple[LinkFaults, dict[str, Cause]]] = {
    "damaged bytes": (
        LinkFaults(bit_flip_probability=0.05),
        {
            "spi": Cause.DAMAGED,
            "can": Cause.DAMAGED,
            "palm": Cause.DAMAGED,
            "datagrams": Cause.MESSAGES,
            "joints": Cause.MESSAGES,
        },
    ),
    "lost frames": (LinkFaults(drop_probability=0.05), dict.fromkeys(LINKS, Cause.FRAMES_LOST)),
    "frames in bursts": (LinkFaults(burst_frames=30), {"can": Cause.FRAMES_LOST}),
    "repeated frames": (
        LinkFaults(duplicate_probability=0.05),
        dict.fromkeys(LINKS, Cause.REPEATED),
    ),
    "frames out of order": (
        LinkFaults(reorder_probability=0.05),
        dict.fromkeys(("spi", "can", "palm"), Cause.OUT_OF_ORDER),
    ),
    "a link that breaks": (
        LinkFaults(disconnect_every_frames=50),
        dict.fromkeys(("spi", "palm", "datagrams", "joints"), Cause.LINK_LOST),
    ),
    "another protocol version": (
        LinkFaults(wrong_version=True),
        dict.fromkeys(("spi", "palm"), Cause.VERSION),
    ),
    "a dead electrode": (
        LinkFaults(dead_electrodes=((2, 23),)),
        dict.fromkeys(("spi", "can", "palm", "datagrams"), Cause.ELECTRODE_DEAD),
    ),
    "one sensor unplugged": (
        LinkFaults(unplugged_fingers=(1,)),
        dict.fromkeys(("spi", "can", "palm", "datagrams"), Cause.SENSOR_ABSENT),
    ),
    "all sensors unplugged": (
        LinkFaults(unplugged_fingers=(0, 1, 2)),
        dict.fromkeys(("spi", "palm", "datagrams"), Cause.SENSOR_ABSENT),
    ),
    "a clock that stands": (
        LinkFaults(stuck_clock=True),
        {"spi": Cause.CLOCK, **dict.fromkeys(("palm", "datagrams", "joints"), Cause.REPEATED)},
    ),
    "a silent board": (LinkFaults(drop_probability=1.0), dict.fromkeys(LINKS, Cause.SILENT)),
}
"""Faults of a link, and the cause that the doctor reports on each link that can have them."""


@pytest.mark.parametrize(
    ("fault", "kind"),
    [(fault, kind) for fault, (_, causes) in LINK_FAULTS.items() for kind in causes],
)
def test_a_link_fault_is_reported_by_its_cause_alone(fault: str, kind: str, tmp_path: Path) -> None:
    faults, expected = LINK_FAULTS[fault]
    statistics = ElectrodeStatistics(FINGERS)
    with LINKS[kind](Hand(100.0), tmp_path, faults) as (driver, step):
        listen(driver, step, LOOK_S * STEPS_PER_S[kind], statistics)
        told = faults_told(driver, statistics, float(LOOK_S))
    assert {finding.cause for finding in told} == {expected[kind]}, told
    assert all(finding.advice for finding in told)
    if not statistics.readings and kind != "joints":
        assert Level.ERROR in {finding.level for finding in told}


@pytest.mark.parametrize(
    ("attribute", "value", "cause"),
    [("FIRMWARE", FIRMWARE - 1, Cause.FIRMWARE_OLD), ("TICK_HZ", 1_050_000, Cause.CLOCK)],
)
def test_old_firmware_or_wrong_clock_of_a_bridge_is_reported(
    attribute: str, value: int, cause: Cause, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    statistics = ElectrodeStatistics(FINGERS)
    with LINKS["spi"](Hand(100.0), tmp_path, LinkFaults()) as (driver, step):
        monkeypatch.setattr(spi_twin, attribute, value)
        listen(driver, step, 2000 if cause is Cause.CLOCK else 300, statistics)
        told = faults_told(driver, statistics, statistics.readings / 100.0)
    assert [finding.cause for finding in told] == [cause], told


@pytest.mark.parametrize("scene", SEQUENCES)
@pytest.mark.parametrize("board", SEQUENCES)
def test_another_sampling_sequence_on_the_can_board_is_reported(scene: str, board: str) -> None:
    stream = CanStream("bus", FINGERS, sequence=scene)
    stream.link.greeting()
    twin = CanTwin("virtual", "bus", iter(Hand(100.0)), sequence=board)
    for sweep in range(100):
        frames = twin.next_frames()
        for place, (identifier, data) in enumerate(frames):
            t_ns = 10_000_000 * sweep + 10_000_000 * place // len(frames)
            stream.receive([(CanFrame(identifier, data), t_ns, t_ns)])
            stream.watch(t_ns)
    told = [*device_findings("can", stream.describe())]
    told += counter_findings("can", stream.counters.as_dict())
    causes = {finding.cause for finding in told} - {None}
    assert causes == ({Cause.SETTINGS} if scene != board else set())


@pytest.mark.parametrize(
    ("sequence", "period_ms", "loss"),
    [
        *(("interleaved", 200, 0.0), ("interleaved", 125, 0.0), ("all", 100, 0.0)),
        *(("all", 67, 0.0), ("interleaved", 10, 0.8), ("all", 10, 0.8)),
    ],
)
def test_only_lost_frames_are_reported_of_slow_or_lossy_boards(
    sequence: str, period_ms: int, loss: float
) -> None:
    stream, random = CanStream("bus", FINGERS, sequence=sequence), np.random.default_rng(0)
    stream.link.greeting()
    twin = CanTwin("virtual", "bus", iter(Hand(100.0)), sequence=sequence)
    for sweep in range(max(15, 1000 // period_ms)):
        frames = twin.next_frames()
        for place, (identifier, data) in enumerate(frames):
            t_ns = (len(frames) * sweep + place) * period_ms * 1_000_000 // len(frames)
            if random.random() >= loss:
                stream.receive([(CanFrame(identifier, data), t_ns, t_ns)])
                stream.watch(t_ns)
    assert stream.counters.readings >= READINGS_MIN
    counters = stream.counters.as_dict()
    told = device_findings("can", stream.describe()) + counter_findings("can", counters)
    assert {finding.cause for finding in told} - {None} == {Cause.FRAMES_LOST}


@pytest.mark.parametrize("sequence", ["electrodes", "interleaved"])
@pytest.mark.parametrize(
    ("boards", "loss", "cause"),
    [
        *(((0, delay_ns), 0.0, Cause.FOREIGN_SENDER) for delay_ns in (1000, 3_300_000, 5_000_000)),
        *(((0,), loss, Cause.FRAMES_LOST) for loss in (0.6, 0.9)),
    ],
)
def test_two_can_boards_with_one_id_are_distinguished_from_loss(
    boards: Sequence[int], loss: float, cause: Cause, sequence: str
) -> None:
    """`boards`: when each begins, ns. `sequence`: the boards' order of sampling, by name."""
    sent, random = list[tuple[int, CanFrame]](), np.random.default_rng(0)
    for start_ns in boards:
        hand = Hand(100.0)
        hand.skip(len(sent))
        twin = CanTwin("virtual", "bus", iter(hand), sequence=sequence)
        for sweep in range(200):
            frames = twin.next_frames()
            for place, frame in enumerate(frames):
                t_ns = start_ns + 10_000_000 * sweep + 10_000_000 * place // len(frames)
                sent.append((t_ns, CanFrame(*frame)))
    driver = CanBridgeDriver("virtual", "bus", sequence=sequence)
    statistics = ElectrodeStatistics(FINGERS)
    driver.stream.link.greeting()
    for t_ns, can_frame in sorted(sent, key=lambda each: each[0]):
        if random.random() < loss:
            continue
        for reading in driver.stream.receive([(can_frame, t_ns, t_ns)])[0]:
            assert isinstance(reading, TactileReading)
            statistics.add(reading)
        driver.stream.watch(t_ns)
    (finding,) = faults_told(driver, statistics, 2.0)
    assert (finding.level, finding.cause) == (Level.ERROR, cause)


@pytest.mark.parametrize("every_ms", [8, 16])
def test_an_adapter_holding_frames_back_gets_latency_timer_advice(every_ms: int) -> None:
    """Its frames have no time stamps; each batch is read as soon as it is handed over."""
    stream = CanStream("bus", FINGERS)
    stream.link.greeting()
    twin = CanTwin("virtual", "bus", iter(Hand(100.0)))
    waiting: list[CanFrame] = []
    since_ns = 0
    for sweep in range(100):
        frames = twin.next_frames()
        for place, (identifier, data) in enumerate(frames):
            t_ns = 10_000_000 * sweep + 10_000_000 * place // len(frames)
            if t_ns >= since_ns + every_ms * 1_000_000:
                until_ns = since_ns + every_ms * 1_000_000
                stream.receive([(frame, since_ns, until_ns) for frame in waiting])
                stream.watch(until_ns)
                waiting, since_ns = [], until_ns
            waiting.append(CanFrame(identifier, data))
    counters = stream.counters.as_dict()
    told = [*device_findings("can", stream.describe(), counters)]
    told += counter_findings("can", counters)
    told.append(rate_finding("can", counters["readings"], 1.0, stream.period_ns))
    (finding,) = (each for each in roots(told) if each.level is not Level.OK)
    assert (finding.level, finding.cause) == (Level.ERROR, Cause.FRAMES_LOST)
    assert "latency timer to 1 ms" in (finding.advice or "")


def test_bus_off_and_a_can_interface_going_down_are_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with SocketBus() as bus:
        stand_in(monkeypatch, lambda: bus)
        with over_socket() as driver:
            bus.send(CanFrame(0x040, bytes(8), ERROR))
            driver.read_ready()
            (finding,) = examine(driver, None, 1.0)
    assert finding.cause is Cause.BITRATE
    down = ScriptedBus()
    with DownSocket(socket.AF_UNIX, socket.SOCK_DGRAM) as down.socket:  # type: ignore[attr-defined]
        stand_in(monkeypatch, lambda: down)
        with over_socket() as driver:
            driver.read_ready()
            (finding,) = examine(driver, None, 1.0)
    assert finding.cause is Cause.INTERFACE_DOWN


def told_of(messages: Sequence[object]) -> list[Finding]:
    """Return the findings, except those that are ok, on one sender that sends all `messages` in
    turn, each as the `counts` of a message."""
    statistics = ElectrodeStatistics(FINGERS)
    driver = TactileStreamDriver("udp://127.0.0.1:0", clock=Clock())
    with driver, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for seq, counts in enumerate(messages):
            data = json.dumps({"seq": seq, "counts": counts}).encode()
            sender.sendto(data, ("127.0.0.1", driver.port or 0))
            for reading in driver.read_ready():
                assert isinstance(reading, TactileReading)
                statistics.add(reading)
        told = examine(driver, statistics, 1.0)
    return [finding for finding in told if finding.level is not Level.OK]


@pytest.mark.parametrize(
    ("prefix", "value"),
    [("", [*range(2000, 2019)]), ("rh_", [*range(2000, 2024)]), ("", [0.5, *[0.25] * 23])],
    ids=["19 counts", "other names", "fractions"],
)
def test_counts_of_another_form_are_reported_as_wrong_messages_alone(
    prefix: str, value: list[float]
) -> None:
    (told,) = told_of([{prefix + finger: value for finger in FINGERS}] * 20)
    assert (told.level, told.cause) == (Level.ERROR, Cause.MESSAGES)


def test_one_bad_message_does_not_hide_that_sensors_are_absent() -> None:
    ended = {finger: [1, *[0] * 23] for finger in FINGERS}
    told = told_of([ended] * 20 + [5])
    assert {finding.cause for finding in told} == {Cause.MESSAGES, Cause.SENSOR_ABSENT}


def test_fingers_missing_in_most_messages_are_not_blamed_on_plugs() -> None:
    told = told_of([{finger: [*range(2000, 2024)]} for finger in FINGERS] * 10)
    assert {finding.cause for finding in told} == {Cause.SENSOR_ABSENT}
    assert all((each.advice or "").startswith("Each message must have it") for each in told)


SLCAN = CAN + 'interface = "slcan"\n'


@pytest.mark.parametrize(
    ("tactile", "number", "cause"),
    [
        (SPI, errno.ENOENT, "port-missing"),
        (SPI, errno.EACCES, "port-denied"),
        (SPI, errno.EBUSY, "port-held"),
        (SPI, errno.EAGAIN, "port-held"),
        (SPI, errno.ENODEV, "interface-missing"),
        (SPI, errno.EIO, "link-down"),
        (SLCAN, errno.EACCES, "port-denied"),
    ],
)
def test_a_port_that_fails_to_open_is_reported_by_cause(
    tactile: str, number: int, cause: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("serial.serial_for_url", refused(number))
    (finding,) = look(tmp_path, tactile.format(tmp_path / "port"))
    assert finding["cause"] == cause


@pytest.mark.slow
@pytest.mark.parametrize("kind", LINKS)
def test_a_healthy_twin_has_no_finding_in_fifteen_minutes(kind: str, tmp_path: Path) -> None:
    sweeps, hand = int(LOOK_S * HAND_HZ), Hand(HAND_HZ)
    sweep_hz = 1000 / 14 if kind == "palm" else 100.0
    look_s = sweeps / sweep_hz
    with LINKS[kind](hand, tmp_path, LinkFaults()) as (driver, step):
        listen(driver, step, STEPS_PER_S[kind], ElectrodeStatistics(FINGERS))
        for look in range(QUARTER_S // EVERY_S):
            statistics = ElectrodeStatistics(FINGERS)
            listen(driver, step, round(look_s * STEPS_PER_S[kind]), statistics)
            told = faults_told(driver, statistics, look_s)
            assert told == [], f"after {look * EVERY_S} s"
            if kind != "joints":
                assert statistics.readings >= sweeps - 1
                hand.skip(int(EVERY_S * HAND_HZ) - statistics.readings)
