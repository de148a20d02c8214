"""`graspd doctor [SCENE]`: examine hardware, model and privileges, and say what is wrong."""

from __future__ import annotations

import argparse
import dataclasses
import logging
import select
import shutil
import sys
import textwrap
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.commands.arguments import within
from graspd.daemon.doctor import computer
from graspd.daemon.doctor.electrodes import FAULTY_FRACTION, ElectrodeStatistics
from graspd.daemon.doctor.finding import Cause, Finding, Level, fine, roots
from graspd.daemon.doctor.link import (
    counter_findings,
    device_findings,
    rate_finding,
    two_boards_finding,
)
from graspd.daemon.doctor.surroundings import (
    can_finding,
    explained,
    folder_findings,
    key_findings,
    model_finding,
    realtime_findings,
    shared_findings,
    socket_findings,
)
from graspd.daemon.process.text import Colour, coloured, printable, write_json, write_lines
from graspd.drivers.base import Driver, Fact, LinkError, TactileReading

LISTEN_S = 3.0
LISTEN_MIN_S, LISTEN_MAX_S = 0.1, 3600.0
WAIT_S = 0.005
"""Longest wait between two looks at the drivers, s: a recording has no descriptor to wait on."""
BRIDGE_NAME = "graspd"
BRIDGE_VENDOR = 0x2E8A
"""USB vendor id of Raspberry Pi, which makes the Pico. Bytes are sent to other ports only if their
name is the bridge's, because they may disturb unknown devices."""
MARKS = {Level.OK: "ok ", Level.WARNING: "!  ", Level.ERROR: "!! "}
COLOURS = {"ok ": Colour.GREEN, "!  ": Colour.YELLOW, "!! ": Colour.RED}
NARROWEST = 40
"""Fewest columns to which lines are wrapped."""
WHOLE_DEVICE = frozenset({Cause.SENSOR_ABSENT, Cause.REPEATED, Cause.CLOCK})
"""Faults of a whole device that make all fingers seem absent. `FRAMES_LOST` at level `ERROR` does
so too, and `MESSAGES` if no finger can be read."""
NOT_SENT = (
    "Each message must have it: see deploy/wire/TACTILE.md. If it does, check the sensor's plug "
    "and supply."
)
"""Advice on a finger that cannot be read in the messages of another program."""
FINGER_COLUMNS = 25
"""Width of a finger in the table of electrodes, characters."""
USUAL_COLUMNS = 80
"""Width of the table of electrodes where there is no terminal, characters."""


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
        help="time to listen (default: 3)",
    )
    parser.add_argument("--all", action="store_true", help="a table of all electrodes too")
    parser.add_argument(
        "--json",
        action="store_true",
        help="one JSON object on stdout; a finding that is not ok has a cause and advice",
    )


def run(args: argparse.Namespace) -> int:
    """Examine, print the findings; return 1 if one is an error, else 0.

    Raises `SceneError` or `DriverError`.
    """
    report: dict[str, Any] = {}
    logging.disable(logging.WARNING)  # findings repeat the warnings of drivers
    try:
        if args.scene is None:
            findings = _computer(report, args.listen)
        else:
            findings = _scene(scene.load(args.scene), report, args.listen)
    finally:
        logging.disable(logging.NOTSET)
    if args.json:
        report["findings"] = [dataclasses.asdict(finding) for finding in findings]
        write_json(report)
    else:
        columns = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
        write_lines(*map(_coloured, in_words(findings, columns)))
        for device, heard in report.get("bridges", {"": report}).items():
            if args.all and heard.get("readings"):
                table = _table(heard["electrodes"], columns or USUAL_COLUMNS)
                write_lines(*(["", device] if device else []), *table)
    return int(any(finding.level is Level.ERROR for finding in findings))


def _coloured(line: str) -> str:
    mark, rest = line[:3], line[3:]
    return coloured(mark, COLOURS[mark]) + rest if mark in COLOURS else line


