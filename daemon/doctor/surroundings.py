"""Findings on this computer for a scene: model, port, interface, sockets, rights."""

from __future__ import annotations

import errno
import os
import socket
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.doctor import computer
from graspd.daemon.doctor.finding import Cause, Finding, Level, fine
from graspd.daemon.doctor.link import TROUBLES
from graspd.daemon.publish import PublishError
from graspd.daemon.run.realtime import RealtimeMode
from graspd.daemon.scene import Scene
from graspd.daemon.scene.drivers import CanTactile, Device, DeviceKind, DriverSection
from graspd.drivers.base import LinkCause
from graspd.drivers.udp import Endpoint
from graspd.models.contract import ModelError

BITRATE = 1_000_000
"""Bit rate of the board in deploy/can/PROTOCOL.md, bit/s."""
SERVICE_FOLDER = Path("/run/graspd")
"""Folder of sockets that the service makes when it starts."""
NOT_HEARD = frozenset(
    {Cause.INTERFACE_MISSING, Cause.INTERFACE_DOWN, Cause.LINK_DOWN, Cause.SILENT, Cause.BITRATE}
)
"""Causes that the kernel's state of the CAN interface may explain."""
PORTS_OF_ROOT = Path("/proc/sys/net/ipv4/ip_unprivileged_port_start")
"""File with the first port that an ordinary user may listen on (ip(7)), for IPv6 too."""
NO_DATA = TROUBLES[LinkCause.SILENT]
HELD_BY_GRASPD = (
    "graspd itself runs: see graspd watch. To look from here, end it first "
    "(systemctl stop 'graspd@*')."
)


def model_finding(wanted: Scene) -> Finding:
    """Judge whether the scene's model is there and fits the hand."""
    try:
        path = assembly.model_path(wanted)
    except ModelError as problem:
        advice = "See graspd models for those that exist."
        return Finding(Level.ERROR, str(problem), Cause.MODEL_MISSING, advice)
    if not os.path.exists(path):
        advice = "[model] path is relative to the scene. See graspd models for those of the zoo."
        return Finding(Level.ERROR, f"no model at {path}", Cause.MODEL_MISSING, advice)
    try:
        model = assembly.load_model(wanted)
        assembly.build_pipeline(Plan.of(wanted), model)
    except ModelError as problem:
        advice = "Choose another model that fits the hand: see graspd models."
        return Finding(Level.ERROR, str(problem), Cause.MODEL_MISFIT, advice)
    return fine(f"model {model.contract.name} ({model.sha256[:12]}) fits the hand")


def explained(finding: Finding, section: DriverSection) -> list[Finding]:
    """Return the finding on the link of `section`, made exact by what this computer shows, such as
    who holds the port, and maybe findings on other ports or interfaces."""
    device = section.device
    if device is None:
        return [finding]
    match section, device.kind:
        case CanTactile(), DeviceKind.SOCKETCAN if finding.cause in NOT_HEARD:
            return _on_socketcan(finding, section)
    match device, finding.cause:
        case Device(kind=DeviceKind.UDP, name=source), Cause.PORT_HELD:
            number = Endpoint.parse(source).port
            return [_held(finding, computer.port_holders("udp", number))]
        case Device(kind=DeviceKind.UDP, name=source), Cause.PORT_DENIED:
            advice = _of_root(Endpoint.parse(source).port) or "See dmesg for what forbids it."
            return [replace(finding, advice=advice)]
        case Device(kind=DeviceKind.UDP, name=source), Cause.SILENT if (
            finding.advice == NO_DATA.advice
        ):
            advice = f"Let its program send to {source}. Another computer cannot send to 127.0.0.1."
            return [replace(finding, advice=advice)]
        case _, Cause.PORT_MISSING:
            ports = [fine(str(port)) for port in computer.serial_ports()]
            return [finding, *(ports or [fine("no serial port")])]
        case Device(name=port), Cause.PORT_DENIED:
            return [_denied(finding, port)]
        case Device(name=port), Cause.PORT_HELD:
            return [_held(finding, computer.file_holders(port))]
    return [finding]


def shared_findings(section: DriverSection) -> list[Finding]:
    """Return a warning if another program has the port of `section` open; none for UDP.

    `explained` adds which program.
    """
    device = section.device
    if device is None or device.kind is DeviceKind.UDP or not computer.file_holders(device.name):
        return []
    what = f"{device.name} is open in another program, which may take its bytes"
    return [Finding(Level.WARNING, what, Cause.PORT_HELD, "End it.")]


def can_finding(interface: computer.CanInterface, tactile: CanTactile | None = None) -> Finding:
    """Judge a CAN interface; advise how to bring it up, at the bit rate of `tactile`."""
    if interface.is_fine:
        return fine(str(interface))
    line = ip_link(interface.name, tactile)
    if interface.is_down:
        return Finding(Level.WARNING, str(interface), Cause.INTERFACE_DOWN, line)
    advice = f"Set the board's bit rate: sudo ip link set {interface.name} down; {line}"
    return Finding(Level.WARNING, str(interface), Cause.BUS_ERRORS, advice)


