"""Answer grasp controllers that ask for a verdict, and take the outcomes of their lifts."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

from graspd.daemon.publish.companion import REPEATED, Requests
from graspd.daemon.publish.messages import OBJECT_PATTERN
from graspd.daemon.publish.porter import Frames
from graspd.daemon.trust.lift_book import GraspId, Report

JUDGE, LIFT = b"judge", b"lift"
"""Texts that ask for a verdict. `lift` also reserves the grasp's outcome for the peer."""
CLOCK = b"clock"
"""Text that asks for the daemon's monotonic time, to compare with a remote client's clock."""
OUTCOME = b"outcome"
WAITING_MAX: Final = 256
"""Most questions that wait, one of each peer. A newer one replaces the oldest."""
_REPORT = re.compile(
    rb"outcome ([0-9a-f]{32}) ([0-9]{1,15}) (stable|slip)(?: (%b))?" % OBJECT_PATTERN.encode()
)
MALFORMED = "malformed: outcome <boot_id> <grasp> <stable|slip> [<object>]"

Peer = bytes
"""Routing id of a connection."""
NAME_BYTES: Final = 16
"""Bytes at the start of a routing id that stay the same when a client reconnects."""


@dataclass(frozen=True, slots=True)
class Question:
    """A question that waits for an answer."""

    envelope: Frames
    """Frames before the answer's text: routing id, and the delimiter of a REQ socket."""
    due_ns: int
    """Time of the latest answer, monotonic ns."""
    lifts: bool
    """True for `lift`, False for `judge`."""


class Questions:
    """Takes questions and outcomes of peers, and answers them."""

    def __init__(self, send: Callable[[Sequence[bytes]], bool], patience_ns: int) -> None:
        """`send`: sends an answer's frames; returns False if it drops them.

        `patience_ns`: longest time that a question waits for a better verdict, ns.
        """
        self.counters: Counter[str] = Counter()
        """Questions and outcomes by what became of them; `dropped` counts answers."""
        self._send = send
        self._patience_ns = patience_ns
        self.waiting: dict[Peer, Question] = {}
        """Questions without an answer, by the peer's routing id; the oldest first."""

    def take(self, messages: Iterable[Frames], now_ns: int, requests: Requests) -> None:
        """Take messages of peers that arrived by `now_ns`; pass them on to `requests`."""
        asked = 0
        for peer, *envelope, text in messages:
            well_formed = envelope in ([], [b""])
            if well_formed and text.partition(b" ")[0] == OUTCOME:
                self._take_outcome([peer, *envelope], text, requests)
            elif well_formed and text in (JUDGE, LIFT):
                due_ns = now_ns + self._patience_ns
                self._wait(peer, Question([peer, *envelope], due_ns, text == LIFT))
                asked += 1
            elif well_formed and text == CLOCK:
                # `now_ns` is later than the question: an age by it is never too small.
                self._answer([peer, *envelope], b'{"v":1,"t_mono_ns":%d}' % now_ns)
                self.counters["clocks"] += 1
            else:
                self.counters["malformed"] += 1
        if asked:
            self.counters["asked"] += asked
            requests.ask()

    def _wait(self, peer: Peer, question: Question) -> None:
        if self.waiting.pop(peer, None) is not None:
            self.counters["given_up"] += 1
        elif len(self.waiting) >= WAITING_MAX:
            del self.waiting[next(iter(self.waiting))]
            self.counters["given_up"] += 1
        self.waiting[peer] = question

    def _take_outcome(self, envelope: Frames, text: bytes, requests: Requests) -> None:
        told = _REPORT.fullmatch(text)
        if told is None:
            self._answer_outcome(envelope, MALFORMED)
            return
        report = Report(
            grasp=GraspId(told[1].decode(), int(told[2])),
            outcome="slip" if told[3] == b"slip" else "stable",
            object_name=None if told[4] is None else told[4].decode(),
            peer=envelope[0][:NAME_BYTES],
        )
        requests.outcome(report, partial(self._answer_outcome, envelope))

    def _answer_outcome(self, envelope: Frames, refusal: str | None) -> None:
        answer: dict[str, object] = {"v": 1, "ok": refusal in (None, REPEATED)}
        if refusal == REPEATED:
            answer["repeated"] = True
        elif refusal is not None:
            answer["why"] = refusal
        refused = "malformed" if refusal == MALFORMED else "outcomes_refused"
        self.counters["outcomes" if answer["ok"] else refused] += 1
        self._answer(envelope, json.dumps(answer, separators=(",", ":")).encode())

    def _answer(self, envelope: Frames, payload: bytes) -> None:
        self.counters["dropped"] += not self._send((*envelope, payload))

    def answer(self, payload: bytes, now_ns: int | None = None) -> list[Peer]:
        """Answer with this verdict; return the peers that asked to lift.

        `now_ns`: answer only questions that are due by then; None: answer all.
        """
        lifters = []
        for peer, question in list(self.waiting.items()):
            if now_ns is not None and question.due_ns > now_ns:
                break
            del self.waiting[peer]
            self.counters["answered"] += 1
            self._answer(question.envelope, payload)
            if question.lifts:
                lifters.append(peer[:NAME_BYTES])
        return lifters
