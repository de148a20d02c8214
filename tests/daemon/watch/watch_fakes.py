"""Messages to watch, views of them, and somebody who publishes them as long as he is asked to."""

from __future__ import annotations

import io
import json
import threading
from typing import Any, Literal, Self

from msgspec import structs
from rich.console import Console

from graspd.daemon.judge.reasons import Decision, GateState, Reason
from graspd.daemon.publish.messages import (
    DECISION_CODE,
    LearnerHealth,
    Lifts,
    State,
    Status,
    Tactile,
    Verdict,
    encode,
)
from graspd.daemon.trust.lift_book import OutcomeStatus
from graspd.daemon.trust.risk import RiskReport
from graspd.daemon.watch.snapshot import Snapshot
from graspd.daemon.watch.terminal import draw
from graspd.daemon.watch.view import View
from tests.daemon.publish.doors import Publisher

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
BOOT = "0f0e0d0c0b0a09080706050403020100"
MS = 1_000_000
PERIOD_S = 0.02
ENDPOINT = "ipc:///tmp/any"
RESTING = [3000] * 24


def verdict(seq: int, decision: Decision = Decision.UNKNOWN, **other: Any) -> bytes:  # noqa: ANN401
    p_slip = {Decision.STABLE: 0.25, Decision.SLIP: 0.75, Decision.UNKNOWN: None}[decision]
    content: dict[str, Any] = {
        "boot_id": BOOT,
        "seq": seq,
        "t": 1790000000.0,
        "t_mono_ns": 123456789012345,
        "grasp": 7,
        "verdict": decision,
        "verdict_code": DECISION_CODE[decision],
        "p_slip": p_slip,
        "valid": p_slip is not None,
        "reasons": [] if p_slip is not None else [Reason.NO_CONTACT],
        "age_ms": 0.5,
        "latency_us": 250.0,
        "judged": p_slip is not None,
        "gate": GateState.IDLE if p_slip is None else GateState.JUDGED,
        "contact": [] if p_slip is None else ["ff", "th"],
        "silence_ms": 100.0,
        "model": "small-session",
        "model_sha": "0123456789ab",
        "p_slip_model": None if p_slip is None else 0.3,
        "outcomes": 57,
        "risk": RISK,
    }
    return encode(Verdict(**{**content, **other}))


def tactile(seq: int, *counts: list[int], faulty: tuple[int, ...] = ()) -> bytes:
    """Of the fingers `ff` and `th`; the electrodes of `ff` that are `faulty`, from 0."""
    faults = [[0] * 24 for _ in counts]
    for electrode in faulty:
        faults[0][electrode] = 1
    return encode(
        Tactile(
            boot_id=BOOT,
            seq=seq,
            t=1790000000.0,
            t_mono_ns=123456789012345,
            fingers=["ff", "th"],
            counts=list(counts),
            faults=faults,
            joints={"FFJ3": 0.5},
        )
    )


def status(seq: int, **other: Any) -> bytes:  # noqa: ANN401
    content: dict[str, Any] = {
        "boot_id": BOOT,
        "seq": seq,
        "t": 1790000000.0,
        "t_mono_ns": 123456789012345,
        "state": State.RUNNING,
        "readings_hz": 100.0,
        "verdicts": {Decision.STABLE: 3},
        "reasons": {},
        "drivers": {"replay": {"readings": 3}},
        "session_grasps": 12,
        "session_calibrated": False,
        "gate": GateState.IDLE,
        "tared": ["ff", "th"],
        "health": {"ff_7": Reason.ELECTRODE_DEAD},
        "latency_us": {"p50": 250.0, "p99": 500.0, "max": 750.0},
        "model": "small-session",
        "model_sha": "0123456789ab",
        "versions": {"graspd": "0.1.0"},
    }
    return encode(Status(**{**content, **other}))


def a_view(hand: str | None = None) -> View:
    return View(ENDPOINT, hand, wall=lambda: 1790000000.0)


def after(*messages: tuple[bytes, bytes], at_ns: int = 0) -> View:
    seen = a_view()
    for topic, payload in messages:
        seen.take(topic, payload, at_ns)
    return seen


FIVE = ["ff", "mf", "rf", "lf", "th"]
LIFTS = Lifts(reported=41, outstanding=1, unreported=3)
LEARNER = LearnerHealth(enabled=True, outcomes=5, told={OutcomeStatus.TAKEN: 5}, uncertainty=0.4)


def whole_hand(view: View, hand: str, decision: Decision, seq: int = 0) -> Snapshot:
    """Five fingers that all move and touch, with many joints, lifts and a learner."""
    joints = {f"{name}J{joint}": 0.5 for name in ("FF", "MF", "RF", "TH") for joint in range(6)}
    reading = {"fingers": FIVE, "counts": [RESTING] * 5, "faults": [[0] * 24] * 5, "joints": joints}
    said = verdict(
        seq,
        decision,
        grasp=7 + seq // 9,
        reasons=[Reason.STALE] if decision is Decision.UNKNOWN else [],
        contact=FIVE,
        still_ms=131.0,
        motion=dict.fromkeys(FIVE, 1.2),
        motion_limits=dict.fromkeys(FIVE, 1.5),
    )
    view.take(f"status.{hand}".encode(), status(seq, lifts=LIFTS, learner=LEARNER), 0)
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
    """The lines of a terminal, without colours unless they are asked for."""
    hands = seen if isinstance(seen, list) else [seen]
    file = io.StringIO()
    system: Literal["truecolor"] | None = "truecolor" if colours else None
    console = Console(
        file=file, width=width, height=height, force_terminal=colours, color_system=system
    )
    console.print(draw(hands, width, chosen, page))
    return file.getvalue().splitlines()


class Talker:
    """A daemon that says what it is told, fifty times a second, until the block ends."""

    def __init__(self, endpoint: str) -> None:
        self.decision: Decision | None = Decision.UNKNOWN
        """What the verdicts are; none come if None."""
        self.more: dict[str, Any] = {}
        """What else they say."""
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
