"""The rules of the Python client and of the C++ client, compared at each step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple

from deploy.clients.python.graspd_client import Counts, Newest, Verdict
from tests.clients.building import Probe
from tests.clients.messages import MAX_AGE_NS, MS, TOPIC

START_NS = 1000 * MS


class Rules:
    """Gives each message to both clients' rules, and asserts that they say the same verdict.

    `cpp` None: the Python client's alone.
    """

    def __init__(self, cpp: Probe | None, same_computer: bool = True) -> None:
        self._python = Newest(TOPIC, MAX_AGE_NS, same_computer)
        self._cpp = cpp
        self._tell_cpp("new", MAX_AGE_NS, int(same_computer))

    def take(
        self, frames: Sequence[bytes], empty_ns: int = START_NS, now_ns: int = START_NS
    ) -> None:
        self._python.take([*frames], empty_ns, now_ns)
        self._tell_cpp("take", empty_ns, now_ns, *(frame.hex() or "-" for frame in frames))

    def compare_clocks(self, asked_ns: int, told_ns: int) -> None:
        self._python.compare_clocks(asked_ns, told_ns)
        self._tell_cpp("clock", asked_ns, told_ns)

    def end(self, boot_id: str, grasp: int) -> None:
        self._python.end((boot_id, grasp))
        self._tell_cpp("end", boot_id, grasp)

    def at(self, now_ns: int = START_NS) -> Verdict:
        verdict = self._python.at(now_ns)
        if self._cpp is not None:
            assert self._cpp.ask("at", now_ns) == in_words(verdict, self._python.counts)
        return verdict

    def _tell_cpp(self, *words: object) -> None:
        if self._cpp is not None:
            self._cpp.tell(*words)

    @property
    def counts(self) -> Counts:
        return self._python.counts


def in_words(verdict: Verdict, counts: Counts) -> str:
    """Return a verdict and counts as the line that the probe writes for them."""
    place = [-1 if number is None else number for number in (verdict.grasp, verdict.seq)]
    age_ns = round((-1.0 if verdict.age_ms is None else verdict.age_ms) * 1e6)
    words = [verdict.decision, len(verdict.reasons), *verdict.reasons, *place]
    words += [verdict.boot_id or "-", age_ns, _fixed(verdict.p_slip), _fixed(verdict.p_slip_model)]
    words += [verdict.outcomes, int(verdict.supervised), int(bool(verdict))]
    if risk := verdict.risk:
        words += [_fixed(risk.target), risk.lifts, risk.slips, risk.outstanding]
        words += [-1 if risk.bound is None else round(risk.bound), risk.warm_up_left]
        words += [risk.announced, risk.awaited]
    words += [f"{verdict.early:d}{verdict.owner or ''}"]
    words += [-1000000 if verdict.still_ms is None else round(verdict.still_ms * 1e6)]
    for finger, moves in sorted((verdict.motion or {}).items()):
        words.append(f"{finger}={-1000 if moves is None else round(moves * 1e3)}")
    words += [
        f"{name}<{round(most * 1e3)}"
        for name, most in sorted((verdict.motion_limits or {}).items())
    ]
    felt = sorted((verdict.fingers or {}).items())
    words += [f"{finger}-{'unknown' if state is None else state}" for finger, state in felt]
    return " ".join(map(str, [*words, *astuple(counts)]))


def _fixed(share: float | None) -> int:
    """Return a share times 1e9, as the probe writes it; -1e9 for None."""
    return round((-1.0 if share is None else share) * 1e9)
