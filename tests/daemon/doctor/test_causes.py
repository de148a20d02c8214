"""Whatever is wrong is told by the name of its cause, with advice, and nothing else is accused."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import pytest

from daemon.commands import doctor
from daemon.doctor import computer
from daemon.doctor.electrodes import ElectrodeStatistics
from daemon.doctor.finding import Cause, Finding, Level
from daemon.doctor.link import COUNTERS, counter_findings
from daemon.doctor.surroundings import can_finding
from drivers.base import DriverCounters
from drivers.can.readings import CanCounters
from drivers.joints.message import JointCounters
from drivers.palm.packet import PalmCounters
from drivers.recordings.faults import ReplayCounters
from drivers.spi.messages import FIRMWARE
from drivers.spi.sweeps import BridgeCounters
from drivers.twins import spi as spi_twin
from drivers.twins.faults import LinkFaults
from drivers.twins.grasps.whole_grasps import synthetic_grasps
from tests.daemon.doctor.emulated import FINGERS, LINKS, STEPS_PER_S, Hand, faults_told, listen
from tests.daemon.processes import start, wait_for
from tests.drivers.can.can_standin import LOOPBACK, SocketBus, sweep_of_frames
from tests.ports import free_port

LOOK_S = 3

# ---- what may be wrong with a device or its link, on every link that can have it ----------------

LINK_FAULTS: dict[str, tuple[LinkFaults, dict[str, Cause]]] = {
    "damaged bytes": (
        LinkFaults(bit_flip_probability=0.05),
        {
            "spi": Cause.DAMAGED,
            "can": Cause.DAMAGED,
            "can fd": Cause.DAMAGED,
            "palm": Cause.DAMAGED,
            "joints": Cause.JOINTS,
        },
    ),
    "lost frames": (LinkFaults(drop_probability=0.05), dict.fromkeys(LINKS, Cause.FRAMES_LOST)),
    "repeated frames": (
        LinkFaults(duplicate_probability=0.05),
        dict.fromkeys(LINKS, Cause.REPEATED),
    ),
    "frames out of order": (
        LinkFaults(reorder_probability=0.05),
        dict.fromkeys(("spi", "can", "can fd", "palm"), Cause.OUT_OF_ORDER),
    ),
    "a link that breaks": (
        LinkFaults(disconnect_every_frames=50),
        dict.fromkeys(("spi", "palm"), Cause.LINK_LOST),
    ),
    "another protocol version": (
        LinkFaults(wrong_version=True),
        dict.fromkeys(("spi", "can fd", "palm"), Cause.VERSION),
    ),
    "a dead electrode": (
        LinkFaults(dead_electrodes=((2, 23),)),
        dict.fromkeys(("spi", "can", "can fd", "palm"), Cause.ELECTRODE_DEAD),
    ),
    "one sensor unplugged": (
        LinkFaults(unplugged_fingers=(1,)),
        dict.fromkeys(("spi", "can", "can fd", "palm"), Cause.SENSOR_ABSENT),
    ),
    "all sensors unplugged": (
        LinkFaults(unplugged_fingers=(0, 1, 2)),
        dict.fromkeys(("spi", "can fd", "palm"), Cause.SENSOR_ABSENT),
    ),
    "a clock that stands": (
        LinkFaults(stuck_clock=True),
        {"spi": Cause.CLOCK, "can fd": Cause.CLOCK, "palm": Cause.REPEATED},
    ),
    "a silent board": (LinkFaults(drop_probability=1.0), dict.fromkeys(LINKS, Cause.SILENT)),
}
DEAF = {"lost frames", "repeated frames", "frames out of order", "a link that breaks"}
"""What does not keep the hand from being felt is no error, if it is said."""


@pytest.mark.parametrize(
    ("fault", "kind"),
    [(fault, kind) for fault, (_, told) in LINK_FAULTS.items() for kind in told],
)
def test_a_fault_of_a_link_is_told_by_its_name_and_nothing_else_is(
    fault: str, kind: str, tmp_path: Path
) -> None:
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
    ids=["older firmware", "a clock that is wrong"],
)
def test_a_bridge_that_is_not_what_it_says_is_told(
    attribute: str, value: int, cause: Cause, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    statistics = ElectrodeStatistics(FINGERS)
    with LINKS["spi"](Hand(100.0), tmp_path, LinkFaults()) as (driver, step):
        monkeypatch.setattr(spi_twin, attribute, value)  # its ticks stay what they were
        listen(driver, step, 2000 if cause is Cause.CLOCK else 300, statistics)
        told = faults_told(driver, statistics, statistics.readings / 100.0)
    assert [finding.cause for finding in told] == [cause], told


def test_a_hand_that_repeats_itself_is_told(tmp_path: Path) -> None:
    once = next(moment.counts for moment in synthetic_grasps())

    class Frozen(Hand):
        def __iter__(self) -> Iterator[Any]:
            while True:
                yield once

    statistics = ElectrodeStatistics(FINGERS)
    with LINKS["spi"](Frozen(100.0), tmp_path, LinkFaults()) as (driver, step):
        listen(driver, step, 300, statistics)
        told = faults_told(driver, statistics, 3.0)
    assert {finding.cause for finding in told} == {Cause.REPEATED}
    assert {finding.level for finding in told} == {Level.ERROR}


def test_error_frames_of_a_bus_without_ours_are_a_bit_rate(tmp_path: Path) -> None:
    silence, statistics = LinkFaults(drop_probability=1.0), ElectrodeStatistics(FINGERS)
    with LINKS["can"](Hand(100.0), tmp_path, silence) as (driver, step):
        where = driver.describe()["bus"].text.split()[1].rstrip(",")
        with can.Bus(interface="virtual", channel=where, ignore_config=True) as bus:
            for _ in range(20):
                bus.send(can.Message(arbitration_id=0x8, is_error_frame=True, dlc=8, data=bytes(8)))
                listen(driver, step, 1, statistics)
            (told,) = faults_told(driver, statistics, 1.0)
    assert (told.level, told.cause) == (Level.ERROR, Cause.BITRATE), told
    assert "20 error frames" in told.what


@pytest.mark.parametrize(
    "counters",
    [BridgeCounters, CanCounters, PalmCounters, JointCounters, ReplayCounters],
)
def test_a_counter_that_is_shown_has_a_cause_and_advice(counters: type[DriverCounters]) -> None:
    told = {name for names in COUNTERS for name in names}
    for name in counters().as_dict():
        findings = counter_findings("x", {name: 1000})
        assert len(findings) == (name in told), name
        for finding in findings:
            assert finding.cause
            assert finding.advice
            assert finding.what == f"x: 1000 {name.replace('_', ' ')}"


def test_every_counter_that_is_told_exists() -> None:
    from daemon.record.player import McapCounters

    kinds = (BridgeCounters, CanCounters, PalmCounters, JointCounters, ReplayCounters, McapCounters)
    known = {name for kind in kinds for name in kind().as_dict()}
    assert {name for names in COUNTERS for name in names} <= known


def test_no_fault_can_be_said_to_be_fine_and_none_goes_without_advice() -> None:
    for level, cause, advice in (
        (Level.OK, Cause.SLOW, "wait"),
        (Level.ERROR, None, "wait"),
        (Level.ERROR, Cause.SLOW, ""),
        (Level.WARNING, Cause.SLOW, None),
    ):
        with pytest.raises(ValueError, match="something"):
            Finding(level, "something", cause, advice)


# ---- what may be wrong with the computer or the scene -------------------------------------------


def look(folder: Path, capsys: pytest.CaptureFixture[str], text: str) -> list[dict[str, str]]:
    """What the doctor says of a scene that is wrong."""
    scene = folder / "scene.toml"
    scene.write_text(text)
    parser = ArgumentParser()
    doctor.add_arguments(parser)
    code = doctor.run(parser.parse_args([str(scene), "--listen", "0.3", "--json"]))
    told = [f for f in json.loads(capsys.readouterr().out)["findings"] if f["level"] != "ok"]
    assert code == int("error" in {finding["level"] for finding in told})
    return told


@pytest.fixture
def healthy(tmp_path: Path) -> Iterator[str]:
    """`[tactile]` of a bridge that sweeps, in real time."""
    counts, done = (moment.counts for moment in synthetic_grasps(loop=True)), threading.Event()
    with spi_twin.SpiTwin(tmp_path / "bridge", counts) as twin:
        thread = threading.Thread(target=twin.serve, args=(done.is_set,))
        thread.start()
        yield f'[tactile]\ndriver = "spi"\nport = "{twin.path}"\n'
        done.set()
        thread.join()


def published(folder: Path, more: str = "") -> str:
    return f'[publish]\nendpoint = "ipc://{folder}/graspd"\n{more}'


MODEL = '[model]\nname = "cnn1"\n'
SPI = '[tactile]\ndriver = "spi"\nport = "{}"\n'
CAN = '[tactile]\ndriver = "can"\nchannel = "{}"\n'


def test_a_port_that_is_missing_is_told_with_those_that_there_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    port = computer.SerialPort("/dev/ttyACM3", "Pico - CDC", "E66", 0x2E8A, "Pico")
    monkeypatch.setattr(computer, "serial_ports", lambda: [port])
    text = SPI.format(tmp_path / "absent") + MODEL + published(tmp_path)
    (told,) = look(tmp_path, capsys, text)
    assert told["cause"] == "port-missing"
    doctor.run(_arguments(tmp_path / "scene.toml"))
    people = capsys.readouterr().out
    assert "ok serial port /dev/ttyACM3: Pico - CDC, serial number E66\n" in people


def _arguments(scene: Path, *more: str) -> Any:  # noqa: ANN401
    parser = ArgumentParser()
    doctor.add_arguments(parser)
    return parser.parse_args([str(scene), "--listen", "0.2", *more])


def refused(number: int) -> Callable[..., object]:
    def open_port(*_: object, **__: object) -> object:
        raise OSError(number, os.strerror(number))

    return open_port


@pytest.mark.parametrize(
    ("group", "advice"),
    [
        ("dialout", "sudo usermod -aG dialout $USER, then log in again"),
        ("root", "install deploy/udev/70-graspd.rules, and plug it in anew"),
    ],
)
def test_a_port_that_is_denied_is_told_with_its_group(
    group: str,
    advice: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("serial.serial_for_url", refused(errno.EACCES))
    monkeypatch.setattr("grp.getgrgid", lambda number: SimpleNamespace(gr_name=group))
    (told,) = look(tmp_path, capsys, SPI.format("/dev/tty") + MODEL + published(tmp_path))
    assert (told["cause"], told["advice"]) == ("port-denied", advice)


HOLD_LOCKED = """
import fcntl, os, sys
held = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
fcntl.flock(held, fcntl.LOCK_EX)
print(flush=True)
sys.stdin.read()
"""
HOLD_OPEN = """
import os, sys
held = os.open(sys.argv[1], os.O_RDONLY | os.O_NOCTTY)
print(flush=True)
sys.stdin.read()
"""
HOLD_UDP = """
import socket, sys
held = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
held.bind(("127.0.0.1", 0))
print(held.getsockname()[1], flush=True)
sys.stdin.read()
"""

HOLD_TCP = """
import socket, sys
held = socket.create_server(("127.0.0.1", 0))
print(held.getsockname()[1], flush=True)
sys.stdin.read()
"""


@contextlib.contextmanager
def holder(program: str, *arguments: object) -> Iterator[tuple[int, str]]:
    """Another process that has something; its PID, and what it says."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        yield process.pid, process.stdout.readline().strip()
        process.terminate()


