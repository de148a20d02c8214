"""Credentials of peers, from the kernel or the handshake, and what the scene lets them do."""

from __future__ import annotations

import json
import os
import socket
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq

from graspd.daemon.publish.keys import load_pair, make
from graspd.daemon.publish.sockets import Door, Sockets
from graspd.daemon.trust.lift_book import GraspId, LiftBook
from graspd.drivers.recordings.csv_player import DEMO_RECORDING
from tests.clients.bench import Daemon
from tests.daemon.publish.doors import (
    CURVE,
    Asked,
    Peers,
    opened_door,
    published,
    receive,
    scene_of,
)
from tests.ports import free_port

ROBOT, STRANGER = b"user 1000", b"user 1001"
NAME, OTHER = b"controller-16byt", b"another-16-bytes"
SEVENTH = GraspId("0" * 32, 7)


@pytest.fixture
def door() -> Iterator[tuple[Door, str]]:
    """A `Door` that other users can connect to, and the path of its socket for questions."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        with opened_door(Path(folder), 0o666) as (opened, endpoint):
            yield opened, endpoint.removeprefix("ipc://")


GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x01" + b"NULL".ljust(20, b"\0") + bytes(32)
CONNECTS_AS = """
import os, socket, sys, time
path, uid, hello = sys.argv[1], int(sys.argv[2]), bytes.fromhex(sys.argv[3])
made = socket.socket(socket.AF_UNIX)
os.setgroups([]); os.setgid(uid); os.setuid(uid)
made.connect(path); made.settimeout(30); made.sendall(hello[:64])
assert made.recv(64, socket.MSG_WAITALL); made.sendall(hello[64:])
assert made.recv(100); made.sendall(bytes.fromhex(sys.argv[4]))  # READY comes before a question
while made.recv(100): pass
"""
QUESTION = b"\x00\x04lift"


def hello(*properties: tuple[bytes, bytes]) -> bytes:
    """A DEALER's part of a handshake (RFC 23) with these properties."""
    fields = b"\x05READY"
    for name, value in ((b"Socket-Type", b"DEALER"), (b"Identity", NAME), *properties):
        fields += bytes([len(name)]) + name + struct.pack(">I", len(value)) + value
    return b"\x04" + bytes([len(fields)]) + fields


@pytest.mark.parametrize("forged", [b"Peer-Address", b"User-Id"])
def test_a_peer_cannot_forge_its_user_by_handshake_properties(
    door: tuple[Door, str], forged: bytes
) -> None:
    with socket.socket(socket.AF_UNIX) as rogue:
        rogue.connect(door[1])
        rogue.sendall(GREETING)
        assert len(rogue.recv(64, socket.MSG_WAITALL)) == 64
        rogue.sendall(hello((forged, b"localhost:4242:4242:1")))
        assert rogue.recv(100)
        rogue.sendall(QUESTION)
        assert receive(door[0]) == [[NAME, b"user %d" % os.getuid(), b"lift"]]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_another_user_with_the_same_routing_id_is_told_apart(door: tuple[Door, str]) -> None:
    command = [sys.executable, "-I", "-c", CONNECTS_AS, door[1]]
    said = (GREETING + hello()).hex(), QUESTION.hex()
    # A DEALER of libzmq would connect again, and take its routing id back.
    with subprocess.Popen([*command, "0", *said]) as owner:
        assert receive(door[0]) == [[NAME, b"user 0", b"lift"]]
        with subprocess.Popen([*command, "65534", *said]) as rogue:
            assert receive(door[0]) == [[NAME, b"user 65534", b"lift"]]
            rogue.kill()
        owner.kill()


IN_A_NAMESPACE = "#!/bin/sh\nexec unshare --user --map-root-user '%s' \"$@\"\n"
"""Runs Python where root is the only user, and the kernel shows all others as 65534."""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
@pytest.mark.parametrize(("user", "credential"), [("0", b"user 0"), ("12345", b"")])
def test_a_user_outside_the_namespace_has_no_credential(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, user: str, credential: bytes
) -> None:
    python, namespaced = sys.executable, tmp_path / "python"
    namespaced.write_text(IN_A_NAMESPACE % python)
    namespaced.chmod(0o755)
    if subprocess.run([namespaced, "-c", ""], check=False, capture_output=True).returncode:
        pytest.skip("no user namespaces here")
    monkeypatch.setattr(sys, "executable", str(namespaced))
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        with opened_door(Path(folder), 0o666) as (opened, endpoint):
            said = user, (GREETING + hello()).hex(), QUESTION.hex()
            path = endpoint.removeprefix("ipc://")
            with subprocess.Popen([python, "-I", "-c", CONNECTS_AS, path, *said]) as asker:
                assert receive(opened) == [[NAME, credential, b"lift"]]
                asker.kill()


def may_lift(sockets: Sockets, credential: bytes) -> bool:
    assert sockets.questions is not None
    lifts = LiftBook()
    lifts.note(SEVENTH, bytes(8), stable=True)
    sockets.questions.take([[NAME, credential, b"lift"]], 0, Asked())
    sockets.on_verdict(published(lifts=lifts))
    return lifts.lifter is not None


@pytest.mark.parametrize(
    ("credential", "may"),
    [(b"user 12345", True), (b"user 0", True), (b"user 1", False), (b"", False), (b"key x", False)],
)
def test_only_users_named_in_ask_tell_may_lift(
    tmp_path: Path, credential: bytes, may: bool
) -> None:
    with Sockets(scene_of(tmp_path, ask={"tell": ["root", "12345"]})) as sockets:
        assert may_lift(sockets, credential) is may


def test_only_keys_named_in_ask_tell_may_lift(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    make(tmp_path, "daemon")
    public = load_pair(make(tmp_path / "clients", "controller")[1])[0]
    make(tmp_path / "clients", "dashboard")
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    ask: dict[str, object] = {"endpoint": endpoint, "tell": ["controller", "contoller"]}
    with Sockets(scene_of(tmp_path, ask=ask, curve=CURVE)) as sockets:
        assert may_lift(sockets, b"key controller")
        for other in (b"", b"key ", b"key dashboard", b"key " + public, b"user 0"):
            assert not may_lift(sockets, other)
    assert "ask.tell: there is no key contoller that may connect" in caplog.messages
    assert caplog.text.count("there is no key") == 1


@pytest.mark.slow
def test_after_a_restart_only_the_asker_may_report_the_outcome(
    tmp_path: Path, peers: Peers
) -> None:
    session = '[session]\nkeep = true\nfolder = "s"\n'
    with Daemon(tmp_path, session, recording=DEMO_RECORDING) as daemon:
        asker = peers.connect(zmq.DEALER, daemon.ask_endpoint, name=NAME)
        answer: dict[str, Any] = {}
        while answer.get("verdict") != "stable":
            asker.send(b"lift")
            answer = json.loads(asker.recv())
        daemon.kill()
        daemon.start()
        told = f"outcome {answer['boot_id']} {answer['grasp']} slip".encode()
        taken = []
        for peer in (peers.connect(zmq.DEALER, daemon.ask_endpoint, name=OTHER), asker):
            peer.send(told)
            taken.append(json.loads(peer.recv())["ok"])
    assert taken == [False, True]
