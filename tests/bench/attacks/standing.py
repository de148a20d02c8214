"""Verdicts that outlive what they are about: a grasp that drifts to slip."""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import zmq
from numpy.typing import NDArray

from graspd.daemon.judge.hand import FreshMedian
from graspd.daemon.publish.messages import Tactile, Verdict
from graspd.drivers.twins.grasps.grasps import Counts
from graspd.drivers.twins.grasps.whole_grasps import synthetic_grasps
from graspd.drivers.twins.spi import SpiTwin
from graspd.models import zoo
from graspd.models.runtime import TactileModel
from tests.bench.attacks.attack import Outcome, Plan
from tests.bench.live import HELD, PATIENCE_S, Subscriber, running, spi_section
from tests.kit.messages import decode_tactile, decode_verdict
from tests.threads import at_work

MODEL = "cnn1"
"""What it says of counts depends on nothing else."""
SEED = 5
"""A synthetic grasp of which it says 0.3, and something else of counts nearby."""
SHAPE = (3, 24)
HELD_SWEEPS = 100
"""Of a hold, before the drift: time to be judged."""
DRIFT_SWEEPS = 500
DRIFT_COUNTS = 35.0
"""Of each electrode, at most: less than what makes it another grasp."""
STEP_COUNTS = 12.0
ASK_S = 0.05
FRESH_NS = 100_000_000
"""A verdict must not be older than this."""
SAME = 1e-6
"""Probabilities of the same counts: the same network ran twice."""


class Network:
    """The network, run directly."""

    def __init__(self) -> None:
        self._model = TactileModel(zoo.find(MODEL))

    def p_slip(self, counts: NDArray[np.generic]) -> float:
        """Of counts, shape (3, 24)."""
        self._model.inputs.build(counts, self._model.input)
        return self._model.run()[1]


@cache
def drift() -> NDArray[np.float64]:
    """Towards what the network calls slip, counts, shape (3, 24)."""
    grasp = synthetic_grasps(1, durations=HELD, seed=SEED)
    (timetable,) = grasp.timetables()
    settled = (moment.counts for moment in grasp if moment.t_s >= timetable.closed_s)
    base = np.median(list(itertools.islice(settled, HELD_SWEEPS, HELD_SWEEPS + 30)), axis=0)
    network, found = Network(), np.zeros(SHAPE)
    while network.p_slip(base + found) < 0.8 and np.abs(found).min() < DRIFT_COUNTS:
        for place in np.ndindex(SHAPE):
            one = np.zeros(SHAPE)
            one[place] = STEP_COUNTS
            up, down = (network.p_slip(base + found + step) for step in (one, -one))
            found[place] += STEP_COUNTS * np.sign(up - down)
        found = np.clip(found, -DRIFT_COUNTS, DRIFT_COUNTS)
    return found


def drifting() -> Iterator[Counts]:
    """Rest, a grasp that is held, drifts for some seconds, and stays there."""
    towards, held = drift(), 0
    grasp = synthetic_grasps(1, durations=HELD, seed=SEED)
    (timetable,) = grasp.timetables()
    for moment in grasp:
        held += timetable.closed_s <= moment.t_s < timetable.lift_s
        share = np.clip((held - HELD_SWEEPS) / DRIFT_SWEEPS, 0.0, 1.0)
        yield np.rint(moment.counts + share * towards).astype(np.uint16)