def test_a_port_that_another_program_holds_is_told_with_its_pid(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    master, slave = os.openpty()
    try:
        with holder(HOLD_LOCKED, os.ttyname(slave)) as (pid, _):
            text = SPI.format(os.ttyname(slave)) + MODEL + published(tmp_path)
            (told,) = look(tmp_path, capsys, text)
    finally:
        os.close(master)
        os.close(slave)
    assert told["cause"] == "port-held"
    assert f"PID {pid}, {sys.executable} -c" in told["what"]
    assert told["advice"] == f"end it: kill {pid}"


def test_a_reader_without_a_lock_is_told_with_its_pid(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], healthy: str
) -> None:
    port = tmp_path / "bridge"
    with holder(HOLD_OPEN, port) as (pid, _):
        (told,) = look(tmp_path, capsys, healthy + MODEL + published(tmp_path))
    assert told["cause"] == "port-held"
    assert told["level"] == "warning"
    assert f"{port} is open in another program" in told["what"]
    assert f"PID {pid}, " in told["what"]
    assert told["advice"] == f"end it: kill {pid}"


def test_a_port_that_graspd_itself_holds_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], healthy: str
) -> None:
    scene = tmp_path / "running.toml"
    scene.write_text(healthy + MODEL + published(tmp_path))
    with start("run", scene) as daemon:
        wait_for(tmp_path / "graspd")
        (told,) = look(tmp_path, capsys, scene.read_text())
        daemon.send_signal(signal.SIGTERM)
    assert told["cause"] == "port-held"
    assert f"PID {daemon.pid}, " in told["what"]
    assert f"run {scene}" in told["what"]
    assert told["advice"].startswith("graspd itself runs")


