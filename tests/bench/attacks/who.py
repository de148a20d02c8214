"""Who may what they may not: peers whose keys were removed, and other users."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import zmq

from graspd.daemon.publish.keys import load_pair, make
from tests.bench.attacks.attack import Outcome, Plan
from tests.clients.bench import Daemon, free_endpoint

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
Context = zmq.Context[zmq.Socket[bytes]]


class _Clients:
    """A daemon with keys on TCP, a client to be removed, and one who stays."""

    def __init__(self, folder: Path) -> None:
        secret = make(folder, "daemon")[1]
        self.folder = folder / "clients"
        self.keys = {}
        for name in ("leaving", "staying"):
            public, own = make(folder / "theirs", name)
            self.folder.mkdir(exist_ok=True)
            public.rename(self.folder / public.name)
            self.keys[name] = load_pair(own)
        self.public = load_pair(secret)[0]
        self.endpoint = free_endpoint()
        section = f'[curve]\nsecret_key = "{secret}"\nclients = "{self.folder}"\n'
        self.daemon = Daemon(folder, section, endpoint=self.endpoint)

    def connect(self, context: Context, name: str) -> zmq.Socket[bytes]:
        made = context.socket(zmq.SUB)
        made.linger = 0
        made.curve_serverkey = self.public
        made.curve_publickey, made.curve_secretkey = self.keys[name]
        made.subscribe("")
        made.connect(self.endpoint)
        return made


def _hears(subscriber: zmq.Socket[bytes], seconds: float) -> bool:
    """Whether anything comes within that time, after what waits has been read."""
    while subscriber.poll(0):
        subscriber.recv_multipart()
    return bool(subscriber.poll(round(seconds * 1e3)))


def _half_copied(clients: Path) -> None:
    """A key is removed while another one is being copied there."""
    whole = (clients / "staying.key").read_bytes()
    (clients / "new.key").write_bytes(whole[: len(whole) // 2])
    (clients / "leaving.key").unlink()


def removed_key(plan: Plan) -> Outcome:
    """Remove the key `leaving` from the list while another file is being copied there."""
    tried = former = anew = lost = 0
    for folder in plan.folders():
        clients = _Clients(folder)
        with clients.daemon, zmq.Context() as context:
            with (
                clients.connect(context, "leaving") as leaving,
                clients.connect(context, "staying") as staying,
            ):
                if not (_hears(leaving, HEARD_S) and _hears(staying, HEARD_S)):
                    raise TimeoutError("who may connect hears nothing")
                _half_copied(clients.folder)
                time.sleep(QUIET_S)
                former += _hears(leaving, 1.0)
                lost += not _hears(staying, HEARD_S)
            with clients.connect(context, "leaving") as again:
                anew += _hears(again, QUIET_S)
        tried += 1
    happened = (
        f"{former} removed keys went on hearing, {anew} got in again, {lost} others were lost"
    )
    return Outcome(tried, happened, held=not (former or anew or lost))


def other_user(plan: Plan) -> Outcome:
    """Connect as nobody where all may listen, and only the daemon's group may ask."""
    if os.geteuid():
        return Outcome(0, "skipped: only root can become another user", held=True)
    tried, got_in = 0, 0
    plan.folder.chmod(0o711)
    former = os.umask(0)
    try:
        with Daemon(plan.folder, publish='file_mode = "0666"') as daemon:
            for _ in plan.rounds():
                if not _nobody_connects(daemon.endpoint):
                    raise PermissionError("nobody may listen, though all shall")
                got_in += _nobody_connects(daemon.ask_endpoint)
                tried += 1
    finally:
        os.umask(former)
    return Outcome(tried, f"{got_in} could ask", held=not got_in)


def _nobody_connects(endpoint: str) -> bool:
    """Whether a process of nobody's gets a connection to a socket file."""
    path = endpoint.removeprefix("ipc://")
    command = [sys.executable, "-I", "-c", CONNECTING, path, str(NOBODY)]
    return subprocess.run(command, check=False, timeout=HEARD_S).returncode == 0
