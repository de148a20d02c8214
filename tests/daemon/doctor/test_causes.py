"""The doctor reports each fault by the name of its cause, with advice, and nothing else."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from graspd.daemon.commands import doctor
from graspd.daemon.doctor import computer, surroundings
from graspd.daemon.doctor.electrodes import ElectrodeStatistics
from graspd.daemon.doctor.finding import Cause, Level
from graspd.daemon.doctor.surroundings import can_finding
from graspd.drivers.datagrams.tactile import TactileStreamDriver
from graspd.drivers.twins import spi as spi_twin
from graspd.drivers.twins.grasps.whole_grasps import synthetic_grasps
from tests.daemon.doctor.emulated import CAN, FINGERS, SPI, asked, look, refused, scene_of
from tests.daemon.processes import start
from tests.drivers.can.can_standin import LOOPBACK, SocketBus, sweep_of_frames
from tests.kit.clock import Clock
from tests.kit.inside import graspd
from tests.kit.waiting import wait_until
from tests.ports import free_port


@pytest.fixture
def healthy(tmp_path: Path) -> Iterator[str]:
    """Text of `[tactile]` for a simulated bridge without faults, which sends in real time."""
    counts, done = (moment.counts for moment in synthetic_grasps(loop=True)), threading.Event()
    with spi_twin.SpiTwin(tmp_path / "bridge", counts) as twin:
        thread = threading.Thread(target=twin.serve, args=(done.is_set,))
        thread.start()
        yield f'[tactile]\ndriver = "spi"\nport = "{twin.path}"\n'
        done.set()
        thread.join()


@pytest.mark.parametrize(
    ("group", "advice"),
    [
        ("dialout", "sudo usermod -aG dialout $USER, then log in again"),
        ("root", "Install deploy/udev/70-graspd.rules, and plug it in again."),
    ],
)
def test_a_denied_port_is_reported_with_advice_for_its_group(
    group: str, advice: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("serial.serial_for_url", refused(errno.EACCES))
    monkeypatch.setattr("grp.getgrgid", lambda number: SimpleNamespace(gr_name=group))
    (told,) = look(tmp_path, SPI.format("/dev/tty"))
    assert (told["cause"], told["advice"]) == ("port-denied", advice)


@pytest.fixture
def pid(monkeypatch: pytest.MonkeyPatch) -> int:
    """Id of this process, which the doctor then counts as another one."""
    number = os.getpid()
    monkeypatch.setattr("os.getpid", lambda: 1)
    return number


HOLD = """
import fcntl, sys
held = open(sys.argv[1], "rb", 0)
if sys.argv[2:]:
    fcntl.flock(held, fcntl.LOCK_EX)
