"""The doctor's findings, from readings whose faults are known."""

from __future__ import annotations

import importlib
import json
import os
import pkgutil
import re
import socket
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd import drivers
from graspd.daemon.doctor import computer
from graspd.daemon.doctor.electrodes import ElectrodeStatistics
from graspd.daemon.doctor.finding import Cause, Level
from graspd.daemon.doctor.link import (
    COUNTERS,
    JOINING,
    NOT_FRAMES,
    NOT_OURS,
    WHOLES,
    counter_findings,
    device_findings,
    rate_finding,
)
from graspd.drivers.base import (
    DeviceFault,
    DriverCounters,
    ElectrodeFault,
    Fact,
    LinkCause,
    TactileReading,
)

FINGERS = ("ff", "mf", "th")
HARMLESS = """
    absent_fingers absent_sensors accepted_frames bridge_overruns bridge_rx_errors bridge_tx_dropped
    bus_faults bytes error_words faulty_readings held_values impossible_angles invalid_fingers
    joint_readings link_failures metadata_packets other_palms parity_words refused_bridges
    remote_frames repeats stale_sweeps unanswered_pings unknown_types unplugged_words
"""
"""Counters without a finding of their own: others, or the electrodes, show the fault."""
Counts = NDArray[np.float64]
Faults = NDArray[np.uint8]


def statistics(
    spoil: Callable[[Counts, Faults, int], None], readings: int = 100
) -> ElectrodeStatistics:
    """Statistics of untouched sensors with 3.5 counts of noise; `spoil` changes each reading."""
    random = np.random.default_rng(0)
    rest = random.uniform(2400, 3400, (3, 24))
    found = ElectrodeStatistics(FINGERS)
    for number in range(readings):
        counts = rest + random.normal(0.0, 3.5, rest.shape)
        faults = np.zeros((3, 24), dtype=np.uint8)
        spoil(counts, faults, number)
        found.add(TactileReading(number, number, counts.round().astype(np.uint16), faults))
    return found


def test_running_mean_and_deviation_are_those_of_numpy() -> None:
    kept: list[Counts] = []

    def keep(counts: Counts, faults: Faults, n: int) -> None:
        faults[1, 3] = ElectrodeFault.PARITY if n % 2 else 0
        kept.append(counts.round())

    found = statistics(keep)
    np.testing.assert_allclose(found.mean[0], np.mean(kept, axis=0)[0], rtol=1e-12)
    np.testing.assert_allclose(found.deviation[2], np.std(kept, axis=0)[2], rtol=1e-9)
    np.testing.assert_allclose(found.mean[1, 3], np.mean(kept[::2], axis=0)[1, 3], rtol=1e-12)
    assert found.faulty[1, 3] == 50


ALL = slice(None)


def at(finger: int, electrode: int | slice, value: float) -> Callable[[Counts, object, int], None]:
    def spoil(counts: Counts, _faults: object, _number: int) -> None:
        counts[finger, electrode] = value

    return spoil


def fault(
    finger: int, electrode: int | slice, bits: ElectrodeFault, every: int
) -> Callable[[Counts, Faults, int], None]:
    def spoil(_counts: Counts, faults: Faults, n: int) -> None:
        if n % every == 0:
            faults[finger, electrode] = bits

    return spoil


def restless(counts: Counts, _faults: object, number: int) -> None:
    counts[0, 20] += 100.0 * (number % 2)


def at_a_rail_with_noise(counts: Counts, _faults: object, number: int) -> None:
    counts[1, 7] = 4085.0 + 3.0 * (number % 3)


def touched(counts: Counts, _faults: object, number: int) -> None:
    counts[1, 3:12] -= 300.0 * np.sin(number / 10.0)


MISSING, PARITY = ElectrodeFault.MISSING, ElectrodeFault.PARITY
ACCUSED = {Cause.ELECTRODE_DEAD, Cause.ELECTRODE_FROZEN}


