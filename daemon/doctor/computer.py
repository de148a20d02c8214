"""Serial ports and CAN interfaces of this computer, and processes that hold a file or a port."""

from __future__ import annotations

import json
import os
import stat
import subprocess
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

PROC = Path("/proc")
NETWORK = Path("/sys/class/net")
ARPHRD_CAN = "280"
"""Type of a CAN interface in `/sys/class/net/*/type`."""
LISTENING = {"tcp": {"0A"}, "udp": {"01", "07"}}
"""States of listening sockets in `/proc/net`, by protocol."""
TERMINAL_MAKER = "/dev/ptmx"
IP_TIMEOUT_S = 5.0
COMMAND_MAX = 400
"""Most characters that are shown of a process's command line."""


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port of this computer."""

    device: str
    description: str
    serial_number: str | None
    vendor: int | None
    """USB vendor id; None: not on USB."""
    product: str
    """Names of product and manufacturer, as the device reports them."""

    def __str__(self) -> str:
        number = f", serial number {self.serial_number}" if self.serial_number else ""
        description = "" if self.description == "n/a" else f": {self.description}"
        return f"serial port {self.device}{description}{number}"


@dataclass(frozen=True, slots=True)
class CanInterface:
    """A CAN interface of the kernel."""

    name: str
    state: str
    """`up`, `down`, or the controller's state, such as `error-active` or `bus-off`."""
    bitrate: int | None
    """Bit/s; None: not known."""

    def __str__(self) -> str:
        rate = "" if self.bitrate is None else f", {self.bitrate} bit/s"
        return f"CAN interface {self.name} is {self.state}{rate}"

    @property
    def is_down(self) -> bool:
        """True if the interface is down or its controller stopped."""
        return self.state in ("down", "stopped")

    @property
    def is_fine(self) -> bool:
        """True if its controller reports no errors."""
        return self.state in ("up", "error-active")


@dataclass(frozen=True, slots=True)
class Process:
    """Another process of this computer, with its command line."""

    pid: int
    command: str

    def __str__(self) -> str:
        return f"PID {self.pid}, {self.command}"

    @property
    def is_graspd(self) -> bool:
        """True if the process runs one of graspd's commands."""
        words = self.command.split()
        return "-m graspd" in self.command or any(Path(word).name == "graspd" for word in words[:3])


def serial_ports() -> list[SerialPort]:
    """Return all serial ports of this computer."""
    from serial.tools import list_ports

    return [
        SerialPort(
            port.device,
            port.description,
            port.serial_number,
            port.vid,
            f"{port.product} {port.manufacturer}",
        )
        for port in sorted(list_ports.comports())
    ]


def can_interfaces(
    folder: Path = NETWORK, ip: Sequence[str] = ("ip", "-json", "-details", "link")
) -> list[CanInterface]:
    """Return the CAN interfaces in `folder`, with state and bit rate from the command `ip`."""
    states = {}
    for interface in sorted(folder.glob("*")):
        with suppress(OSError):
            if (interface / "type").read_text().strip() == ARPHRD_CAN:
                state = (interface / "operstate").read_text().strip()
                # An interface without a carrier, such as vcan, is `unknown` and works.
                states[interface.name] = "up" if state == "unknown" else state
    details = _details(ip) if states else {}
    interfaces = []
    for name, state in states.items():
        controller = details.get(name, {"state": state})
        timing = controller.get("bittiming")
        bitrate = timing.get("bitrate") if isinstance(timing, dict) else None
        interfaces.append(CanInterface(name, str(controller["state"]).lower(), bitrate))
    return interfaces


def _details(ip: Sequence[str]) -> dict[str, dict[str, object]]:
    """Return what `ip` prints on CAN controllers, by interface; empty if it is missing or old."""
    try:
        answer = subprocess.run(ip, capture_output=True, timeout=IP_TIMEOUT_S, check=True).stdout
        links = [(link["ifname"], link.get("linkinfo", {})) for link in json.loads(answer)]
        return {
            name: info["info_data"]
            for name, info in links
            if info.get("info_kind") == "can" and "state" in info.get("info_data", {})
        }
    except (OSError, subprocess.SubprocessError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def file_holders(path: str | Path) -> list[Process]:
    """Return other processes that have locked a file, or if none has, those that have it open.

    Only root finds processes of other users that have not locked it. The program that made a
    pseudo-terminal also has it open, and is left out."""
    try:
        there = os.stat(path)
    except OSError:
        return []
    device = f"{os.major(there.st_dev):02x}:{os.minor(there.st_dev):02x}:{there.st_ino}"
    locked = set()
    with suppress(OSError):
        for line in (PROC / "locks").read_text().splitlines():
            words = line.split()  # 1: FLOCK ADVISORY WRITE 123 00:1a:3 0 EOF
            if len(words) > 5 and words[5] == device:
                locked.add(int(words[4]))
    own = {os.getpid()}
    holders = locked - own or _with_open({_identity(there)}) - own
    if holders and stat.S_ISCHR(there.st_mode):
        with suppress(OSError):
            holders -= _with_open({_identity(os.stat(TERMINAL_MAKER))})
    return _processes(holders)


def port_holders(protocol: str, port: int) -> list[Process]:
    """Return other processes that listen on a `udp` or `tcp` port; of other users only to root."""
    inodes = set()
    for table in (protocol, f"{protocol}6"):
        with suppress(OSError):
            for line in (PROC / "net" / table).read_text().splitlines()[1:]:
                words = line.split()
                is_mine = int(words[1].rpartition(":")[2], 16) == port
                if is_mine and words[3] in LISTENING[protocol]:
                    inodes.add(int(words[9]))
    return _processes(_with_open(inodes))


def _with_open(files: Collection[object]) -> set[int]:
    """Return ids of processes with one of these files (device, inode) or sockets (inode) open."""
    pids = set()
    for process in PROC.glob("[0-9]*"):
        with suppress(OSError):  # the process may end meanwhile, or be another user's
            for descriptor in os.listdir(process / "fd"):
                if _is_open(process / "fd" / descriptor, files):
                    pids.add(int(process.name))
    return pids


def _is_open(descriptor: Path, files: Collection[object]) -> bool:
    try:
        opened = descriptor.stat()
    except OSError:  # closed meanwhile
        return False
    is_socket = stat.S_ISSOCK(opened.st_mode)
    return (opened.st_ino if is_socket else _identity(opened)) in files


def _identity(file: os.stat_result) -> tuple[int, int]:
    return file.st_dev, file.st_ino


def _processes(pids: Collection[int]) -> list[Process]:
    processes = []
    for pid in sorted(set(pids) - {os.getpid()}):
        with suppress(OSError):
            command = (PROC / str(pid) / "cmdline").read_bytes().replace(b"\0", b" ")
            text = command.decode(errors="replace").strip()
            processes.append(Process(pid, text[:COMMAND_MAX] or "(unnamed)"))
    return processes
