"""Who may what they may not: peers whose keys were removed, and other users."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from functools import partial

from graspd.daemon.publish.keys import make
from tests.bench.attacks.attack import Outcome, Plan
from tests.bench.attacks.doors import hand
from tests.bench.live import Subscriber

HEARD_S = 20.0
"""Longest wait for who may connect: the start of the daemon, and libzmq's connecting anew."""
QUIET_S = 4.0
"""For how long who is removed must hear nothing, from so long on: the list is looked at once a
second, and a connection that is cut off is tried anew within that."""
NOBODY = 65534
"""User and group of nobody (Debian)."""
CONNECTING = """
import os, socket, sys
path, nobody = sys.argv[1], int(sys.argv[2])
made = socket.socket(socket.AF_UNIX)
os.setgroups([])
os.setgid(nobody)
os.setuid(nobody)
try:
    made.connect(path)
except PermissionError:
    sys.exit(3)
"""


def removed_key(plan: Plan) -> Outcome:
    """Remove the key `leaving` from the list while another file is being copied there."""
    tried = former = again = lost = 0
    for folder in plan.folders():
        clients = folder / "clients"
        make(clients, "leaving")
        with hand(folder, curve=True) as daemon:
            connect = partial(Subscriber, daemon.publish, keys=folder, client="leaving")
            with connect() as leaving:
                if leaving.take(HEARD_S) is None:
                    raise TimeoutError("who may connect hears nothing")
                whole = (clients / "friend.key").read_bytes()
                (clients / "new.key").write_bytes(whole[: len(whole) // 2])
                (clients / "leaving.key").unlink()
                time.sleep(QUIET_S)
                leaving.drain()
                former += leaving.take(1.0) is not None
                daemon.friend.drain()
                lost += daemon.friend.take(HEARD_S) is None
            with connect() as leaving:
                again += leaving.take(QUIET_S) is not None
        tried += 1
    happened = (
        f"{former} removed keys went on hearing, {again} got in again, {lost} others were lost"
    )
    return Outcome(tried, happened, held=not (former or again or lost))


def other_user(plan: Plan) -> Outcome:
    """Connect as nobody where all may listen, and only the daemon's group may ask."""
    if os.geteuid():
        return Outcome(0, "skipped: only root can become another user", held=True)
    tried, got_in = 0, 0
    plan.folder.chmod(0o711)
    former = os.umask(0)
    try:
        with hand(plan.folder, publish='file_mode = "0666"\n') as daemon:
            for _ in plan.rounds():
                if not _stranger_connects(daemon.publish):
                    raise PermissionError("the user nobody cannot listen at mode 0666")
                got_in += _stranger_connects(daemon.ask)
                tried += 1
    finally:
        os.umask(former)
    return Outcome(tried, f"{got_in} could ask", held=not got_in)


def _stranger_connects(endpoint: str) -> bool:
    """Return True if a process of the user `nobody` can connect to a socket file."""
    path = endpoint.removeprefix("ipc://")
    command = [sys.executable, "-I", "-c", CONNECTING, path, str(NOBODY)]
    return subprocess.run(command, check=False, timeout=HEARD_S).returncode == 0