@pytest.mark.parametrize(
    ("spoil", "level", "cause", "says"),
    [
        (at(1, 7, 0.0), Level.ERROR, Cause.ELECTRODE_DEAD, "mf_8 stuck at a rail"),
        (at(2, 23, 4095.0), Level.ERROR, Cause.ELECTRODE_DEAD, "th_24 stuck at a rail"),
        (at(0, 0, 2500.0), Level.ERROR, Cause.ELECTRODE_FROZEN, "ff_1 frozen"),
        (fault(2, ALL, MISSING, 1), Level.ERROR, Cause.SENSOR_ABSENT, "th: no electrode"),
        (fault(1, 4, MISSING, 1), Level.ERROR, Cause.ELECTRODE_UNREAD, "mf_5 never or rarely"),
        (fault(0, 2, PARITY, 10), Level.WARNING, Cause.SENSOR_WORDS, "ff_3 now and then"),
        (restless, Level.WARNING, Cause.ELECTRODE_RESTLESS, "ff_21 restless"),
        (at_a_rail_with_noise, Level.WARNING, Cause.ELECTRODE_RAIL, "mf_8 near the end"),
        (touched, Level.OK, None, "mf is touched or moves: 9 of its electrodes do"),
        (at(1, ALL, 0.0), Level.ERROR, Cause.SENSOR_ABSENT, "mf: no electrode can be read"),
        (at(1, ALL, 2500.0), Level.ERROR, Cause.REPEATED, "mf: all counts are frozen"),
    ],
)
def test_a_fault_of_electrodes_is_named_with_its_cause(
    spoil: Callable[[Counts, Faults, int], None], level: Level, cause: Cause | None, says: str
) -> None:
    (finding,) = statistics(spoil).findings()
    assert (finding.level, finding.cause) == (level, cause)
    assert finding.what.startswith(says)
    assert bool(finding.advice) == (level is not Level.OK)
    # Hardware is accused by two signs only.
    assert "replace" not in (finding.advice or "") or cause in ACCUSED


@pytest.mark.parametrize(
    ("readings", "period_ns", "level"),
    [
        (0, 10_000_000, Level.ERROR),
        (300, 10_000_000, Level.OK),
        (250, 10_000_000, Level.WARNING),
        (5, None, Level.OK),
    ],
)
def test_a_low_rate_is_a_warning_and_silence_an_error(
    readings: int, period_ns: int | None, level: Level
) -> None:
    assert rate_finding("spi", readings, 3.0, period_ns).level is level


@pytest.mark.parametrize(("number", "findings"), [(0, 0), (13, 0), (108, 0), (109, 1)])
def test_up_to_108_samples_lost_on_joining_are_harmless(number: int, findings: int) -> None:
    assert len(counter_findings("palm", {"unsynchronised_packets": number})) == findings


@pytest.mark.parametrize(
    ("fault", "level", "cause", "advice"),
    [
        (None, Level.OK, None, ""),
        (DeviceFault.OLD_FIRMWARE, Level.WARNING, Cause.FIRMWARE_OLD, "Flash"),
        (DeviceFault.SENSOR_TWICE, Level.ERROR, Cause.SENSOR_TWICE, "Two chip selects"),
        (DeviceFault.SENSOR_ABSENT, Level.WARNING, Cause.SENSOR_ABSENT, "order of the chip"),
        (DeviceFault.NO_SENSOR, Level.ERROR, Cause.SENSOR_ABSENT, "MISO"),
        (DeviceFault.SENSOR_WORDS, Level.WARNING, Cause.SENSOR_WORDS, "by chip select"),
        (DeviceFault.SWEEP_TOO_LONG, Level.WARNING, Cause.SETTINGS, "longer period"),
        (DeviceFault.SEQUENCE, Level.WARNING, Cause.SETTINGS, "electrodes, all or interleaved"),
        (DeviceFault.BUS_ERROR, Level.WARNING, Cause.BUS_ERRORS, "terminators"),
    ],
)
def test_a_device_fact_gets_level_cause_and_advice_by_fault(
    fault: DeviceFault | None, level: Level, cause: Cause | None, advice: str
) -> None:
    up, finding = device_findings("spi", {"link": Fact("up"), "some key": Fact("xxx", fault)})
    assert (up.level, up.what) == (Level.OK, "spi: link up")
    assert (finding.level, finding.cause, finding.what) == (level, cause, "spi: some key xxx")
    assert advice in (finding.advice or "")
    assert bool(advice) == bool(finding.advice)