def examine(
    driver: Driver, statistics: ElectrodeStatistics | None, seconds: float
) -> list[Finding]:
    """Return the findings on an open driver, without consequences of other findings.
    `statistics`: of its readings in `seconds`; None for joint angles."""
    device, counters = driver.describe(), driver.counters.as_dict()
    told = device_findings(driver.name, device, counters)
    readings = None if statistics is None else statistics.readings
    if "link" not in device or device["link"].fault is None:
        crowd = two_boards_finding(driver.name, readings or 0, seconds, counters)
        if crowd is not None:
            return roots([*told, crowd])  # all else follows from it
        causes = {finding.cause for finding in told}
        more = counter_findings(driver.name, counters)
        told += [finding for finding in more if finding.cause not in causes]
        if readings is not None:
            told.append(rate_finding(driver.name, readings, seconds, driver.period_ns))
    elif readings == 0:
        what = f"{told[0].what}; no reading in {seconds:.1f} s"
        told[0] = dataclasses.replace(told[0], what=what)
    if statistics is not None and readings:
        told = _with_electrodes(told, statistics, driver.name)
    return roots(told)


def in_words(findings: Sequence[Finding], columns: int | None) -> Iterator[str]:
    """Yield the findings in lines of at most `columns` (None: one line each), then how many are
    errors and warnings."""
    for finding in findings:
        what, mark = printable(finding.what), MARKS[finding.level]
        advice = printable(finding.advice or "")
        if columns is None:
            yield f"{mark}{what}  -> {advice}" if advice else f"{mark}{what}"
            continue
        for text, first in ((what, mark), (advice, "   -> ")):
            yield from textwrap.wrap(
                text,
                max(columns, NARROWEST),
                initial_indent=first,
                subsequent_indent=" " * len(first),
                break_long_words=False,
                break_on_hyphens=False,
            )
    levels = [finding.level for finding in findings]
    yield ""
    yield f"{levels.count(Level.ERROR)} wrong, {levels.count(Level.WARNING)} to look at"


def _computer(report: dict[str, Any], listen_s: float) -> list[Finding]:
    """Return findings on this computer's bridges and CAN interfaces; enter them in `report`, too,
    with all USB serial ports. If there are several bridges, each has its part in `bridges`."""
    ports = [port for port in computer.serial_ports() if port.vendor is not None]
    interfaces = computer.can_interfaces()
    report["ports"] = [dataclasses.asdict(port) for port in ports]
    report["interfaces"] = [dataclasses.asdict(interface) for interface in interfaces]
    findings, bridges = [], {}
    for port in ports:
        if BRIDGE_NAME in port.product.lower() or port.vendor == BRIDGE_VENDOR:
            bridges[port.device] = dict[str, Any]()
        else:
            findings.append(fine(f"{port}; not greeted: to ask it, name it in a scene"))
    for device, heard in bridges.items():
        tactile = {"tactile": {"driver": "spi", "port": device}}
        told = _listen(scene.parse(tactile, Path(device)), heard, listen_s)
        which = f"{device}: " if len(bridges) > 1 else ""
        findings += [dataclasses.replace(each, what=which + each.what) for each in told]
    report |= {"bridges": bridges} if len(bridges) > 1 else next(iter(bridges.values()), {})
    findings += [can_finding(interface) for interface in interfaces]
    if not findings:
        what = "no USB serial port and no CAN interface"
        advice = "plug the bridge or the CAN adapter in; no hardware: graspd twin"
        findings.append(Finding(Level.WARNING, what, Cause.PORT_MISSING, advice))
    return findings


def _scene(wanted: scene.Scene, report: dict[str, Any], listen_s: float) -> list[Finding]:
    findings = [*_listen(wanted, report, listen_s), model_finding(wanted)]
    advised = {finding.advice for finding in findings if finding.advice}
    # A graspd that holds the port also holds the sockets. One finding is enough.
    sockets = [finding for finding in socket_findings(wanted) if finding.advice not in advised]
    kept = folder_findings(wanted)
    return [*findings, *key_findings(wanted), *sockets, *kept, *realtime_findings(wanted)]