print(flush=True)
sys.stdin.read()
"""


@contextlib.contextmanager
def holder(path: object, *locks: str) -> Iterator[int]:
    """Id of another process that has a file open, and locked if any `locks` are given."""
    command = [sys.executable, "-c", HOLD, str(path), *locks]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        yield process.pid
        process.terminate()


def test_a_held_port_is_reported_with_the_holders_pid(tmp_path: Path) -> None:
    master, slave = os.openpty()
    try:
        with holder(os.ttyname(slave), "locks") as other:
            (told,) = look(tmp_path, SPI.format(os.ttyname(slave)))
    finally:
        os.close(master)
        os.close(slave)
    assert told["cause"] == "port-held"
    assert f"PID {other}, {sys.executable} -c" in told["what"]
    assert told["advice"] == f"End it: kill {other}"


def test_another_reader_of_the_port_is_reported_with_its_pid(tmp_path: Path, healthy: str) -> None:
    found: list[dict[str, str]] = []

    def is_a_warning() -> bool:  # an error while a busy computer brings no readings
        found[:] = look(tmp_path, healthy)
        return [(each["cause"], each["level"]) for each in found] == [("port-held", "warning")]

    with holder(tmp_path / "bridge") as other:
        wait_until(is_a_warning)
    (told,) = found
    assert f"{tmp_path / 'bridge'} is open in another program" in told["what"]
    assert f"PID {other}, " in told["what"]
    assert told["advice"] == f"End it: kill {other}"


def test_a_port_that_graspd_itself_holds_is_reported(tmp_path: Path, healthy: str) -> None:
    scene = scene_of(tmp_path, healthy)
    with start("run", scene) as daemon:
        found: list[dict[str, str]] = []

        def is_held() -> bool:  # it opens the port after the sockets, and locks it then
            found[:] = look(tmp_path, scene.read_text())
            return [each["cause"] for each in found] == ["port-held"]

        wait_until(is_held)
        daemon.send_signal(signal.SIGTERM)
    (told,) = found
    assert f"PID {daemon.pid}, " in told["what"]
    assert f"run {scene}" in told["what"]
    assert told["advice"].startswith("graspd itself runs")


def test_a_missing_interface_is_reported_with_the_present_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = [computer.CanInterface("can9", "error-active", 500_000)]
    monkeypatch.setattr(computer, "can_interfaces", lambda: there)
    text = CAN.format("can7")
    (told,) = look(tmp_path, text)
    assert told["cause"] == "interface-missing"
    assert "sudo ip link set can7 up type can bitrate 1000000 restart-ms 100" in told["advice"]
    people = asked(tmp_path, text).stdout
    assert "ok CAN interface can9 is error-active, 500000 bit/s\n" in people


@pytest.mark.parametrize(
    ("interface", "cause", "advice"),
    [
        (("down", None), "interface-down", "sudo ip link set lo up type can bitrate 1000000"),
        (
            ("error-active", 500_000),
            "bitrate",
            "sudo ip link set lo down; sudo ip link set lo up type can bitrate 1000000",
        ),
        (("error-active", 1_000_000), "silent", "Check power and connection"),
    ],
)
def test_a_silent_can_interface_is_explained_by_its_kernel_state(
    interface: tuple[str, int | None],
    cause: str,
    advice: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    there = computer.CanInterface(LOOPBACK, *interface)
    monkeypatch.setattr(computer, "can_interfaces", lambda: [there])
    with SocketBus() as bus:
        monkeypatch.setattr("graspd.drivers.can.bus.can.Bus", lambda **_: bus)
        (told,) = look(tmp_path, CAN.format(LOOPBACK))
    assert told["cause"] == cause
    assert advice in told["advice"]


@pytest.mark.parametrize("state", ["bus-off", "error-passive"])
def test_a_bus_off_or_error_passive_controller_is_a_warning(state: str) -> None:
    told = can_finding(computer.CanInterface("can0", state, 1_000_000))
    assert (told.level, told.cause) == (Level.WARNING, Cause.BUS_ERRORS)
    assert "sudo ip link set can0 down; sudo ip link set can0 up type can" in (told.advice or "")


def test_no_bit_rate_finding_while_a_can_board_sends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = computer.CanInterface(LOOPBACK, "error-active", 500_000)
    monkeypatch.setattr(computer, "can_interfaces", lambda: [there])
    with SocketBus() as bus:
        monkeypatch.setattr("graspd.drivers.can.bus.can.Bus", lambda **_: bus)
        for sweep in range(3):
            for frame in sweep_of_frames(sweep):
                bus.send(frame)
        told = look(tmp_path, CAN.format(LOOPBACK) + 'sequence = "electrodes"\n')
    assert {finding["cause"] for finding in told} == {"link-lost"}, told


@pytest.mark.parametrize(
    ("host", "cause"), [("127.0.0.1", "socket-held"), ("192.0.2.1", "address")]
)
def test_a_tcp_endpoint_that_cannot_be_bound_is_reported(
    host: str, cause: str, tmp_path: Path, healthy: str, pid: int
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as held:
        endpoint = f'[publish]\nendpoint = "tcp://{host}:{held.getsockname()[1]}"\n'
        if cause == "address":
            endpoint += '[curve]\nsecret_key = "k"\nclients = "c"\n'
        told = look(tmp_path, healthy + endpoint)
    mine = [finding for finding in told if not finding["what"].startswith("spi: ")]
    assert [finding["cause"] for finding in mine if finding["cause"] != "keys"] == [cause]
    assert (f"PID {pid}, " in mine[0]["what"]) == (cause == "socket-held")


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ('[tactile]\ndriver = "palm"\nsource = "udp://127.0.0.1:872"\n', "port-denied"),
        ('[publish]\nendpoint = "tcp://127.0.0.1:557"\n', "socket-denied"),
        ('[publish]\nendpoint = "tcp://[::1]:557"\n', "socket-denied"),
    ],
)
def test_a_port_that_only_root_may_use_is_reported(
    text: str, cause: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, healthy: str
) -> None:
    ports = tmp_path / "ip_unprivileged_port_start"
    ports.write_text("1000\n")  # ip(7): below it a port needs CAP_NET_BIND_SERVICE
    monkeypatch.setattr(surroundings, "PORTS_OF_ROOT", ports)
    monkeypatch.setattr("socket.socket.bind", refused(errno.EACCES))
    told = look(tmp_path, text if "tactile" in text else healthy + text)
    (mine,) = (finding for finding in told if finding["cause"] == cause)
    assert mine["advice"].startswith("Ports below 1000 are root's: name a higher one")
    assert "address" not in {finding["cause"] for finding in told}


SURROUNDINGS: dict[str, tuple[str, str, str]] = {
    "model missing": ('[model]\npath = "absent.onnx"\n', "model-missing", "graspd models"),
    "model of no zoo": ('[model]\nname = "nonesuch"\n', "model-missing", "graspd models"),
    "model that is none": ('[model]\npath = "scene.toml"\n', "model-misfit", "graspd models"),
    "folder missing": (
        '[publish]\nendpoint = "ipc://{folder}/absent/graspd"\n',
        "socket-folder",
        "sudo install -d -o $USER {folder}/absent",
    ),
    "no socket there": (
        '[publish]\nendpoint = "ipc://{folder}/scene.toml"\n',
        "socket-held",
        "mv {folder}/scene.toml",
    ),
    "no such group": (
        '[publish]\nendpoint = "ipc://{folder}/graspd"\ngroup = "nonesuch"\n',
        "socket-group",
        "sudo groupadd --system nonesuch",
    ),
    "no key": (
        '[publish]\nendpoint = "ipc://{folder}/graspd"\n'
        '[curve]\nsecret_key = "{folder}/daemon.key_secret"\nclients = "{folder}"\n',
        "keys",
        "graspd keys list --dir {folder}",
    ),
    "folder of the session": (
        '[publish]\nendpoint = "ipc://{folder}/graspd"\n'
        '[session]\nkeep = true\nfolder = "/proc/nowhere.session"\n',
        "folder",
        "[session] folder",
    ),
    "folder of the recordings": (
        '[publish]\nendpoint = "ipc://{folder}/graspd"\n'
        '[record]\ndirectory = "{folder}/scene.toml/in"\n',
        "folder",
        "[record] directory",
    ),
    "no such user": (
        '[publish]\nendpoint = "ipc://{folder}/graspd"\n'
        '[ask]\nendpoint = "ipc://{folder}/ask"\ntell = ["root", "nonesuch"]\n',
        "socket-user",
        "getent passwd",
    ),
}


@pytest.mark.parametrize("wrong", SURROUNDINGS)
def test_each_fault_of_model_sockets_or_keys_is_reported(
    wrong: str, tmp_path: Path, healthy: str
) -> None:
    more, cause, advice = SURROUNDINGS[wrong]
    told = look(tmp_path, healthy + more.format(folder=tmp_path))
    mine = [finding for finding in told if not finding["what"].startswith("spi: ")]
    assert [finding["cause"] for finding in mine] == [cause], told
    assert advice.format(folder=tmp_path) in mine[0]["advice"]


def test_a_socket_held_by_another_process_is_reported(tmp_path: Path, pid: int) -> None:
    (tmp_path / "graspd.lock").touch()
    text = (
        f'[tactile]\ndriver = "palm"\nsource = "udp://127.0.0.1:{free_port(socket.SOCK_DGRAM)}"\n'
    )
    with (tmp_path / "graspd.lock").open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        told = look(tmp_path, text)
    assert [finding["cause"] for finding in told] == ["silent", "socket-held"]
    assert "send to udp://127.0.0.1:" in told[0]["advice"]
    assert f"PID {pid}, " in told[1]["what"]


def test_rights_that_a_user_lacks_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, healthy: str
) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 12345)
    monkeypatch.setattr("os.getegid", lambda: 12345)
    monkeypatch.setattr("os.getgroups", list)
    monkeypatch.setattr("os.sched_setscheduler", refused(errno.EPERM))
    monkeypatch.setattr("os.access", lambda *_: False)
    text = f'{healthy}[publish]\nendpoint = "ipc://{tmp_path}/graspd"\ngroup = "daemon"\n'
    told = look(tmp_path, f"{text}[realtime]\npriority = 40\n")
    mine = {f["cause"]: f["advice"] for f in told if not f["what"].startswith("spi: ")}
    assert mine.keys() == {"socket-denied", "socket-group", "realtime"}
    assert mine["socket-group"] == "sudo usermod -aG daemon $USER, then log in again"
    assert "LimitRTPRIO=40" in str(told)


def test_what_is_heard_of_two_bridges_is_told_apart(
    healthy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there, absent = str(tmp_path / "bridge"), str(tmp_path / "absent")
    ports = [computer.SerialPort(name, "n/a", None, 1, "graspd") for name in (there, absent)]
    monkeypatch.setattr(computer, "serial_ports", lambda: ports)
    report = json.loads(graspd("doctor", "--listen", 1, "--json").stdout)
    assert report["bridges"][there]["readings"] > report["bridges"][absent]["readings"] == 0
    wrong = [each["what"] for each in report["findings"] if each["cause"] == "port-missing"]
    assert [what.startswith(f"{absent}: ") for what in wrong] == [True]
    assert f"\n\n{there}\n\n" in graspd("doctor", "--listen", 1, "--all").stdout


def test_option_all_prints_electrodes_within_80_columns(tmp_path: Path, healthy: str) -> None:
    assert "mean, sd, faulty" not in asked(tmp_path, healthy).stdout
    _, table = asked(tmp_path, healthy, "--all").stdout.split("to look at\n\n")
    lines = table.splitlines()
    assert len(lines) == 25
    assert max(map(len, lines)) <= 80
    assert [line.split()[0] for line in lines[1:]] == [str(number) for number in range(1, 25)]


SWEEP = json.dumps({"counts": {finger: [*range(2000, 2024)] for finger in FINGERS}})
UNTIMED = SWEEP.encode()
NUMBERED = SWEEP.replace("{", '{"seq": 5, ', 1).encode()


@pytest.mark.parametrize(
    ("only_from", "data", "cause", "says"),
    [
        ("127.0.0.2", NUMBERED, Cause.FOREIGN_SENDER, "of 127.0.0.1 are refused by only_from"),
        (
            None,
            NUMBERED.replace(b"{", b'{"hand": "left", ', 1),
            Cause.FOREIGN_SENDER,
            "other hands",
        ),
        (None, UNTIMED, Cause.MESSAGES, "but 20 bad messages"),
        (None, NUMBERED, Cause.REPEATED, "but 19 old messages"),
        (None, b"", Cause.SILENT, "link greeting"),
    ],
    ids=["refused", "another hand", "no number", "all repeats", "nothing"],
)
def test_datagrams_that_give_no_reading_are_explained(
    only_from: str | None, data: bytes, cause: Cause, says: str
) -> None:
    clock = Clock()
    driver = TactileStreamDriver("udp://127.0.0.1:0", only_from=only_from, clock=clock)
    with driver, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for _ in range(20 if data else 0):
            sender.sendto(data, ("127.0.0.1", driver.port or 0))
            driver.read_ready()
        clock.now_ns += 500_000_000
        driver.read_ready()
        (told,) = doctor.examine(driver, ElectrodeStatistics(FINGERS), 1.0)
    assert (told.level, told.cause) == (Level.ERROR, cause)
    assert says in told.what
