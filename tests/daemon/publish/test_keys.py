"""Peers without a key, with a wrong one, or off the list cannot connect, and the log says so."""

from __future__ import annotations

import os
import re
import socket
import stat
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zmq

from graspd.daemon.publish import keys
from graspd.daemon.publish.keys import KeysError, load_clients, load_own, load_pair, make
from graspd.daemon.publish.porter import LOOK_MS
from tests.daemon.publish.doors import QUIET_S, Asked, KeyedDoor, processes, published
from tests.kit.inside import graspd, refused
from tests.kit.messages import GOLDEN_STATUS
from tests.kit.scenes import demo_scene
from tests.kit.waiting import PATIENCE_S, wait_until


@pytest.fixture
def door(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[KeyedDoor]:
    door = KeyedDoor(tmp_path, monkeypatch)
    yield door
    door.close()


def test_a_peer_with_a_listed_key_gets_messages_and_answers(door: KeyedDoor) -> None:
    assert door.hears(door.connect(door.known), PATIENCE_S)
    asker = door.connect(door.known, zmq.REQ)
    asker.send(b"judge")
    questions, requests = door.sockets.questions, Asked()
    assert questions is not None

    def has_come() -> int:
        door.sockets.before_wait(requests)
        return requests.times

    wait_until(has_come)
    assert [peer.credential for peer in questions.waiting] == [b"key controller"]
    questions.answer(published())
    assert asker.poll(int(PATIENCE_S * 1e3))
    assert asker.recv() == b"{}"
    assert door.said().count("admitted a peer with the key of controller") == 2


def test_an_unlisted_key_is_refused_and_logged(door: KeyedDoor, tmp_path: Path) -> None:
    keys = door.client("stranger", tmp_path / "elsewhere")
    assert not door.hears(door.connect(keys), QUIET_S)
    told = f"turned away a peer: its key {keys[0].decode()} is not on the list"
    wait_until(lambda: told in door.said())
    assert door.hears(door.connect(door.known), PATIENCE_S)


def test_a_peer_without_a_key_is_refused_with_a_warning(door: KeyedDoor) -> None:
    for kind in (zmq.SUB, zmq.SUB, zmq.DEALER):
        assert not door.hears(door.connect(None, kind), QUIET_S)
    # A peer that sees what the daemon wants may hang up before it has said that it has no key.
    told = re.compile("turned away a peer: it (has no key|does not speak ZeroMQ with keys)")
    wait_until(lambda: told.search(door.said()))
    assert door.hears(door.connect(door.known), PATIENCE_S)


def test_removing_a_key_disconnects_its_peer_despite_a_broken_file(
    door: KeyedDoor, tmp_path: Path
) -> None:
    friend = door.admitted("friend", tmp_path / "friends")
    (door.clients / "new.key").symlink_to("nowhere")
    wait_until(lambda: "new.key: " in door.said())
    leaving, staying = door.connect(friend), door.connect(door.known)
    assert door.hears(leaving, PATIENCE_S)
    assert door.hears(staying, PATIENCE_S)
    assert door.said().count("the key of controller") == 1
    time.sleep(2 * LOOK_MS / 1e3)
    assert door.said().count("new.key: ") == 1
    (door.clients / "friend.key").unlink()
    door.knows(1)
    door.is_deaf(leaving)
    assert door.hears(staying, PATIENCE_S)
    door.is_deaf(door.connect(friend))


def test_a_folder_that_others_may_write_admits_no_key(door: KeyedDoor) -> None:
    former = door.connect(door.known)
    assert door.hears(former, PATIENCE_S)
    door.clients.chmod(0o770)
    door.knows(0)
    assert "no key there may connect" in door.said()
    door.is_deaf(former)
    door.is_deaf(door.connect(door.known))
    door.clients.chmod(0o755)
    door.knows(1)  # libzmq does not try again where it was turned away
    assert door.hears(door.connect(door.known), PATIENCE_S)


def test_keys_reached_through_a_folder_open_to_all_are_refused(tmp_path: Path) -> None:
    make(tmp_path / "clients", "laptop")
    (tmp_path / "way").mkdir()
    (tmp_path / "way" / "clients").symlink_to("../clients")
    (tmp_path / "way").chmod(0o777)
    with pytest.raises(KeysError, match="way: mode 0777"):
        load_clients(tmp_path / "way" / "clients")


NO_KEYS: dict[str, Callable[[Path], object]] = {
    "empty": Path.touch,
    "short": lambda path: path.write_text("public-key = 'short'"),
    "not ASCII": lambda path: path.write_text('curve\n    public-key = "é"\n'),
    "too large": lambda path: path.write_bytes(bytes(1 << 20)),
    "pipe": os.mkfifo,
}


@pytest.mark.parametrize("kind", NO_KEYS)
def test_a_broken_key_file_is_named_and_others_are_admitted(tmp_path: Path, kind: str) -> None:
    NO_KEYS[kind](tmp_path / "broken.key")
    make(tmp_path, "laptop")
    admitted, refused = load_clients(tmp_path)
    assert list(admitted.values()) == ["laptop"]
    assert ["broken.key: " in why for why in refused] == [True]


def test_of_two_files_with_one_key_the_first_is_used(tmp_path: Path) -> None:
    public, _ = make(tmp_path, "controller")
    (tmp_path / "spare.key").write_bytes(public.read_bytes())
    admitted, refused = load_clients(tmp_path)
    assert list(admitted.values()) == ["controller"]
    assert refused == [f"{tmp_path}/spare.key: has the same key as controller.key, which is used"]


@pytest.mark.parametrize("mode", [0o664, 0o646])
def test_a_key_that_others_may_write_is_refused(tmp_path: Path, mode: int) -> None:
    public, secret = make(tmp_path, "laptop")
    public.chmod(mode)
    admitted, refused = load_clients(tmp_path)
    assert admitted == {}
    assert ["others may write it" in why for why in refused] == [True]
    tmp_path.chmod(0o777)
    with pytest.raises(KeysError, match=f"{tmp_path}: mode 0777; others may write it"):
        load_own(secret)


def test_keys_below_a_shared_folder_need_its_sticky_bit(tmp_path: Path) -> None:
    """A sticky folder, such as /tmp, lets no user replace another's files."""
    keys = tmp_path / "keys"
    public, secret = make(keys, "laptop")
    tmp_path.chmod(0o1777)
    assert load_own(secret)[0] in load_clients(keys).admitted
    public.rename(tmp_path / "laptop.key")
    public.symlink_to(tmp_path / "laptop.key")
    assert list(load_clients(keys).admitted.values()) == ["laptop"]
    tmp_path.chmod(0o777)
    with pytest.raises(KeysError, match=f"{tmp_path}: mode 0777"):
        load_clients(keys)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
@pytest.mark.parametrize("which", [".", "clients", "clients/laptop.key"])
def test_keys_of_another_user_are_refused(tmp_path: Path, which: str) -> None:
    keys = tmp_path / "keys"
    make(keys / "clients", "laptop")
    os.chown(keys / which, 12345, -1)
    try:
        why = load_clients(keys / "clients").refused[0]
    except KeysError as error:
        why = str(error)
    assert why == f"{keys / which}: belongs to 12345, who may put another key there"


def test_a_cycle_of_symbolic_links_is_refused(tmp_path: Path) -> None:
    (tmp_path / "one").symlink_to("two")
    (tmp_path / "two").symlink_to("one")
    with pytest.raises(KeysError, match="Too many levels"):
        load_clients(tmp_path / "one" / "clients")


def test_a_public_key_alone_and_a_taken_name_are_refused(tmp_path: Path) -> None:
    public, secret = make(tmp_path, "daemon")
    with pytest.raises(KeysError, match="has no secret key"):
        load_pair(public)
    before = secret.read_bytes()
    with pytest.raises(KeysError, match="there already"):
        make(tmp_path, "daemon")
    assert secret.read_bytes() == before
    with pytest.raises(KeysError, match="not a name"):
        make(tmp_path, "../daemon")


def test_the_keys_command_makes_and_lists_keys_and_checks_rights(tmp_path: Path) -> None:
    assert graspd("keys", "make", "daemon", "--dir", tmp_path).returncode == 0
    assert stat.S_IMODE(os.stat(tmp_path / "daemon.key_secret").st_mode) == 0o600
    (tmp_path / "clients").mkdir()
    graspd("keys", "make", "laptop", "--dir", tmp_path / "laptop")
    (tmp_path / "laptop" / "laptop.key").rename(tmp_path / "clients" / "laptop.key")
    listed = graspd("keys", "list", "--dir", tmp_path)
    assert [line.split()[:2] for line in listed.stdout.splitlines()] == [
        ["own", "daemon"],
        ["clients", "laptop"],
    ]
    (tmp_path / "daemon.key_secret").chmod(0o644)
    assert graspd("keys", "list", "--dir", tmp_path).returncode == 2


def test_listing_keys_refuses_a_missing_folder_only_if_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = tmp_path / "kesy"
    said = refused("keys", "list", "--dir", missing)
    assert said == f"graspd: {missing}: cannot list the keys: No such file or directory\n"
    monkeypatch.setattr("graspd.daemon.commands.keys.FOLDER", missing)
    listed = graspd("keys", "list")  # before the first key is made
    assert (listed.returncode, listed.stdout) == (0, "")
    assert listed.stderr == f"graspd: {missing}: no .key_secret file, and no key in clients/\n"


@pytest.mark.parametrize("command", ["check", "run"])
def test_check_and_run_refuse_keys_that_others_may_replace(tmp_path: Path, command: str) -> None:
    make(tmp_path / "keys", "daemon")
    make(tmp_path / "keys" / "clients", "laptop")
    curve = '[curve]\nsecret_key = "keys/daemon.key_secret"\nclients = "keys/clients"\n'
    ask = '[ask]\nendpoint = "tcp://127.0.0.1:1"\ntell = ["laptpo"]\n'
    scene = demo_scene(tmp_path, sections=ask + curve)
    assert "ask.tell: there is no key laptpo that may connect" in graspd("check", scene).stderr
    (tmp_path / "keys").chmod(0o777)
    assert f"{tmp_path}/keys: mode 0777; others may write it" in refused(command, scene)


def test_the_port_stays_taken_while_the_socket_process_restarts(
    door: KeyedDoor, tmp_path: Path
) -> None:
    door.admitted("friend", tmp_path / "friends")
    (door.clients / "friend.key").unlink()
    door.knows(1)
    (process,) = processes()
    wait_until(lambda: ") Z " in Path(f"/proc/{process}/stat").read_text())
    with pytest.raises(OSError, match="in use"):
        socket.create_server(("127.0.0.1", door.port))
    assert door.hears(door.connect(door.known), PATIENCE_S)


def test_keys_are_never_read_by_the_loop(
    door: KeyedDoor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading a thousand keys takes 60 ms, and a folder on the network may hang."""
    read: list[str] = []
    monkeypatch.setattr(keys, "load_clients", lambda _: read.append("list"))
    monkeypatch.setattr(keys, "state", lambda _: read.append("state"))
    new = door.admitted("new", tmp_path / "new")
    door.sockets.on_status(GOLDEN_STATUS)
    assert door.hears(door.connect(new), PATIENCE_S)
    assert read == []
