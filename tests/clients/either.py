"""The Python and the C++ client behind the same calls, so that one test checks both."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from deploy.clients.python.graspd_client import Client, Decision, Verdict
from tests.clients.building import Probe

WAIT_S = 30.0


class Grasp(NamedTuple):
    """A grasp whose outcome is reported: start of the daemon, and number."""

    boot_id: str
    number: int


class Said(NamedTuple):
    """The answer to whether the hand may lift."""

    may: bool
    supervised: bool
    decision: str
    grasp: Grasp
    reasons: tuple[str, ...] = ()
    owner: str | None = None

    @property
    def word(self) -> str:
        """The decision, or `supervised` if the hand may lift under supervision."""
        return "supervised" if self.supervised else self.decision


class InPython:
    """The Python client."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self.warned: list[str] = []
        """Always empty: it logs its warnings."""

    def lift(
        self, deadline_s: float, *, supervised: bool = False, still_ms: float | None = None
    ) -> Said:
        answer = self._client.may_i_lift(deadline_s, supervised=supervised, still_ms=still_ms)
        said = answer.verdict
        about = Grasp(said.boot_id or "-", -1 if said.grasp is None else said.grasp)
        word = said.decision, about, said.reasons, said.owner
        return Said(bool(answer), answer.supervised, *word)

    def grasp(self, deadline_s: float, *, supervised: bool = False) -> int | None:
        found = self._client.wait_for_grasp(deadline_s, supervised=supervised)
        return None if found is None else found.grasp

    def tell(
        self, grasp: Grasp, outcome: str, name: str | None = None, wait_s: float = WAIT_S
    ) -> str:
        lifted_on = Verdict(Decision.STABLE, boot_id=grasp.boot_id, grasp=grasp.number)
        return self._client.tell(lifted_on, outcome, name, wait_s).why

    @property
    def unreported(self) -> int:
        return self._client.unreported


class InCpp:
    """The C++ client, in the process of the probe."""

    def __init__(self, probe: Probe, endpoint: str, ask_endpoint: str | None) -> None:
        self.warned: list[str] = []
        self.unreported = 0
        self._probe = probe
        probe.tell("client", endpoint, ask_endpoint or "-", 100)

    def lift(
        self, deadline_s: float, *, supervised: bool = False, still_ms: float | None = None
    ) -> Said:
        still = "-" if still_ms is None else still_ms
        words = self._ask("lift", deadline_s, int(supervised), still).split()
        may, under_watch, decision, unreported, grasp, boot_id, owner, *reasons = words
        self.unreported = int(unreported)
        about = Grasp(boot_id, int(grasp))
        word = decision, about, tuple(reasons), None if owner == "-" else owner
        return Said(may == "1", under_watch == "1", *word)

    def grasp(self, deadline_s: float, *, supervised: bool = False) -> int | None:
        found = int(self._ask("wait", deadline_s, int(supervised)))
        return None if found < 0 else found

    def tell(
        self, grasp: Grasp, outcome: str, name: str | None = None, wait_s: float = WAIT_S
    ) -> str:
        return self._ask("tell", wait_s, *grasp, outcome, (name or "").encode().hex())

    def _ask(self, *words: object) -> str:
        line = self._probe.ask(*words)
        while line.startswith("warn "):
            self.warned.append(line.removeprefix("warn "))
            line = self._probe.line()
        if line.startswith("refused "):
            raise ValueError(line)
        return line


Either = InPython | InCpp
Connect = Callable[..., Either]
"""Makes a client of the sockets `out` and `ask` (None: without) in a folder, or of an endpoint as
`out`."""
