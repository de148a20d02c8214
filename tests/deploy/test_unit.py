"""The unit and its companions, as the tools of systemd and the daemon itself see them."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from graspd.daemon.scene import Scene
from graspd.daemon.scene.drivers import SpiTactile
from graspd.daemon.scene.scene import STATE_DIRECTORY, Hand, Realtime
from tests.deploy.staging import DEPLOY, INSTALLER
from tests.kit.programs import ran

UNIT = DEPLOY / "systemd/graspd@.service"
EXPOSURE_MAX_TENTHS = 25
"""Largest exposure by `systemd-analyze security`, in tenths: from 0 (closed) to 100 (open)."""


def settings(path: Path) -> dict[str, list[str]]:
    """Return the values of each key of a file in the syntax of systemd.syntax(7)."""
    found: dict[str, list[str]] = {}
    for key, value in re.findall(r"^(\w+)=(.*)$", path.read_text(), re.MULTILINE):
        found.setdefault(key, []).append(value)
    return found


def tool(name: str, package: str) -> str:
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"no {name}: apt install {package}")
    return path


def test_systemd_understands_the_unit(tmp_path: Path) -> None:
    analyze = tool("systemd-analyze", "systemd")
    program = tmp_path / "venv/bin/graspd"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    unit = tmp_path / UNIT.name
    unit.write_text(UNIT.read_text().replace("/opt/graspd", str(tmp_path)))
    done = ran(analyze, "verify", "--recursive-errors=no", unit)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_units_security_exposure_is_below_the_limit() -> None:
    analyze = tool("systemd-analyze", "systemd")
    options = ["--offline=true", f"--threshold={EXPOSURE_MAX_TENTHS}", "--no-pager"]
    done = ran(analyze, "security", *options, UNIT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Overall exposure level for graspd@" in done.stdout


def test_systemd_makes_the_user_and_its_groups(tmp_path: Path) -> None:
    sysusers = tool("systemd-sysusers", "systemd")
    (tmp_path / "etc").mkdir()
    done = ran(sysusers, f"--root={tmp_path}", DEPLOY / "sysusers.d/graspd.conf")
    assert done.returncode == 0, done.stderr
    passwd = (tmp_path / "etc/passwd").read_text()
    group = (tmp_path / "etc/group").read_text()
    assert re.search(r"^graspd:.*:/var/lib/graspd:\S*nologin$", passwd, re.MULTILINE)
    assert re.search(r"^dialout:.*:graspd$", group, re.MULTILINE)


def test_udev_understands_the_rules() -> None:
    udevadm = tool("udevadm", "udev")
    if "verify" not in ran(udevadm, "--help").stdout:
        pytest.skip("udevadm verify came with systemd 254")
    done = ran(udevadm, "verify", DEPLOY / "udev/70-graspd.rules")
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_units_paths_restarts_and_commands_fit_the_daemon() -> None:
    unit = settings(UNIT)
    scene = Scene(hand=Hand(name="left"), tactile=SpiTactile(driver="spi", port="/dev/ttyACM0"))
    (runtime,), (state,) = unit["RuntimeDirectory"], unit["StateDirectory"]
    assert scene.endpoint == f"ipc:///run/{runtime}/left.ipc"
    assert Path("/var/lib") / state == STATE_DIRECTORY
    assert unit["Restart"] == ["on-failure"]  # after a sleep of the computer, too
    assert unit["RestartPreventExitStatus"] == ["2"]
    assert unit["ExecStart"][0].endswith(" run /etc/graspd/%i.toml")
    # The dash: systemd obeys RestartPreventExitStatus= of the main process only.
    (before,) = unit["ExecStartPre"]
    assert before.startswith("-/opt/graspd/")
    assert before.endswith(" check /etc/graspd/%i.toml")


def test_the_unit_tells_the_users_of_peers_apart() -> None:
    # systemd.exec(5): PrivateUsers=yes shows all users but root and the unit's own as one.
    assert settings(UNIT)["PrivateUsers"] == ["no"]


def test_every_priority_that_a_scene_may_name_is_granted() -> None:
    (limit,) = settings(UNIT)["LimitRTPRIO"]
    assert Realtime(priority=int(limit)).priority == int(limit)
    with pytest.raises(ValueError, match="priority"):
        Realtime(priority=int(limit) + 1)


def test_the_unit_and_tmpfiles_make_folders_with_equal_rights() -> None:
    unit = settings(UNIT)
    wanted = {
        f"/run/{unit['RuntimeDirectory'][0]}": unit["RuntimeDirectoryMode"][0],
        f"/var/lib/{unit['StateDirectory'][0]}": unit["StateDirectoryMode"][0],
    }
    lines = (DEPLOY / "tmpfiles.d/graspd.conf").read_text().splitlines()
    made = [line.split() for line in lines if not line.startswith("#")]
    assert {path: mode for _, path, mode, *_ in made} == wanted
    owner = [unit["User"][0], unit["Group"][0]]
    assert all([kind, *rest] == ["d", *owner, "-"] for kind, _, _, *rest in made)


def test_the_network_file_sets_the_protocols_bit_rate() -> None:
    network = settings(DEPLOY / "network/80-graspd-can.network")
    protocol = (DEPLOY / "can/PROTOCOL.md").read_text()
    assert "ip link set can0 type can bitrate 1000000 restart-ms 100\n" in protocol
    assert (network["BitRate"], network["RestartSec"]) == (["1M"], ["100ms"])


def test_shellcheck_finds_nothing_in_the_installer() -> None:
    done = ran(tool("shellcheck", "shellcheck"), INSTALLER)
    assert (done.returncode, done.stdout) == (0, "")