def ip_link(name: str, tactile: CanTactile | None) -> str:
    """Return the command that brings a CAN interface up at the scene's bit rate, else `BITRATE`."""
    bitrate = BITRATE if tactile is None or tactile.bitrate is None else tactile.bitrate
    return f"sudo ip link set {name} up type can bitrate {bitrate} restart-ms 100"


def socket_findings(wanted: Scene) -> list[Finding]:
    """Return findings on whether the sockets of the scene can be made; each cause once."""
    ask = wanted.ask_endpoint
    sockets = [("publish", wanted.endpoint)]
    sockets += [] if ask is None else [("ask", ask)]
    by_cause: dict[Cause | None, Finding] = {}
    for name, endpoint in sockets:
        scheme, _, address = endpoint.partition("://")
        if scheme == "ipc":
            users = () if name == "publish" else _of_users(wanted)
            group = wanted.publish.group
            told = (*_of_socket(name, Path(address)), *_of_group(name, group), *users)
        else:
            told = tuple(_of_port(name, address))
        for finding in told:
            by_cause.setdefault(finding.cause, finding)
    return list(by_cause.values())


def folder_findings(wanted: Scene) -> list[Finding]:
    """Try the folders of the session and of the recordings; return a warning for each that cannot
    be made or written."""
    folders = {"[session] folder": wanted.session_path} if wanted.keeps_session else {}
    if wanted.record is not None:
        folders["[record] directory"] = wanted.record.folder
    findings = []
    for key, path in folders.items():
        there = next(folder for folder in (path, *path.parents) if os.path.exists(folder))
        try:
            if key == "[session] folder" and there not in (path, path.parent):
                there = path.parent  # the daemon makes the last folder alone
            with tempfile.TemporaryDirectory(prefix=".graspd-", dir=there):
                pass
        except OSError as problem:
            what = f"{path}: nothing can be kept there: {problem.strerror}"
            advice = f"Name another {key}, or make it: sudo install -d -o $USER {path}"
            findings.append(Finding(Level.WARNING, what, Cause.FOLDER, advice))
    return findings


def key_findings(wanted: Scene) -> list[Finding]:
    """Return an error for each wrong key of `[curve]`, a warning for each that `[ask]` misses."""
    if wanted.curve is None:
        return []
    from graspd.daemon.publish import keys  # only where there are any

    try:
        keys.load_own(wanted.curve.secret_key)
        clients = keys.load_clients(wanted.curve.clients)
        refused, missing = clients.refused, keys.missing(wanted, clients)
    except keys.KeysError as problem:
        refused, missing = [str(problem)], []
    advice = f"graspd keys list --dir {wanted.curve.secret_key.parent} shows all keys."
    return [
        *(Finding(Level.ERROR, what, Cause.KEYS, advice) for what in refused),
        *(Finding(Level.WARNING, what, Cause.KEYS, advice) for what in missing),
    ]


def realtime_findings(wanted: Scene) -> list[Finding]:
    """Try `[realtime]` for a moment; return findings on the rights that this user lacks."""
    if wanted.realtime is None:
        return []
    with RealtimeMode(wanted.realtime) as mode:
        lacking = mode.lacking.items()
    warnings = [Finding(Level.WARNING, what, Cause.REALTIME, advice) for what, advice in lacking]
    return warnings or [fine("this user may have the realtime that the scene asks for")]


def _denied(finding: Finding, port: str) -> Finding:
    import grp  # not everywhere, and rarely needed

    try:
        group = grp.getgrgid(os.stat(port).st_gid).gr_name
    except (OSError, KeyError):
        return finding
    if group == "root":  # not a group to join
        advice = "Install deploy/udev/70-graspd.rules, and plug it in again."
        return replace(finding, advice=advice)
    return replace(finding, advice=f"sudo usermod -aG {group} $USER, then log in again")


def _held(finding: Finding, holders: Sequence[computer.Process]) -> Finding:
    if not holders:
        return finding
    what = f"{finding.what}: {'; '.join(map(str, holders))}"
    if any(process.is_graspd for process in holders):
        return replace(finding, what=what, advice=HELD_BY_GRASPD)
    return replace(finding, what=what, advice=f"End it: kill {holders[0].pid}")


