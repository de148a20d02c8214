"""All sockets of a scene: for messages, for questions, and for the check of keys."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

from daemon.publish.binding import Binding, OwnKeys, PublishError
from daemon.publish.companion import Companion, Published, Requests
from daemon.publish.messages import Status
from daemon.publish.publisher import Publisher
from daemon.scene import Curve, Scene, SceneError
from daemon.trust.ledger import GraspId

if TYPE_CHECKING:
    from daemon.publish.access import Authenticator
    from daemon.publish.curve import CurveDoor, Guard
    from daemon.publish.keys import Clients
    from daemon.publish.questions import Questions

log = logging.getLogger("graspd")


class Sockets(Companion):
    """Open from the start until `close`."""

    def __init__(self, wanted: Scene, clock: Callable[[], int] = time.monotonic_ns) -> None:
        """`clock` gives monotonic ns.

        Raises `PublishError`, and `SceneError` for keys that are wrong.
        """
        self.plan = plan(wanted)
        self._clock = clock
        self._curve = wanted.curve
        self._keys_seen: object = None
        self._lost = False
        """Whether a port could not be had again."""
        self._own_keys: OwnKeys | None = None
        self.authenticator: Authenticator | None = None
        self._guard: Guard | None = None
        self.publisher: Publisher
        self.questions: Questions | None = None
        self._filenos: list[int] = []
        try:
            self._open(wanted)
        except BaseException:
            self.close()
            raise

    def _open(self, wanted: Scene) -> None:
        if wanted.curve is not None:
            self._let_in_only_known(wanted.curve)
        publish = wanted.publish
        mode = None if publish.file_mode is None else int(publish.file_mode, 8)
        binding = Binding(mode, publish.group, self._own_keys)
        self.publisher = Publisher(wanted.endpoint, publish.high_water_mark, binding)
        if wanted.ask_endpoint is not None:
            from daemon.publish.questions import Questions

            patience_ns = round(wanted.gate.request_ms * 1e6)
            asked = replace(binding, file_mode=wanted.ask_file_mode, group=wanted.ask_group)
            self.questions = Questions(wanted.ask_endpoint, patience_ns, asked)
        self._watch()
        if self._with_keys():
            from daemon.publish.curve import Guard

            self._guard = Guard(self._cut_off_greedy)

    def _let_in_only_known(self, curve: Curve) -> None:
        import zmq  # only where there are keys

        from daemon.publish.access import Authenticator
        from daemon.publish.keys import KeysError, load_clients, load_own

        self._keys_seen = _state(curve.clients)
        try:
            pair, clients = load_own(curve.secret_key), load_clients(curve.clients)
        except KeysError as error:
            raise SceneError(str(error)) from error
        self._own_keys = OwnKeys(zmq.Context(io_threads=1), *pair)
        self.authenticator = Authenticator(self._own_keys.context, clients.admitted)
        self._tell_refused(self.authenticator, clients)

    @staticmethod
    def _tell_refused(authenticator: Authenticator, clients: Clients) -> None:
        authenticator.counters["files_refused"] += len(clients.refused)
        for why in clients.refused:
            log.error("%s; no key there may connect", why)

    def _watch(self) -> None:
        self._filenos = [each.fileno() for each in self._bound() if each.is_open]
        if self.authenticator is not None:
            for door in self._with_keys():
                if door.is_open:
                    self.authenticator.watch(door.socket)
            self._filenos += self.authenticator.filenos()

    def _with_keys(self) -> list[CurveDoor]:
        if self._curve is None:
            return []
        from daemon.publish.curve import CurveDoor

        return [bound.door for bound in self._bound() if isinstance(bound.door, CurveDoor)]

    def _bound(self) -> list[Publisher | Questions]:
        wanted = (getattr(self, "publisher", None), self.questions)
        return [each for each in wanted if each is not None]

    def send(self, topic: bytes, payload: bytes) -> None:
        """Publish one message."""
        self.publisher.send(topic, payload)

    def wanted(self, topic: bytes) -> bool:
        """Whether somebody subscribes to a topic."""
        return self.publisher.wanted(topic)

    def filenos(self) -> list[int]:
        """Become readable when a peer may want something, as long as `before_wait` is called."""
        return self._filenos

    def before_wait(self, requests: Requests) -> None:
        """See to peers that come; pass on what they ask and tell."""
        self.take()
        if self.questions is not None and self.questions.take(
            self._clock(), requests.outcome, requests.keep
        ):
            requests.ask()

    def take(self) -> None:
        """See to peers that come; questions are taken by `before_wait`."""
        self.publisher.take()
        if self.authenticator is not None:
            self.authenticator.take()
        if self._guard is not None:
            self._guard.look(self._clock())

    def on_verdict(self, published: Published) -> None:
        """Answer all who have asked, or only those who have waited too long for a better answer."""
        if self.questions is None or not self.questions.waiting:
            return
        verdict = published.verdict
        overdue_at_ns = None if published.is_answer else self._clock()
        grasp = GraspId(verdict.boot_id, verdict.grasp)
        self.questions.answer(published.payload, overdue_at_ns, grasp)

    def on_status(self, status: Status) -> None:
        """Take the list of those who may connect, if it has changed."""
        self.check_keys()

    @property
    def counters(self) -> dict[str, dict[str, int]]:
        """What peers did, by the part that counted it."""
        parts = {"publish": self.publisher, "ask": self.questions, "keys": self.authenticator}
        return {name: dict(part.counters) for name, part in parts.items() if part is not None}

    def check_keys(self) -> None:
        """If the list of those who may connect has changed, take it; who is off it is cut off.

        A list that cannot be read, or that others may write, lets nobody in, and is tried again
        when it changes. A port that somebody else has taken meanwhile is left to them, and tried
        again.
        """
        if self._curve is None or self.authenticator is None:
            return
        now = _state(self._curve.clients)
        if now == self._keys_seen and not self._lost:
            return
        from daemon.publish.keys import Clients, KeysError, load_clients

        try:
            clients = load_clients(self._curve.clients)
        except KeysError as error:
            clients = Clients({}, [str(error)])
        if now != self._keys_seen:
            self._tell_refused(self.authenticator, clients)
            log.info("%d keys may connect", len(clients.admitted))
        self._keys_seen = now
        if self.authenticator.admit(clients.admitted) or self._lost:
            self._cut_off()

    def _cut_off(self) -> None:
        """Close all connections by TCP: libzmq cannot cut off one peer alone."""
        if self.authenticator is not None:
            self.authenticator.unwatch()
        self._lost = False
        for door in self._with_keys():
            try:
                door.renew()
            except PublishError as error:
                log.error("%s; nobody can connect there", error)
                self._lost = True
        self._watch()

    def _cut_off_greedy(self) -> None:
        log.error("peers with keys hold too much memory: all of them have to connect again")
        for door in self._with_keys():
            door.counters["all_cut_off"] += 1
        self._cut_off()

    def close(self) -> None:
        """Close them all. May be called again."""
        if self._guard is not None:
            self._guard.close()
            self._guard = None
        for bound in self._bound():
            bound.close()
        if self.authenticator is not None:
            self.authenticator.close()
        if self._own_keys is not None:
            self._own_keys.context.term()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()


def plan(wanted: Scene) -> object:
    """What of a scene is about its sockets: equal for scenes that can share them."""
    asked = (wanted.ask_endpoint, wanted.ask_file_mode, wanted.ask_group, wanted.gate.request_ms)
    own_key = None if wanted.curve is None else _state(wanted.curve.secret_key.parent)
    return wanted.hand.name, wanted.publish, wanted.curve, own_key, asked


def _state(folder: Path) -> object:
    """Differs from one look to the next when a file in the folder was put, changed or removed, or
    who may write there."""
    try:
        with os.scandir(folder) as entries:
            found = {entry.name: _signature(entry) for entry in entries}
        about = os.stat(folder)
    except OSError as error:
        return error.errno
    return found, about.st_ino, about.st_ctime_ns


def _signature(entry: os.DirEntry[str]) -> object:
    """Differs when a file was replaced or changed, or its rights."""
    try:
        about = entry.stat()
    except OSError as error:  # such as a link that leads nowhere
        return error.errno
    return about.st_ino, about.st_mtime_ns, about.st_ctime_ns, about.st_size
