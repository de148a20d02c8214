"""Messages to systemd, as sd_notify(3) and sd_watchdog_enabled(3) specify them."""

from __future__ import annotations

import logging
import os
import re
import socket
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from graspd.daemon.judge.reasons import Decision, GateState, Reason
from graspd.daemon.publish.messages import State
from graspd.daemon.run.systemd import Systemd, in_a_line
from tests.daemon.fakes import MS, Clock
from tests.daemon.session.learning import NOBODY
from tests.kit.messages import GOLDEN_STATUS


@pytest.fixture
def ears(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ears:
        ears.bind(str(tmp_path / "notify"))
        ears.settimeout(100.0)
        yield ears


@pytest.fixture
def systemd(ears: socket.socket) -> Iterator[Systemd]:
    manager = Systemd.of({"NOTIFY_SOCKET": ears.getsockname(), "WATCHDOG_USEC": "2000000"})
    assert manager is not None
    yield manager
    manager.close()


def heard(ears: socket.socket) -> list[str]:
    return ears.recv(4096).decode().split("\n")


def test_the_ready_message_also_has_a_status_text(ears: socket.socket, systemd: Systemd) -> None:
    systemd.ready("ready: spi, cnn1")
    assert heard(ears) == ["READY=1", "STATUS=ready: spi, cnn1"]


def test_the_watchdog_is_fed_four_times_within_its_timeout(ears: socket.socket) -> None:
    clock = Clock()
    manager = Systemd(ears.getsockname(), 2_000_000, clock)
    ears.setblocking(False)
    fed_ms = []
    for elapsed_ms in range(0, 2000, 10):
        manager.after_round()
        try:
            assert heard(ears) == ["WATCHDOG=1"]
        except BlockingIOError:
            pass
        else:
            fed_ms.append(elapsed_ms)
        clock.now_ns += 10 * MS
    assert fed_ms == [0, 500, 1000, 1500]
    manager.close()


def test_without_a_watchdog_no_keep_alive_is_sent(ears: socket.socket) -> None:
    manager = Systemd(ears.getsockname())
    manager.after_round()
    manager.stopping()
    assert heard(ears) == ["STOPPING=1", "STATUS=stopping"]
    manager.close()


@pytest.mark.parametrize(
    ("environment", "watched"),
    [
        ({}, False),
        ({"WATCHDOG_USEC": "1000"}, True),
        ({"WATCHDOG_USEC": "1000", "WATCHDOG_PID": str(os.getpid())}, True),
        ({"WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}, False),
        ({"WATCHDOG_USEC": "0"}, False),
        ({"WATCHDOG_USEC": "-5"}, False),
        ({"WATCHDOG_USEC": "soon"}, False),
    ],
)
def test_only_a_valid_watchdog_timeout_for_this_process_counts(
    environment: dict[str, str], watched: bool
) -> None:
    manager = Systemd.of({"NOTIFY_SOCKET": "/nowhere", **environment})
    assert manager is not None
    assert (manager.before_wait(NOBODY) is not None) is watched
    manager.close()


@pytest.mark.parametrize("address", ["", "relative", "vsock:2:1234"])
def test_an_unsupported_notify_address_means_no_manager(address: str) -> None:
    assert Systemd.of({"NOTIFY_SOCKET": address}) is None


def test_messages_reach_a_manager_at_an_abstract_socket() -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ears:
        name = f"graspd-test-{os.getpid()}"
        ears.bind(f"\0{name}")
        ears.settimeout(100.0)
        manager = Systemd(f"@{name}")
        manager.ready("ready")
        assert heard(ears)[0] == "READY=1"
        manager.close()


def test_a_manager_that_is_gone_costs_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    manager = Systemd(str(tmp_path / "gone"))
    with caplog.at_level(logging.DEBUG):
        manager.ready("ready")
        manager.stopping()
    levels = [record.levelno for record in caplog.records]
    assert levels == [logging.WARNING, logging.DEBUG]
    manager.close()


def test_the_status_line_names_state_rate_verdicts_and_troubles() -> None:
    status = GOLDEN_STATUS
    assert status.state is State.RUNNING
    assert status.verdicts[Decision.SLIP] == 1
    assert status.gate is GateState.IDLE
    assert status.health["ff_7"] is Reason.SATURATED
    assert in_a_line(status, late=2) == (
        "running: 100.0 readings/s, 1 stable, 1 slip, 1 unknown, gate idle, 2 late just now, "
        "ff_7 saturated, mf not-tared"
    )
    overloaded = msgspec.structs.replace(status, overloaded=True)
    assert "gate idle, overloaded, 4 readings left out, ff_7" in in_a_line(overloaded, late=0)


UNPLUGGED = dict.fromkeys((f"mf_{n}" for n in range(1, 25)), Reason.SENSOR_MISSING)
NOT_TARED = dict.fromkeys(("ff", "mf", "th"), Reason.NOT_TARED)


@pytest.mark.parametrize(
    ("health", "shown"),
    [
        ({**NOT_TARED, "link": Reason.STALE}, "link stale"),
        ({**NOT_TARED, **UNPLUGGED}, "mf sensor-missing, ff and th not-tared"),
        (
            {"session": Reason.NOT_CALIBRATED, "ff": Reason.NOT_TARED, "ff_7": Reason.SATURATED},
            "ff_7 saturated, ff not-tared, session not-calibrated",
        ),
    ],
)
def test_the_status_line_names_causes_first_and_no_consequences(
    health: dict[str, Reason], shown: str
) -> None:
    line = in_a_line(msgspec.structs.replace(GOLDEN_STATUS, health=health), late=0)
    assert line.endswith(f", gate idle, {shown}")


def test_only_late_readings_since_the_last_status_are_shown(
    ears: socket.socket, systemd: Systemd
) -> None:
    for count in (3, 3, 5):
        systemd.on_status(msgspec.structs.replace(GOLDEN_STATUS, late_readings=count))
    late = [re.findall(r"(\d+) late", heard(ears)[0]) for _ in range(3)]
    assert late == [["3"], [], ["2"]]