def _on_socketcan(finding: Finding, tactile: CanTactile) -> list[Finding]:
    """Replace the driver's finding by one on the kernel's state of the interface, if that explains
    it."""
    interfaces = {interface.name: interface for interface in computer.can_interfaces()}
    here, line = interfaces.get(tactile.channel), ip_link(tactile.channel, tactile)
    if here is None:
        others = [can_finding(other, tactile) for other in interfaces.values()]
        advice = f"Plug its adapter in, then: {line}"
        missing = replace(finding, cause=Cause.INTERFACE_MISSING, advice=advice)
        names = [fine(finding.what) for finding in others] or [fine("no CAN interface")]
        return [missing, *names]
    what = f"{finding.what}; {here}"
    if here.is_down:
        return [replace(finding, what=what, cause=Cause.INTERFACE_DOWN, advice=line)]
    wrong_rate = here.bitrate not in (None, tactile.bitrate or BITRATE)
    if wrong_rate or finding.cause is Cause.BITRATE:
        advice = f"sudo ip link set {here.name} down; {line}"
        return [replace(finding, what=what, cause=Cause.BITRATE, advice=advice)]
    return [finding]


def _of_socket(name: str, path: Path) -> Iterator[Finding]:
    folder = path.parent
    holders = computer.file_holders(f"{path}.lock")
    if shut := _shut(folder):
        what, advice = f"{name}: you may not enter {shut}", "Choose a folder of your own."
        yield Finding(Level.WARNING, what, Cause.SOCKET_DENIED, advice)
    elif not os.path.isdir(folder):
        what = f"{name}: there is no folder {folder}"
        advice = f"The service makes it. Without a service: sudo install -d -o $USER {folder}"
        level = Level.WARNING if folder == SERVICE_FOLDER else Level.ERROR
        yield Finding(level, what, Cause.SOCKET_FOLDER, advice)
    elif holders:
        what = f"{name}: {path} is in use: {'; '.join(map(str, holders))}"
        yield Finding(Level.WARNING, what, Cause.SOCKET_HELD, HELD_BY_GRASPD)
    elif os.path.exists(path) and not path.is_socket():
        advice = f"Name another one, or move it away: mv {path} {path}.old"
        yield Finding(Level.ERROR, f"{name}: {path} is not a socket", Cause.SOCKET_HELD, advice)
    elif not os.access(folder, os.W_OK | os.X_OK):
        what, advice = f"{name}: you may not make {path}", "Choose a folder of your own."
        with suppress(KeyError):  # a user without a name
            advice = f"as its owner: sudo -u {folder.owner()} graspd"
        yield Finding(Level.WARNING, what, Cause.SOCKET_DENIED, advice)


def _shut(path: Path) -> Path | None:
    """Return the first folder on the way to `path` that may not be entered; None without any."""
    for each in (*reversed(path.parents), path):
        try:
            each.stat()
        except PermissionError:
            return each.parent
        except OSError:  # a missing path is another finding
            return None
    return None


def _of_port(name: str, address: str) -> Iterator[Finding]:
    host, _, port = address.rpartition(":")
    host = host.strip("[]")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, int(port)))
    except OSError as problem:
        what = f"{name}: tcp://{address}: {problem.strerror}"
        advice = _of_root(int(port))
        if problem.errno == errno.EACCES and advice is not None:
            yield Finding(Level.ERROR, what, Cause.SOCKET_DENIED, advice)
            return
        if problem.errno != errno.EADDRINUSE:
            advice = "Name an address of this computer: ip -brief address lists them."
            yield Finding(Level.ERROR, what, Cause.ADDRESS, advice)
            return
        advice = f"sudo ss -tlpn 'sport = {port}' names the program that has it."
        finding = Finding(Level.WARNING, what, Cause.SOCKET_HELD, advice)
        yield _held(finding, computer.port_holders("tcp", int(port)))


def _of_root(port: int) -> str | None:
    """Return advice if only root may listen on a port, else None."""
    try:
        first = int(PORTS_OF_ROOT.read_text())
    except OSError:  # a kernel before 4.11
        first = 1024
    refused = f"Ports below {first} are root's: name a higher one than {port}."
    return refused if port < first else None


def _of_group(name: str, group: str | None) -> Iterator[Finding]:
    if group is None:
        return
    import grp  # as above

    try:
        number = grp.getgrnam(group).gr_gid
    except KeyError:
        what, advice = f"{name}: there is no group {group}", f"sudo groupadd --system {group}"
        yield Finding(Level.ERROR, what, Cause.SOCKET_GROUP, advice)
        return
    if os.geteuid() != 0 and number not in {os.getegid(), *os.getgroups()}:
        what = f"{name}: you are not in the group {group} and cannot give the socket to it"
        advice = f"sudo usermod -aG {group} $USER, then log in again"
        yield Finding(Level.WARNING, what, Cause.SOCKET_GROUP, advice)


def _of_users(wanted: Scene) -> Iterator[Finding]:
    users = None if wanted.ask is None else wanted.ask.tell
    if not users:
        return
    from graspd.daemon.publish.listener import user_id  # as above

    for user in users:
        try:
            user_id(user)
        except PublishError as problem:
            advice = "getent passwd lists the users."
            yield Finding(Level.ERROR, str(problem), Cause.SOCKET_USER, advice)
