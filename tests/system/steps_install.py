"""Steps of the system test: install the service, check the installation, remove it again."""

from __future__ import annotations

from typing import Final

from tests.system.lab import (
    HANDS,
    MEMBER,
    PAYLOAD,
    PYTHON,
    STRANGER,
    Lab,
    Outcome,
    StepError,
)
from tests.system.payload import EXTRA

INSTALL: Final = f"sh {PAYLOAD}/deploy/install.sh"
OFFLINE: Final = f"{INSTALL} --wheelhouse {PAYLOAD}/wheels --extras {EXTRA}"
INSTALL_TIMEOUT_S: Final = 900.0
DOCTOR_TIMEOUT_S: Final = 600.0
LISTEN_S: Final = 5.0
"""Time for which the doctor listens to the bridge, s: enough on a busy emulated processor."""


def prepare(lab: Lab) -> Outcome:
    """Wait for the end of the boot, mount the payload, and make a virtual CAN bus."""
    state = lab.sh("systemctl is-system-running --wait")
    lab.sh(f"mkdir {PAYLOAD} && mount -o ro /dev/vdb {PAYLOAD}")
    # The disk will be filled: the journal must not live on it.
    lab.sh("journalctl --relinquish-var")
    lab.sh("modprobe vcan && ip link add vcan0 type vcan && ip link set vcan0 up")
    versions = lab.sh("uname -r; systemctl --version | sed -n '1s/(.*//p'; python3 --version")
    boot = lab.sh("systemd-analyze | sed -n '1s/.*= *//p'")
    return Outcome(f"{state}; Linux {', '.join(versions.split(chr(10)))}; by itself {boot}")


def install(lab: Lab) -> Outcome:
    """Install graspd offline from wheels, and add users, scenes and settings for emulation."""
    lab.sh(OFFLINE, INSTALL_TIMEOUT_S)
    lab.sh(f"useradd -G graspd {MEMBER} && useradd {STRANGER}")
    scenes = " ".join(f"{PAYLOAD}/guest/{hand}.toml" for hand in HANDS)
    lab.sh(f"cp {scenes} /etc/graspd/")
    lab.sh(
        "install -D -m 644 -t /etc/systemd/system/graspd@.service.d "
        f"{PAYLOAD}/guest/emulation.conf && systemctl daemon-reload"
    )
    return Outcome(lab.sh("graspd --version").splitlines()[0] + ", offline, from wheels")


def doctor(lab: Lab) -> Outcome:
    """Run the doctor: it finds the bridge behind the USB adapter, and nothing wrong."""
    command = f"graspd doctor --listen {LISTEN_S:g} /etc/graspd/serial.toml"
    done = lab.machine.run(command, DOCTOR_TIMEOUT_S)
    if done.code or "link up" not in done.out:
        raise StepError(f"graspd doctor ({done.code}): {done.out}{done.err}")
    return Outcome("nothing wrong on the serial port")


def start(lab: Lab) -> Outcome:
    """Start both hands at once, wait for READY and first messages, then start the CAN twin."""
    began_s = lab.deed("systemctl start " + " ".join(f"graspd@{hand}" for hand in HANDS))
    ready_s = []
    for hand in HANDS:
        ready_s.append(int(lab.show(hand, "ActiveEnterTimestampMonotonic")) / 1e6 - began_s)
        if not lab.show(hand, "StatusText"):
            raise StepError(f"{hand}: no STATUS")
    lab.observe()
    for hand in HANDS:
        lab.await_message(hand, began_s, "a message", lambda _: True)
    lab.twin()
    what = " and ".join(f"{hand} after {s:.1f} s" for hand, s in zip(HANDS, ready_s, strict=True))
    return Outcome(f"READY {what}", max(ready_s))


def realtime(lab: Lab) -> Outcome:
    """Check that the daemon gets the scene's [realtime]: SCHED_FIFO, locked memory, no warnings."""
    pid = lab.show("can", "MainPID")
    policy = lab.sh(f"ps -o cls=,rtprio= -p {pid}").split()
    locked_kib = int(lab.sh(f"sed -n 's/^VmLck:[^0-9]*\\([0-9]*\\).*/\\1/p' /proc/{pid}/status"))
    if policy != ["FF", "50"] or not locked_kib:
        raise StepError(f"scheduling {policy}, {locked_kib} KiB locked")
    warnings = lab.warnings("can", 0.0)
    if warnings:
        raise StepError(f"warnings: {warnings}")
    return Outcome(f"SCHED_FIFO 50, {locked_kib >> 10} MiB locked, without a privilege")


def access(lab: Lab) -> Outcome:
    """Check that members of the group graspd may connect to the socket, and others may not; and
    that the daemon sees who they are."""
    connect = "import socket, sys; socket.socket(socket.AF_UNIX).connect(sys.argv[1])"
    for user, error in ((MEMBER, ""), (STRANGER, "PermissionError")):
        done = lab.machine.run(f"runuser -u {user} -- {PYTHON} -c '{connect}' /run/graspd/can.ipc")
        if bool(done.code) is not bool(error) or error not in done.err:
            raise StepError(f"{user} connects with {done.code}: {done.err}")
    users = lab.sh(f"cat /proc/{lab.show('can', 'MainPID')}/uid_map").split()
    if users != ["0", "0", "4294967295"]:  # user_namespaces(7): each user as itself
        raise StepError(f"users of peers are not told apart: {users}")
    return Outcome("a member of the group graspd may subscribe, a stranger gets EACCES")


def enabled(lab: Lab) -> Outcome:
    """Enable a hand, and check that multi-user.target, as at boot, starts it."""
    lab.sh(f"{OFFLINE} --enable serial", INSTALL_TIMEOUT_S)
    lab.sh("systemctl stop graspd@serial")
    at_s = lab.deed("systemctl start multi-user.target")
    lab.await_true("systemctl is-active -q graspd@serial", "graspd@serial runs", look_s=1.0)
    verdict = lab.await_message("serial", at_s, "a verdict", lambda m: m.kind == "verdict")
    return Outcome("from the start of multi-user.target to a verdict", verdict.t_s - at_s)


def uninstall(lab: Lab) -> Outcome:
    """Uninstall: only scenes and learned data are left; with --purge nothing is."""
    lab.sh("rm -r /etc/systemd/system/graspd@.service.d; systemctl stop observer")
    lab.sh(f"{INSTALL} --uninstall")
    find = "find / -xdev -iname '*graspd*' ! -path '/proc/*' ! -path '/sys/*' | sort"
    left = lab.sh(find).split()
    if [path for path in left if not path.startswith(("/etc/graspd", "/var/lib/graspd"))]:
        raise StepError(f"left behind: {' '.join(left)}")
    lab.sh(f"gpasswd -q -d {MEMBER} graspd; {INSTALL} --uninstall --purge")
    left = lab.sh(find).split()
    if left or lab.machine.run("id graspd").code == 0:
        raise StepError(f"left behind after --purge: {' '.join(left)}")
    return Outcome("leaves scenes and sessions, and with --purge nothing")