def _listen(wanted: scene.Scene, report: dict[str, Any], listen_s: float) -> list[Finding]:
    sections = [section for section in (wanted.tactile, wanted.joints) if section is not None]
    statistics = ElectrodeStatistics(wanted.hand.fingers)
    findings: list[Finding] = []
    drivers = assembly.build_drivers(Plan.of(wanted))
    try:
        opened = []
        for driver, section in zip(drivers, sections, strict=False):
            try:
                assembly.open_driver(driver)
                opened.append((driver, section))
            except LinkError as error:
                closed = {"link": Fact("closed", error.cause), "why": Fact(str(error))}
                (finding,) = device_findings(driver.name, closed)
                findings += explained(finding, section)
        seconds = _collect([driver for driver, _ in opened], statistics, listen_s)
        for driver, section in opened:
            felt = statistics if driver is drivers[0] else None
            told = examine(driver, felt, seconds)
            if all(finding.cause is not Cause.PORT_HELD for finding in told):
                told = roots([*shared_findings(section), *told])
            for finding in told:
                findings += explained(finding, section)
            report[driver.name] = {
                "device": {name: fact.text for name, fact in driver.describe().items()},
                "counters": driver.counters.as_dict(),
            }
    finally:
        for driver in drivers:
            driver.close()
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
    """Feed readings to `statistics` for `listen_s`, or until a recording ends; return the time, s,
    that they cover, or `listen_s` for fewer than two."""
    start_s = first_s = last_s = time.monotonic()
    while drivers and time.monotonic() - start_s < listen_s and not drivers[0].exhausted:
        poll = select.poll()
        for driver in drivers:
            if (descriptor := driver.fileno()) is not None:
                poll.register(descriptor, select.POLLIN)
        poll.poll(WAIT_S * 1000)
        for driver in drivers:
            for reading in driver.read_ready():
                if isinstance(reading, TactileReading):
                    last_s = time.monotonic()
                    first_s = first_s if statistics.readings else last_s
                    statistics.add(reading)
    if statistics.readings < 2:
        return listen_s
    return (last_s - first_s) * statistics.readings / (statistics.readings - 1)


def _with_electrodes(
    told: list[Finding], statistics: ElectrodeStatistics, driver: str
) -> list[Finding]:
    """Return `told`, findings on the device, and those on electrodes. If all fingers are absent and
    a finding of `told` explains it, leave out the absent fingers, and make that one an error."""
    electrodes = [
        dataclasses.replace(finding, advice=NOT_SENT)
        if driver == "datagrams" and finding.cause is Cause.SENSOR_ABSENT
        else finding
        for finding in statistics.findings()
    ]
    unread = bool((statistics.faulty > FAULTY_FRACTION * statistics.readings).all())
    absent = [finding for finding in electrodes if finding.cause is Cause.SENSOR_ABSENT]
    whole = [
        finding
        for finding in told
        if finding.cause in WHOLE_DEVICE
        or (finding.cause is Cause.FRAMES_LOST and finding.level is Level.ERROR)
        or (finding.cause is Cause.MESSAGES and unread)
    ]
    if not whole or len(absent) < len(statistics.fingers):
        return told + electrodes
    raised = [
        dataclasses.replace(finding, level=Level.ERROR) if finding in whole else finding
        for finding in told
    ]
    return raised + [finding for finding in electrodes if finding not in absent]


def _table(electrodes: dict[str, dict[str, list[float]]], columns: int) -> Iterator[str]:
    """Yield a table of mean, deviation and faulty readings, with as many fingers abreast as fit."""
    abreast = max(1, (columns - 4) // FINGER_COLUMNS)
    fingers = list(electrodes)
    for first in range(0, len(fingers), abreast):
        shown = fingers[first : first + abreast]
        yield ""
        heads = (f"{finger}: mean, sd, faulty" for finger in shown)
        yield "    " + "".join(f"{head:>{FINGER_COLUMNS}}" for head in heads)
        cells = [zip(*electrodes[finger].values(), strict=True) for finger in shown]
        for number, row in enumerate(zip(*cells, strict=True), start=1):
            text = "".join(f"{mean:11.1f}{sd:7.1f}{faulty:7.0f}" for mean, sd, faulty in row)
            yield f"{number:<4d}{text}"