def test_a_udp_port_that_another_program_holds_is_told_with_its_pid(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with holder(HOLD_UDP) as (pid, port):
        text = f'[tactile]\ndriver = "palm"\nsource = "udp://127.0.0.1:{port}"\n'
        (told,) = look(tmp_path, capsys, text + MODEL + published(tmp_path))
    assert told["cause"] == "port-held"
    assert f"PID {pid}, " in told["what"]


def test_an_address_of_another_computer_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = '[tactile]\ndriver = "palm"\nsource = "udp://192.0.2.1:9870"\n'
    (told,) = look(tmp_path, capsys, text + MODEL + published(tmp_path))
    assert told["cause"] == "address"
    text += (
        f'[joints]\ndriver = "stream"\nsource = "udp://127.0.0.1:{free_port(socket.SOCK_DGRAM)}"\n'
    )
    _, joints = look(tmp_path, capsys, text + MODEL + published(tmp_path))
    assert joints["what"] == "joints: link greeting"
    assert joints["cause"] == "silent"


def test_an_interface_that_is_missing_is_told_with_those_that_there_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    there = [computer.CanInterface("can9", "error-active", 500_000)]
    monkeypatch.setattr(computer, "can_interfaces", lambda: there)
    (told,) = look(tmp_path, capsys, CAN.format("can7") + MODEL + published(tmp_path))
    assert told["cause"] == "interface-missing"
    assert "sudo ip link set can7 up type can bitrate 1000000 restart-ms 100" in told["advice"]
    doctor.run(_arguments(tmp_path / "scene.toml"))
    people = capsys.readouterr().out
    assert "ok CAN interface can9 is error-active, 500000 bit/s\n" in people


@pytest.mark.parametrize(
    ("interface", "more", "cause", "advice"),
    [
        (("down", None), "", "interface-down", "sudo ip link set lo up type can bitrate 1000000"),
        (
            ("down", None),
            'format = "sweep_fd"\n',
            "interface-down",
            "bitrate 1000000 dbitrate 5000000 fd on restart-ms 100",
        ),
        (
            ("error-active", 500_000),
            "",
            "bitrate",
            "sudo ip link set lo down; sudo ip link set lo up type can bitrate 1000000",
        ),
        (("error-active", 1_000_000), "", "silent", "is it on and connected?"),
    ],
)
def test_an_interface_that_is_down_or_at_another_rate_is_told_with_the_command(
    interface: tuple[str, int | None],
    more: str,
    cause: str,
    advice: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    there = computer.CanInterface(LOOPBACK, *interface)
    monkeypatch.setattr(computer, "can_interfaces", lambda: [there])
    with SocketBus() as bus:
        monkeypatch.setattr("drivers.can.bus.can.Bus", lambda **_: bus)
        text = CAN.format(LOOPBACK) + more + MODEL + published(tmp_path)
        (told,) = look(tmp_path, capsys, text)
    assert told["cause"] == cause
    assert advice in told["advice"]


@pytest.mark.parametrize("state", ["bus-off", "error-passive"])
def test_a_controller_in_trouble_is_not_said_to_be_fine(state: str) -> None:
    told = can_finding(computer.CanInterface("can0", state, 1_000_000))
    assert (told.level, told.cause) == (Level.WARNING, Cause.BUS_ERRORS)
    assert "sudo ip link set can0 down; sudo ip link set can0 up type can" in (told.advice or "")


def test_a_board_that_is_heard_has_the_bit_rate_of_its_interface(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    there = computer.CanInterface(LOOPBACK, "error-active", 500_000)
    monkeypatch.setattr(computer, "can_interfaces", lambda: [there])
    with SocketBus() as bus:
        monkeypatch.setattr("drivers.can.bus.can.Bus", lambda **_: bus)
        for sweep in range(3):
            for frame in sweep_of_frames(sweep):
                bus.send(frame)
        text = CAN.format(LOOPBACK) + 'sequence = "electrodes"\n' + MODEL + published(tmp_path)
        told = look(tmp_path, capsys, text)
    assert {finding["cause"] for finding in told} == {"link-lost"}, told


@pytest.mark.parametrize(
    ("host", "cause"), [("127.0.0.1", "socket-held"), ("192.0.2.1", "address")]
)
def test_a_port_to_publish_on_that_cannot_be_had_is_told(
    host: str, cause: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], healthy: str
) -> None:
    with holder(HOLD_TCP) as (pid, port):
        endpoint = f'[publish]\nendpoint = "tcp://{host}:{port}"\n'
        if cause == "address":
            endpoint += '[curve]\nsecret_key = "k"\nclients = "c"\n'
        told = look(tmp_path, capsys, healthy + MODEL + endpoint)
    mine = [finding for finding in told if not finding["what"].startswith("spi: ")]
    assert [finding["cause"] for finding in mine] == [cause]
    assert (f"PID {pid}, " in mine[0]["what"]) == (cause == "socket-held")


def test_what_the_kernel_says_of_controllers_is_read(tmp_path: Path) -> None:
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


SURROUNDINGS: dict[str, tuple[str, str, str]] = {
    "model missing": ('[model]\npath = "absent.onnx"\n', "model-missing", "graspd models"),
    "model of no zoo": ('[model]\nname = "nonesuch"\n', "model-missing", "graspd models"),
    "model that is none": ('[model]\npath = "scene.toml"\n', "model-misfit", "graspd models"),
    "folder missing": (
        MODEL + '[publish]\nendpoint = "ipc://{folder}/absent/graspd"\n',
        "socket-folder",
        "sudo install -d -o $USER {folder}/absent",
    ),
    "no socket there": (
        MODEL + '[publish]\nendpoint = "ipc://{folder}/scene.toml"\n',
        "socket-held",
        "mv {folder}/scene.toml",
    ),
    "no such group": (
        MODEL + '[publish]\nendpoint = "ipc://{folder}/graspd"\ngroup = "nonesuch"\n',
        "socket-group",
        "sudo groupadd --system nonesuch",
    ),
}


@pytest.mark.parametrize("wrong", SURROUNDINGS)
def test_what_is_wrong_around_a_healthy_bridge_is_told_by_its_name(
    wrong: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], healthy: str
) -> None:
    more, cause, advice = SURROUNDINGS[wrong]
    text = healthy + more.format(folder=tmp_path)
    told = look(tmp_path, capsys, text if "[publish]" in text else text + published(tmp_path))
    mine = [finding for finding in told if not finding["what"].startswith("spi: ")]
    assert [finding["cause"] for finding in mine] == [cause], told
    assert advice.format(folder=tmp_path) in mine[0]["advice"]


def test_a_socket_that_graspd_holds_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "graspd.lock").touch()
    text = (
        f'[tactile]\ndriver = "palm"\nsource = "udp://127.0.0.1:{free_port(socket.SOCK_DGRAM)}"\n'
    )
    with holder(HOLD_LOCKED, tmp_path / "graspd.lock") as (pid, _):
        told = look(tmp_path, capsys, text + MODEL + published(tmp_path))
    assert [finding["cause"] for finding in told] == ["silent", "socket-held"]
    assert f"PID {pid}, " in told[1]["what"]