@pytest.mark.parametrize("cause", LinkCause)
def test_each_link_fault_is_an_error_with_cause_and_advice(cause: LinkCause) -> None:
    """test_link_faults and test_causes check which cause it is."""
    told = set()
    for why in ("no answer from /dev/x", "something new"):
        device = {"link": Fact("waiting", cause), "why": Fact(why)}
        (finding,) = device_findings("palm", device)
        assert (finding.level, finding.what) == (Level.ERROR, f"palm: link waiting: {why}")
        assert finding.advice
        told.add(finding.cause)
    assert len(told) == 1
    assert None not in told


def test_connect_md_names_every_cause_once_and_nothing_else() -> None:
    page = (Path(__file__).parents[3] / "deploy/CONNECT.md").read_text()
    _, causes = page.split("texts may change.\n")
    assert sorted(re.findall(r"`([^`]+)`", causes)) == sorted(Cause)


def kinds_of(kind: type[DriverCounters]) -> Iterator[type[DriverCounters]]:
    for below in kind.__subclasses__():
        yield below
        yield from kinds_of(below)


def test_reported_counters_exist_and_have_cause_and_advice() -> None:
    for module in pkgutil.walk_packages(drivers.__path__, f"{drivers.__name__}."):
        importlib.import_module(module.name)
    told = {name for names in COUNTERS.values() for name in names}
    names = {name for kind in kinds_of(DriverCounters) for name in kind().as_dict()}
    others = {name for names in NOT_OURS.values() for name in names}
    # A new counter has a cause in daemon/doctor/link.py, or is harmless and stands here.
    assert told | others | NOT_FRAMES | JOINING | {*WHOLES, *HARMLESS.split()} == names
    for name in names:
        findings = counter_findings("x", {name: 1000})
        assert len(findings) == (name in told), name
        for finding in findings:
            assert finding.cause
            assert finding.advice
            assert finding.what == f"x: 1000 {name.replace('_', ' ')}"


@pytest.mark.parametrize(
    ("counters", "level"),
    [
        ({"frames": 300, "bad_crc": 15}, Level.ERROR),  # 5 %
        ({"frames": 300, "bad_crc": 3}, Level.WARNING),
        ({"frames": 20, "bad_crc": 4}, Level.WARNING),  # too few to know a share
        ({"packets": 3000, "lost_packets": 300}, Level.ERROR),  # 10 %
        ({"packets": 3000, "lost_packets": 150}, Level.WARNING),
        ({"frames": 300, "readings": 270, "missed_readings": 30}, Level.ERROR),
        ({"frames": 300, "readings": 295, "missed_readings": 6}, Level.WARNING),
        ({"frames": 7200, "readings": 300, "cut_sweeps": 90, "lost_frames": 90}, Level.WARNING),
        ({"packets": 3000, "not_counts": 900}, Level.WARNING),  # values, of which each has many
        ({"link_losses": 2}, Level.WARNING),
        ({"link_losses": 3}, Level.ERROR),
    ],
)
def test_many_damaged_or_lost_frames_are_an_error(counters: dict[str, int], level: Level) -> None:
    (finding,) = counter_findings("x", counters)
    assert finding.level is level


@pytest.mark.parametrize("now", [LinkCause.NOT_FOUND, LinkCause.SILENT, LinkCause.DISCONNECTED])
def test_a_flapping_link_counts_as_lost_unless_access_is_denied(now: LinkCause) -> None:
    (finding,) = device_findings("spi", {"link": Fact("waiting", now)}, {"link_losses": 4})
    assert (finding.level, finding.cause) == (Level.ERROR, Cause.LINK_LOST)
    denied = Fact("waiting", LinkCause.DENIED)
    (finding,) = device_findings("spi", {"link": denied}, {"link_losses": 4})
    assert finding.cause is Cause.PORT_DENIED


