"""`graspd doctor [SCENE]`: what hardware, model and privileges are there, and what is wrong."""

from __future__ import annotations

import argparse
import dataclasses
import grp
import json
import os
import resource
import select
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from daemon import scene
from daemon.assembly import assembly
from daemon.commands.arguments import within
from daemon.commands.diagnosis import (
    ElectrodeStatistics,
    Finding,
    Level,
    counter_findings,
    device_findings,
    rate_finding,
)
from daemon.process.text import complain, printable
from drivers.base import Driver, LinkError, TactileReading
from models.contract import ModelError

LISTEN_S = 3.0
LISTEN_MIN_S, LISTEN_MAX_S = 0.1, 3600.0
WAIT_S = 0.02
"""Longest sleep between two looks at a driver, s."""
ARPHRD_CAN = "280"
"""Type of a CAN interface in `/sys/class/net/*/type`."""
GROUPS = {"spi": "dialout"}
"""Group that a driver's device belongs to on Debian and Ubuntu."""
BRIDGE_NAME = "graspd"
BRIDGE_VENDOR = 0x2E8A
"""Raspberry Pi, whose Pico the bridge's sketch is for. Only ports of this vendor, or with the name
above in their description, are greeted unasked: other devices may not like it."""
MARKS = {Level.OK: "ok ", Level.WARNING: "!  ", Level.ERROR: "!! "}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "scene", type=Path, nargs="?", help="scene whose devices, model and socket are looked at"
    )
    parser.add_argument(
        "--listen",
        type=within(LISTEN_MIN_S, LISTEN_MAX_S),
        default=LISTEN_S,
        metavar="S",
        help="listen so long (default: 3)",
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")


def run(args: argparse.Namespace) -> int:
    """Examine; 0 if nothing is wrong, 1 if something is, 2 if the scene or its files are wrong."""
    report: dict[str, Any] = {}
    findings: list[Finding] = []
    try:
        if args.scene is None:
            findings += _computer(report, args.listen)
        else:
            findings += _scene(scene.load(args.scene), report, args.listen)
    except scene.SceneError as error:
        complain(error)
        return 2
    if args.json:
        report["findings"] = [dataclasses.asdict(finding) for finding in findings]
        sys.stdout.write(json.dumps(report) + "\n")
    else:
        _print(report, findings)
    return int(any(finding.level is Level.ERROR for finding in findings))


def _computer(report: dict[str, Any], listen_s: float) -> list[Finding]:
    """Look for bridges and CAN interfaces on this computer."""
    from serial.tools import list_ports

    findings = []
    ports = [port for port in list_ports.comports() if port.vid is not None]
    for port in ports:
        named = BRIDGE_NAME in f"{port.product} {port.manufacturer}".lower()
        if named or port.vid == BRIDGE_VENDOR:
            findings += _port(port.device, report, listen_s)
        else:
            what = f"serial port {port.device}: {port.description}"
            findings.append(Finding(Level.OK, what, "not greeted: to ask it, name it in a scene"))
    interfaces = can_interfaces(Path("/sys/class/net"))
    findings += interfaces
    if not ports and not interfaces:
        what = "no USB serial port and no CAN interface"
        findings.append(Finding(Level.WARNING, what, "plug the bridge in, or bring up can0"))
    return findings + _privileges()


def can_interfaces(folder: Path) -> list[Finding]:
    """State of every CAN interface below `/sys/class/net`."""
    findings = []
    for interface in sorted(folder.glob("*")):
        try:
            kind = (interface / "type").read_text().strip()
            state = (interface / "operstate").read_text().strip()
        except OSError:
            continue
        if kind != ARPHRD_CAN:
            continue
        if state == "down":
            name = interface.name
            advice = f"ip link set {name} up type can bitrate 1000000"
            findings.append(Finding(Level.WARNING, f"CAN interface {name} is down", advice))
        else:
            findings.append(Finding(Level.OK, f"CAN interface {interface.name} is up"))
    return findings


def _port(device: str, report: dict[str, Any], listen_s: float) -> list[Finding]:
    wanted = scene.parse({"tactile": {"driver": "spi", "port": device}}, Path(device))
    return _listen(wanted, report, listen_s)


def _scene(wanted: scene.Scene, report: dict[str, Any], listen_s: float) -> list[Finding]:
    findings = []
    try:
        model = assembly.load_model(wanted)
        assembly.build_pipeline(wanted, model)
        what = f"model {model.contract.name} ({model.sha256[:12]}) fits the hand"
        findings.append(Finding(Level.OK, what))
    except ModelError as error:
        findings.append(Finding(Level.ERROR, str(error), "choose a model that fits the hand"))
    findings += _listen(wanted, report, listen_s)
    return findings + _privileges(wanted.tactile.driver, wanted.realtime)


def _listen(wanted: scene.Scene, report: dict[str, Any], listen_s: float) -> list[Finding]:
    """Open the scene's drivers and listen to them for a while."""
    drivers = assembly.build_drivers(wanted)
    statistics = ElectrodeStatistics(wanted.hand.fingers)
    try:
        for driver in drivers:
            assembly.open_driver(driver)
        seconds = _collect(drivers, statistics, listen_s)
        described = {driver.name: driver.describe() for driver in drivers}
    except LinkError as error:
        return [Finding(Level.ERROR, str(error))]
    finally:
        for driver in drivers:
            driver.close()
    findings = []
    for driver in drivers:
        device = described[driver.name]
        report[driver.name] = {"device": device, "counters": driver.counters.as_dict()}
        findings += device_findings(driver.name, device)
    tactile = drivers[0]
    findings.append(rate_finding(tactile.name, statistics.readings, seconds, tactile.period_ns))
    for driver in drivers:
        findings += counter_findings(driver.name, driver.counters.as_dict())
    findings += statistics.findings()
    report["electrodes"] = {
        finger: {
            "mean_counts": statistics.mean[index].round(1).tolist(),
            "deviation_counts": statistics.deviation[index].round(2).tolist(),
            "faulty_readings": statistics.faulty[index].tolist(),
        }
        for index, finger in enumerate(statistics.fingers)
    }
    report["readings"] = statistics.readings
    return findings


def _collect(drivers: Sequence[Driver], statistics: ElectrodeStatistics, listen_s: float) -> float:
    """Feed the statistics for so long; seconds from the first reading to the last."""
    start_s = first_s = last_s = time.monotonic()
    while time.monotonic() - start_s < listen_s and not drivers[0].exhausted:
        descriptors = [driver.fileno() for driver in drivers]
        select.select([fd for fd in descriptors if fd is not None], [], [], WAIT_S)
        for driver in drivers:
            for reading in driver.read_ready():
                if isinstance(reading, TactileReading):
                    last_s = time.monotonic()
                    first_s = first_s if statistics.readings else last_s
                    statistics.add(reading)
    if statistics.readings < 2:
        return listen_s
    return (last_s - first_s) * statistics.readings / (statistics.readings - 1)


def _privileges(driver: str | None = None, realtime: scene.Realtime | None = None) -> list[Finding]:
    findings = []
    group = GROUPS.get(driver or "")
    if group is not None and os.geteuid() != 0 and not _in_group(group):
        advice = f"sudo usermod -aG {group} $USER, then log in again"
        findings.append(Finding(Level.WARNING, f"you are not in the group {group}", advice))
    may = 98 if os.geteuid() == 0 else resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    wanted = 0 if realtime is None or realtime.priority is None else realtime.priority
    level = Level.OK if wanted <= may else Level.WARNING
    advice = "" if wanted <= may else f"as a service: LimitRTPRIO={wanted}; else limits.conf(5)"
    findings.append(Finding(level, f"realtime priority up to {may} may be asked for", advice))
    return findings


def _in_group(name: str) -> bool:
    try:
        return grp.getgrnam(name).gr_gid in os.getgroups()
    except KeyError:
        return False


def _print(report: dict[str, Any], findings: list[Finding]) -> None:
    for finding in findings:
        advice = f"  -> {finding.advice}" if finding.advice else ""
        sys.stdout.write(f"{MARKS[finding.level]}{printable(finding.what + advice)}\n")
    electrodes = report.get("electrodes", {})
    if report.get("readings"):
        heads = "".join(f"{finger + ': mean, sd, faulty':>26}" for finger in electrodes)
        sys.stdout.write(f"\n    {heads}\n")
        columns = [zip(*values.values(), strict=True) for values in electrodes.values()]
        for number, cells in enumerate(zip(*columns, strict=True), start=1):
            row = "".join(f"{mean:12.1f}{sd:7.1f}{faulty:7d}" for mean, sd, faulty in cells)
            sys.stdout.write(f"{number:<4d}{row}\n")
    wrong = sum(finding.level is Level.ERROR for finding in findings)
    sys.stdout.write(f"\n{wrong} wrong, {_warnings(findings)} to look at\n")


def _warnings(findings: list[Finding]) -> int:
    return sum(finding.level is Level.WARNING for finding in findings)
