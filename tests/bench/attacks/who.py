"""Who may what they may not: removed keys, forged outcomes, rogue publishers, other users."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import zmq

from daemon.publish.keys import load_pair, make
from deploy.clients.python.graspd_client import Client
from tests.bench.attacks.attack import Aim, Attack, Outcome, Plan
from tests.clients.bench import Daemon, free_endpoint
from tests.clients.messages import TOPIC
from tests.clients.refused import CASES, came, well

HEARD_S = 20.0
"""Longest wait for who may connect: the start of the daemon, and libzmq's connecting anew."""
QUIET_S = 4.0
"""For how long who is removed must hear nothing, from so long on: the list is looked at once a
second, and a connection that is cut off is tried anew within that."""
SEEN_S = 2.5
"""After so long the daemon has looked at the list."""
NOBODY = 65534
"""User and group of nobody (Debian)."""
SENT_S, LIFT_S = 0.01, 0.02
"""After so long the last message has come; deadline of the question whether to lift."""
FORMULAS = ("=HYPERLINK(0)", "+1", "-1", "@SUM(1)", "=1", "a=1", "a;b", "a|b", "a\tb", "..", "'a'")
"""Names of objects that a spreadsheet calculates or a table breaks at."""
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
ASKED_MS = 5000
"""Longest wait for an answer."""

Context = zmq.Context[zmq.Socket[bytes]]


class _Clients:
    """A daemon with keys on TCP, a client to be removed, and one who stays."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
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


def _dangling(clients: Path) -> None:
    (clients / "new.key").symlink_to("nowhere")
    time.sleep(SEEN_S)
    (clients / "leaving.key").unlink()


def _vanished(clients: Path) -> None:
    clients.rename(clients.with_name("away"))


def _open_to_all(clients: Path) -> None:
    clients.chmod(0o777)


def _written_by_all(clients: Path) -> None:
    (clients / "leaving.key").chmod(0o666)


def _removed(how: Callable[[Path], None], *, stays: bool) -> Callable[[Plan], Outcome]:
    """An attack in which the key `leaving` must not be of use any more; `stays`: the other is."""

    def run(plan: Plan) -> Outcome:
        tried = former = anew = lost = 0
        for tried in plan.rounds():
            clients = _Clients(plan.folder / str(tried))
            with clients.daemon, zmq.Context() as context:
                with (
                    clients.connect(context, "leaving") as leaving,
                    clients.connect(context, "staying") as staying,
                ):
                    if not (_hears(leaving, HEARD_S) and _hears(staying, HEARD_S)):
                        raise TimeoutError("who may connect hears nothing")
                    how(clients.folder)
                    time.sleep(QUIET_S)
                    former += _hears(leaving, 1.0)
                    lost += stays and not _hears(staying, HEARD_S)
                with clients.connect(context, "leaving") as again:
                    anew += _hears(again, QUIET_S)
        tried += 1
        happened = f"{former} removed keys went on hearing, {anew} got in anew"
        if stays:
            happened += f", {lost} others were lost"
        return Outcome(tried, happened, held=not (former or anew or lost))

    return run


def forged_names(plan: Plan) -> Outcome:
    """Tell outcomes of a grasp that was judged, with each of the names."""
    tried = taken = 0
    with (
        Daemon(plan.folder) as daemon,
        zmq.Context() as context,
        context.socket(zmq.SUB) as heard,
        context.socket(zmq.REQ) as asking,
    ):
        heard.linger = asking.linger = 0
        heard.subscribe(TOPIC)
        heard.connect(daemon.endpoint)
        asking.connect(daemon.ask_endpoint)
        for _ in plan.rounds():
            for name in FORMULAS:
                boot_id, grasp = _judged(heard)
                asking.send(f"outcome {boot_id} {grasp} stable {name}".encode())
                if not asking.poll(ASKED_MS):
                    raise TimeoutError("no answer")
                taken += bool(json.loads(asking.recv())["ok"])
                tried += 1
    return Outcome(tried, f"{taken} were taken", held=not taken)


def _judged(heard: zmq.Socket[bytes]) -> tuple[str, int]:
    """Start and number of a grasp that has just been judged."""
    while True:
        if not heard.poll(round(HEARD_S * 1e3)):
            raise TimeoutError("no verdict")
        told = json.loads(heard.recv_multipart()[1])
        if told["valid"]:
            return told["boot_id"], told["grasp"]


def rogue_publisher(plan: Plan) -> Outcome:
    """Send each bad message to a client that asks whether it may lift, and a good one at last."""
    tried = allowed = deaf = 0
    for _ in plan.rounds():
        for case in CASES:
            with _rogue(plan.folder / "rogue") as (publisher, graspd):
                for frames in came(case, time.monotonic_ns()):
                    publisher.send_multipart(frames)
                time.sleep(SENT_S)
                allowed += bool(graspd.may_i_lift(LIFT_S))
                tried += 1
    with _rogue(plan.folder / "rogue") as (publisher, graspd):
        publisher.send_multipart([TOPIC, json.dumps(well(time.monotonic_ns())).encode()])
        deaf = not graspd.may_i_lift(1.0)
    happened = f"{allowed} lifts were allowed"
    if deaf:
        happened += ", but a good message is not understood"
    return Outcome(tried, happened, held=not (allowed or deaf))


@contextmanager
def _rogue(path: Path) -> Iterator[tuple[zmq.Socket[bytes], Client]]:
    """A publisher, and a client that hears it."""
    endpoint = f"ipc://{path}"
    with zmq.Context() as context, context.socket(zmq.XPUB) as publisher:
        publisher.linger = 0
        publisher.bind(endpoint)
        with Client(endpoint) as graspd:
            if not publisher.poll(round(HEARD_S * 1e3)):
                raise TimeoutError("the client does not subscribe")
            publisher.recv()
            yield publisher, graspd


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


def _revoked(name: str, what: str, how: Callable[[Path], None], *, stays: bool) -> Attack:
    run = _removed(how, stays=stays)
    return Attack(f"revoked-{name}", Aim.WHO_MAY, what, "removed keys", run)


ATTACKS = (
    _revoked("half-copied", "remove a key beside a half-copied one", _half_copied, stays=True),
    _revoked("dangling", "remove a key beside a link that leads nowhere", _dangling, stays=True),
    _revoked("vanished", "move away the folder of the keys", _vanished, stays=False),
    _revoked("open-folder", "let all write into the folder of the keys", _open_to_all, stays=False),
    _revoked("open-key", "let all write a key", _written_by_all, stays=True),
    Attack(
        "forged-names",
        Aim.WHO_MAY,
        "tell outcomes with formulas and breaks of tables as object",
        "outcomes",
        forged_names,
    ),
    Attack(
        "rogue-publisher",
        Aim.FALSE_STABLE,
        "publish what contradicts itself, is old, doubled, cut, or of a former start, to a client",
        "messages",
        rogue_publisher,
    ),
    Attack("other-user", Aim.WHO_MAY, "ask as another user", "connections", other_user),
)
