"""A grasp whose outcome was told is offered no more: over the real sockets, in both languages."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import zmq

from deploy.clients.python.graspd_client import Client, Outcome
from graspd.drivers.twins.grasps.grasp_script import Durations
from graspd.drivers.twins.grasps.whole_grasps import synthetic_grasps
from tests.clients.bench import Daemon
from tests.clients.probe import Probe
from tests.daemon.processes import TIMEOUT_S
from tests.kit.demos import write_stream
from tests.kit.waiting import wait_until

WARM_UP = "[risk]\nmax_slip_when_stable = 0.2\nwarm_up = 50\n"
"""Each grasp is to be lifted under supervision."""
LIFT_S, AGAIN_S = 1.0, 0.05
"""How long to wait for a first lift of a grasp, and for another one that must not be allowed."""
HELD_S = 8.0
"""A busy machine needs seconds to ask and to tell."""
ENOUGH = 20
"""Verdicts of a grasp that is held after its outcome, four refreshes long."""


class InCpp:
    """The C++ client."""

    def __init__(self, probe: Probe, daemon: Daemon) -> None:
        self._probe = probe
        probe.tell("client", daemon.endpoint, daemon.ask_endpoint)

    def may_i_lift(self, deadline_s: float) -> int | None:
        may, grasp, _ = self._probe.ask("watch", deadline_s).split()
        return int(grasp) if may == "1" else None

    def slipped(self) -> bool:
        return self._probe.ask("slipped") == "told"


class InPython:
    """The Python client."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._lifted_on = client.verdict()

    def may_i_lift(self, deadline_s: float) -> int | None:
        answer = self._client.may_i_lift(deadline_s, supervised=True)
        if not answer:
            return None
        self._lifted_on = answer.verdict
        return answer.verdict.grasp

    def slipped(self) -> bool:
        return bool(self._client.tell(self._lifted_on, Outcome.SLIPPED, wait_s=10.0))


class Listener:
    """Hears outcomes and verdicts in the order in which they were published."""

    def __init__(self, socket: zmq.Socket[bytes], daemon: Daemon) -> None:
        socket.linger = 0
        socket.connect(daemon.endpoint)
        socket.subscribe("outcome.right")
        socket.subscribe("verdict.right")
        self._socket = socket
        self.told: set[int] = set()
        self.held_on = 0
        """Verdicts that say of a grasp that it is held after its outcome."""
        self.is_held = False

    def listen(self) -> None:
        """Take in a message, and all that wait: no grasp is offered after its outcome."""
        assert self._socket.poll(round(TIMEOUT_S * 1e3))
        while self._socket.poll(0):
            topic, payload = self._socket.recv_multipart()
            message: dict[str, Any] = json.loads(payload)
            if topic == b"outcome.right":
                self.told.add(message["grasp"])
                continue
            is_told = message["grasp"] in self.told
            self.is_held = is_told and message["gate"] not in ("idle", "released")
            if is_told:
                assert (message["verdict"], message["supervised"]) == ("unknown", False)
                assert ("outcome-told" in message["reasons"]) is self.is_held
                self.held_on += self.is_held


def test_a_told_grasp_is_offered_no_more_in_either_language(probe: Probe, tmp_path: Path) -> None:
    with (
        Daemon(tmp_path, WARM_UP, recording=long_holds(tmp_path / "held.csv")) as daemon,
        zmq.Context() as context,
        context.socket(zmq.SUB) as socket,
        Client(daemon.endpoint, ask_endpoint=daemon.ask_endpoint) as python,
        Client(daemon.endpoint, ask_endpoint=daemon.ask_endpoint) as nobody,
    ):
        listener, cpp = Listener(socket, daemon), InCpp(probe, daemon)
        for lifts, asks_too in ((InPython(python), cpp), (cpp, InPython(nobody))):
            told_while_held(listener, lifts, asks_too)


def long_holds(path: Path) -> Path:
    """Write a recording of grasps that are held for longer than telling an outcome takes."""
    durations = Durations(first_rest_s=(1.5, 1.5), settle_s=(HELD_S, HELD_S))
    with path.open("w") as file:
        write_stream(synthetic_grasps(2, durations=durations), file, t_decimals=2)
    return path


def told_while_held(
    listener: Listener, lifts: InPython | InCpp, asks_too: InPython | InCpp
) -> None:
    """Lift grasps, and tell their outcomes, until one is held for long after it was told."""
    enough = listener.held_on + ENOUGH

    def is_enough() -> bool:
        grasp = lifts.may_i_lift(LIFT_S)
        listener.listen()
        if grasp is None:
            return False
        assert grasp not in listener.told
        assert lifts.slipped()
        while grasp not in listener.told:
            listener.listen()
        while listener.is_held and listener.held_on < enough:
            for each in (lifts, asks_too):
                assert each.may_i_lift(AGAIN_S) != grasp
            listener.listen()
        return listener.held_on >= enough

    wait_until(is_enough)