@pytest.mark.parametrize(
    ("counters", "cause"),
    [
        ({"readings": 1, "bad_messages": 190}, Cause.MESSAGES),  # `t` in ms
        ({"readings": 230, "other_hands": 70}, Cause.FOREIGN_SENDER),
        ({"readings": 70, "service_packets": 900}, Cause.PALM_MODE),
        ({"readings": 230, "bad_messages": 5}, Cause.LINK_LOST),  # damaged while it was up
        ({"readings": 2, "bad_messages": 4}, Cause.LINK_LOST),
        ({"readings": 100, "frames": 2400, "foreign_frames": 900}, Cause.LINK_LOST),
        ({"readings": 100, "bad_crc": 30, "error_frames": 30}, Cause.LINK_LOST),
    ],
)
def test_readings_that_stopped_while_data_comes_are_explained(
    counters: dict[str, int], cause: Cause
) -> None:
    device = {"link": Fact("waiting", LinkCause.TIMEOUT)}
    (finding,) = device_findings("x", device, counters)
    assert (finding.level, finding.cause) == (Level.ERROR, cause)


def test_state_and_bit_rate_of_can_interfaces_are_read(tmp_path: Path) -> None:
    for name, state in (("can0", "up"), ("vcan0", "unknown"), ("can1", "down")):
        (tmp_path / "net" / name).mkdir(parents=True)
        (tmp_path / "net" / name / "type").write_text("280\n")
        (tmp_path / "net" / name / "operstate").write_text(f"{state}\n")
    info = {"state": "ERROR-PASSIVE", "bittiming": {"bitrate": 250_000}}
    said = [
        {"ifname": "lo"},
        {"ifname": "can0", "linkinfo": {"info_kind": "can", "info_data": info}},
        {"ifname": "can1", "linkinfo": {"info_kind": "can", "info_data": {"state": "STOPPED"}}},
        {"ifname": "vcan0", "linkinfo": {"info_kind": "vcan"}},
    ]
    answer = tmp_path / "answer.json"
    answer.write_text(json.dumps(said))
    found = computer.can_interfaces(tmp_path / "net", ("cat", str(answer)))
    assert [str(interface) for interface in found] == [
        "CAN interface can0 is error-passive, 250000 bit/s",
        "CAN interface can1 is stopped",
        "CAN interface vcan0 is up",
    ]
    assert [interface.is_down for interface in found] == [False, True, False]
    without = computer.can_interfaces(tmp_path / "net", ("no-such-command",))
    assert [interface.state for interface in without] == ["up", "down", "up"]


def test_a_process_that_ends_meanwhile_hides_no_port_holder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Processes of `/proc`: 8 ends while it is looked at, 9 has the socket of port 8080."""
    for pid in "89":
        (tmp_path / pid / "fd").mkdir(parents=True)
    (tmp_path / "9" / "cmdline").write_bytes(b"other\0program\0")
    (tmp_path / "net").mkdir()
    with socket.socket(socket.AF_UNIX) as held:
        held.bind(str(tmp_path / "9" / "fd" / "3"))
        inode = (tmp_path / "9" / "fd" / "3").stat().st_ino
        line = f"0: 0100007F:1F90 00000000:0000 07 0:0 00:0 0 0 0 {inode} 2 0 0"
        (tmp_path / "net" / "udp").write_text(f"header\n{line}\n")
        monkeypatch.setattr(computer, "PROC", tmp_path)
        for name in ("listdir", "scandir"):
            monkeypatch.setattr(os, name, partial(_unless_ended, getattr(os, name)))
        assert computer.port_holders("udp", 8080) == [computer.Process(9, "other program")]


def _unless_ended(listed: Callable[[object], object], folder: object) -> object:
    if str(folder).endswith("8/fd"):
        raise FileNotFoundError(folder)
    return listed(folder)