def test_rights_that_a_user_lacks_are_told(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    healthy: str,
) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 12345)
    monkeypatch.setattr("os.getegid", lambda: 12345)
    monkeypatch.setattr("os.getgroups", list)
    monkeypatch.setattr("os.sched_setscheduler", refused(errno.EPERM))
    text = healthy + MODEL + "[realtime]\npriority = 40\nlock_memory = false\n"
    told = look(tmp_path, capsys, text + published(tmp_path, 'group = "daemon"\n'))
    mine = {f["cause"]: f["advice"] for f in told if not f["what"].startswith("spi: ")}
    assert mine.keys() == {"socket-group", "realtime"}
    assert mine["socket-group"] == "sudo usermod -aG daemon $USER, then log in again"
    assert "LimitRTPRIO=40" in mine["realtime"]


def test_a_folder_that_one_may_not_write_is_told(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    healthy: str,
) -> None:
    monkeypatch.setattr("os.access", lambda *_: False)
    told = look(tmp_path, capsys, healthy + MODEL + published(tmp_path))
    mine = [finding for finding in told if not finding["what"].startswith("spi: ")]
    assert [finding["cause"] for finding in mine] == ["socket-denied"]


# ---- how it is said -----------------------------------------------------------------------------


def test_a_terminal_of_80_columns_is_not_overrun_and_elsewhere_a_finding_is_a_line() -> None:
    advice = "look at this and at that, " * 8
    told = [
        Finding(Level.ERROR, "something is wrong " * 6, Cause.SLOW, advice),
        Finding(Level.OK, "something is fine"),
    ]
    people = list(doctor.in_words(told, 80))
    assert max(map(len, people)) <= 80
    assert people[0].startswith("!! something")
    assert sum(line.startswith("   -> look") for line in people) == 1
    assert people[-3:] == ["ok something is fine", "", "1 wrong, 0 to look at"]
    assert len(list(doctor.in_words(told, None))) == len(told) + 2


def test_the_table_of_electrodes_is_shown_with_all_only_and_fits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], healthy: str
) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text(healthy + MODEL + published(tmp_path))
    doctor.run(_arguments(scene))
    assert "mean, sd, faulty" not in capsys.readouterr().out
    doctor.run(_arguments(scene, "--all"))
    _, table = capsys.readouterr().out.split("to look at\n\n")
    lines = table.splitlines()
    assert len(lines) == 25
    assert max(map(len, lines)) <= 80
    assert [line.split()[0] for line in lines[1:]] == [str(number) for number in range(1, 25)]