@dataclass
class Told:
    """What was told, against what the network says of the same readings."""

    network: Network = field(default_factory=Network)
    verdicts: int = 0
    valid: int = 0
    slips: int = 0
    false: int = 0
    """`stable` when the network has said slip of every reading for so long."""
    oldest_ns: int = 0
    """How long ago the network said last what was told as its word."""
    answers: int = 0
    late: int = 0
    """Answers with a `p_slip` that is not of the reading that they are about."""
    _fresh: FreshMedian = field(default_factory=lambda: FreshMedian(SHAPE))
    _said: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=2000))
    """Time of each reading, ns, and what the network says of its median."""

    def take_reading(self, tactile: Tactile) -> None:
        """Take in the counts of a reading."""
        self._fresh.push(np.array(tactile.counts, dtype=np.uint16), np.ones(SHAPE, dtype=np.bool_))
        self._said.append((tactile.t_mono_ns, self.network.p_slip(self._fresh.counts)))

    def take_verdict(self, verdict: Verdict) -> None:
        """Compare a verdict with what the network said of the readings until then."""
        self.verdicts += 1
        if verdict.p_slip is None:
            return
        self.valid += 1
        self.slips += verdict.verdict == "slip"
        now_ns = verdict.t_mono_ns
        recent = [p_slip for t_ns, p_slip in self._said if now_ns - FRESH_NS <= t_ns <= now_ns]
        self.false += verdict.verdict == "stable" and min(recent) >= 0.5
        self.oldest_ns = max(self.oldest_ns, self._age_ns(verdict))

    def take_answer(self, answer: Verdict) -> None:
        """Compare the answer to a question, whose reading has been taken in."""
        self.answers += 1
        self.late += answer.p_slip is not None and self._age_ns(answer) > 0

    def _age_ns(self, verdict: Verdict) -> int:
        if verdict.repaired:
            return 0  # what the network was given is not known here
        for t_ns, p_slip in reversed(self._said):
            if t_ns <= verdict.t_mono_ns and abs(p_slip - (verdict.p_slip_model or 0.0)) < SAME:
                return verdict.t_mono_ns - t_ns
        return verdict.t_mono_ns - self._said[0][0]


def drifts(plan: Plan) -> Outcome:
    """Ask all the while that a held grasp drifts to what the network calls slip."""
    told = Told()
    for folder in plan.folders():
        _drift_once(folder, told)
    happened = (
        f"{told.false:,} of {told.valid:,} verdicts `stable` after 100 ms of slip, {told.slips:,} "
        f"`slip`; oldest `p_slip` {told.oldest_ns / 1e6:.0f} ms; "
        f"{told.late:,} of {told.answers:,} answers not of the newest reading"
    )
    fresh = told.oldest_ns <= FRESH_NS and not told.late
    return Outcome(told.valid, happened, not told.false and fresh and told.slips > 0)


def _drift_once(folder: Path, told: Told) -> None:
    sections = (
        f'{spi_section(folder)}[model]\nname = "{MODEL}"\n[session]\nkeep = false\n'
        f'[gate]\nearly = true\n[ask]\nendpoint = "ipc://{folder}/ask"\n'
    )
    topics = ("verdict.", "tactile.")
    with (
        running(folder, sections, publish="tactile_hz = 10000\n", topics=topics) as (_, subscriber),
        zmq.Context() as context,
        context.socket(zmq.DEALER) as asker,
        SpiTwin(folder / "bridge", drifting()) as twin,
        at_work(lambda stop: twin.serve(stop.is_set)),
    ):
        asker.linger = 0
        asker.connect(f"ipc://{folder}/ask")
        _hear(subscriber, asker, twin, told)


def _hear(subscriber: Subscriber, asker: zmq.Socket[bytes], twin: SpiTwin, told: Told) -> None:
    ends_s, ask_s = time.monotonic() + PATIENCE_S, 0.0
    waiting: list[Verdict] = []
    newest_ns = 0
    last = HELD_SWEEPS + DRIFT_SWEEPS + 400  # with rest, closing, and a second at the end
    while twin.sweeps_made < last and time.monotonic() < ends_s:
        if time.monotonic() >= ask_s:
            ask_s = time.monotonic() + ASK_S
            asker.send(b"judge")
        while asker.poll(0):
            waiting.append(decode_verdict(asker.recv()))
        message = subscriber.take(ASK_S)
        if message is None:
            continue
        if message[0].startswith(b"tactile."):
            told.take_reading(tactile := decode_tactile(message[1]))
            newest_ns = tactile.t_mono_ns
        else:
            told.take_verdict(decode_verdict(message[1]))
        for answer in [each for each in waiting if each.t_mono_ns <= newest_ns]:
            told.take_answer(answer)
            waiting.remove(answer)
