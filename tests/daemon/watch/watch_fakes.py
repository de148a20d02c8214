"""Messages for a viewer, views that took them, and a publisher that sends them."""

from __future__ import annotations

import io
import json
import threading
from typing import Any, Literal, Self

from msgspec import structs
from rich.console import Console

from graspd.daemon.judge.reasons import Decision, GateState, Reason
from graspd.daemon.publish.messages import DECISION_CODE, LearnerHealth, RiskReport, encode
from graspd.daemon.trust.lift_book import OutcomeStatus
from graspd.daemon.watch.snapshot import Snapshot
from graspd.daemon.watch.terminal import draw
from graspd.daemon.watch.view import View
from tests.daemon.publish.doors import Publisher
from tests.kit.messages import GOLDEN, GOLDEN_STATUS, GOLDEN_VERDICT, decode_tactile
from tests.kit.waiting import wait_until

RISK = RiskReport(
    target=0.1,
    lifts=41,
    slips=2,
    outstanding=1,
    bound=9.5,
    warm_up_left=0,
    announced=40,
    awaited=1,
)
"""Enough to show `stable` as a promise: the lifts are more than 1 / target, 4.9 % slipped."""
NOTHING_TOLD = structs.replace(RISK, lifts=0, slips=0)
BOOT = GOLDEN_VERDICT.boot_id
GOLDEN_TACTILE = decode_tactile((GOLDEN / "tactile.json").read_bytes())
MS = 1_000_000
PERIOD_S = 0.02
ENDPOINT = "ipc:///tmp/any"
RESTING = [3000] * 24


def verdict(seq: int, decision: Decision = Decision.UNKNOWN, **other: Any) -> bytes:  # noqa: ANN401
    p_slip = {Decision.STABLE: 0.25, Decision.SLIP: 0.75, Decision.UNKNOWN: None}[decision]
    judged = p_slip is not None
    said = structs.replace(
        GOLDEN_VERDICT,
        seq=seq,
        grasp=7,
        verdict=decision,
        verdict_code=DECISION_CODE[decision],
        p_slip=p_slip,
        valid=judged,
        reasons=[] if judged else [Reason.NO_CONTACT],
        judged=judged,
        gate=GateState.JUDGED if judged else GateState.IDLE,
        contact=["ff", "th"] if judged else [],
        p_slip_model=0.3 if judged else None,
        outcomes=57,
        risk=RISK,
    )
    return encode(structs.replace(said, **other))


def tactile(seq: int, *counts: list[int], faulty: tuple[int, ...] = ()) -> bytes:
    """Return a message. `counts`: the 24 of `ff`, then the 24 of `th`. `faulty`: electrodes of
    `ff`, from 0, which get a fault."""
    faults = [[0] * 24 for _ in counts]
    for electrode in faulty:
        faults[0][electrode] = 1
    reading = structs.replace(GOLDEN_TACTILE, seq=seq, counts=list(counts), faults=faults)
    return encode(structs.replace(reading, joints={"FFJ3": 0.5}))


def status(seq: int, **other: Any) -> bytes:  # noqa: ANN401
    health = {"ff_7": Reason.ELECTRODE_DEAD}
    return encode(structs.replace(GOLDEN_STATUS, **{"seq": seq, "health": health, **other}))


def a_view(hand: str | None = None) -> View:
    return View(ENDPOINT, hand, wall=lambda: 1790000000.0)


def after(*messages: tuple[bytes, bytes], at_ns: int = 0) -> View:
    seen = a_view()
    for topic, payload in messages:
        seen.take(topic, payload, at_ns)
    return seen


FIVE = ["ff", "mf", "rf", "lf", "th"]
LEARNER = LearnerHealth(enabled=True, outcomes=5, told={OutcomeStatus.TAKEN: 5}, uncertainty=0.4)


def whole_hand(view: View, hand: str, decision: Decision, seq: int = 0) -> Snapshot:
    """Give `view` messages of five fingers that all touch, with many joints; return a snapshot."""
    joints = {f"{name}J{joint}": 0.5 for name in ("FF", "MF", "RF", "TH") for joint in range(6)}
    reading = {"fingers": FIVE, "counts": [RESTING] * 5, "faults": [[0] * 24] * 5, "joints": joints}
    said = verdict(
        seq,
        decision,
        grasp=7 + seq // 9,
        reasons=[Reason.STALE] if decision is Decision.UNKNOWN else [],
        contact=FIVE,
        still_ms=131.0,
        motion=dict.fromkeys(FIVE, 1.2) | {"rf": None},
        motion_limits=dict.fromkeys(FIVE, 1.5),
    )
    view.take(f"status.{hand}".encode(), status(seq, learner=LEARNER), 0)
    message = json.dumps(json.loads(tactile(0)) | reading).encode()
    view.take(f"tactile.{hand}".encode(), message, 0)
    view.take(f"verdict.{hand}".encode(), said, 0)
    return view.snapshot(0)


def text_of(
    seen: Snapshot | list[Snapshot],
    width: int = 80,
    chosen: int = 0,
    height: int = 1000,
    page: int = 0,
    *,
    colours: bool = False,
) -> list[str]:
    """Return the lines that a terminal of `width` and `height` shows, with colour codes only if
    `colours`. `chosen`: hand with details. `page`: number of pages to skip."""
    hands = seen if isinstance(seen, list) else [seen]
    file = io.StringIO()
    system: Literal["truecolor"] | None = "truecolor" if colours else None
    console = Console(
        file=file, width=width, height=height, force_terminal=colours, color_system=system
    )
    console.print(draw(hands, width, chosen, page))
    return file.getvalue().splitlines()


class Talker:
    """Stands for a daemon: sends messages with `decision` fifty times a second in the block."""

    def __init__(self, endpoint: str) -> None:
        self.decision: Decision | None = Decision.UNKNOWN
        """Decision of the verdicts; None: nothing is sent."""
        self.more: dict[str, Any] = {}
        """Other fields of the verdicts."""
        self.sent = 0
        """Number of times that status, counts and verdict were sent."""
        self._publisher = Publisher(endpoint)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._talk)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_details: object) -> None:
        self._over.set()
        self._thread.join()
        self._publisher.close()

    def wait_for(self, number: int) -> None:
        """Wait until `number` more verdicts were sent."""
        last = self.sent + number
        wait_until(lambda: self.sent >= last)

    def _talk(self) -> None:
        seq = 0
        while not self._over.wait(PERIOD_S):
            decision = self.decision
            if decision is None:
                continue
            pressed = 0 if decision is Decision.UNKNOWN else 400
            counts = [3000 - pressed] * 12 + [3000] * 12
            self._publisher.send(b"status.right", status(seq))
            self._publisher.send(b"tactile.right", tactile(seq, counts, counts, faulty=(6,)))
            self._publisher.send(b"verdict.right", verdict(seq, decision, **self.more))
            seq += 1
            self.sent = seq
