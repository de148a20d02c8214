"""A hand with readings that a test draws; each verdict is checked against what it needs.

`Necessity` says what it needs. Where the judge remembers more, its bounds are loose but true.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from graspd.biotac import Finger
from graspd.daemon.judge.decision import GateLimits, HandLimits, Limits
from graspd.daemon.judge.pipeline import Judgement, Pipeline
from graspd.daemon.judge.reasons import Decision
from graspd.drivers.base import JointReading, TactileReading
from tests.daemon.fakes import FINGERS, MS, Clock, FakeModel, pipeline
from tests.daemon.judge.necessity import EARLY_MS, MOVED_COUNTS, STILL_MS, Necessity

Counts = NDArray[np.uint16]
PERIOD_NS = 10 * MS
NOISE = 2
"""Largest noise of a count, which is drawn uniformly: standard deviation 1.4."""
QUIET_READINGS = 130
JOINTS = ("FFJ3", "MFJ3", "THJ5")
STILL_RAD = 0.5
AHEAD_NS = 300 * MS
STANDS_MS = 100
"""Largest age of the network's answer in a verdict, ms."""
STEADY_MS = 1000
"""Shortest time without a slip before a grasp that was called slip may be `stable`, ms."""
TURN_RAD = 0.01
"""Turn of a moving joint per reading, rad: at 100 Hz ten times the limit of a still joint."""


def _poses() -> dict[str, NDArray[np.int64]]:
    """Return counts without noise, shape (3, 24), by name; the fake model has seen such."""
    random = np.random.default_rng(5)
    rest = random.integers(2000, 3000, (3, 24))
    grasp, other, light, faint, two = (rest.copy() for _ in range(5))
    for finger in range(3):
        places = random.permutation(24)
        grasp[finger, places[:8]] -= random.integers(150, 600, 8)
        other[finger, places[4:12]] -= random.integers(150, 600, 8)
        light[finger, places[:8]] -= 15  # no touch, and too deep to let go
        faint[finger, places[:8]] -= 40  # a touch that ends without a large change
    two[:2] = grasp[:2]
    return {
        "grasp": grasp,
        "rest": rest,
        "other": other,
        "light": light,
        "faint": faint,
        "two": two,
        "lifted": grasp - 30,
    }


POSES = _poses()


@dataclass(frozen=True, slots=True)
class Flaw:
    """A fault of `number` electrodes of a finger, from `first` on: bits, a wrong count, or both."""

    finger: int
    first: int
    number: int
    bits: int
    count: int | None
    """Their count; None: the one that they have without a flaw."""


@dataclass(frozen=True, slots=True)
class Feel:
    """Readings of one kind, one after the other."""

    pose: str = "grasp"
    times: int = 1
    step_ns: int = PERIOD_NS
    """Step of the daemon's clock before each reading, ns."""
    age_ns: int = 0
    """Age of the first reading, ns."""
    lag_ns: int = 0
    """Time by which each reading is older than the one before, ns."""
    repeats: bool = False
    """True if all readings have the counts of the first."""
    flaws: tuple[Flaw, ...] = ()
    joints: str = "still"
    answer: float | None = 0.1
    """Answer of the network; None: it fails."""
    asks: bool = False
    """Whether the controller asks once before the first reading."""


class Hand:
    """A pipeline, and the conditions that each of its verdicts must meet."""

    def __init__(
        self,
        gate: HandLimits,
        build: Callable[[FakeModel, Clock], Pipeline] | None = None,
        limits: Limits = Limits(),  # noqa: B008 (frozen)
        moved_counts: float = MOVED_COUNTS,
    ) -> None:
        """`build` makes the pipeline, with the same `gate` and `limits`; None: `fakes.pipeline`.
        `moved_counts`: mean change of a finger's counts that is certainly motion."""
        self.model, self.clock, self.limits = FakeModel(), Clock(), limits
        self.pipeline = (
            pipeline(self.model, self.clock, hand=gate)
            if build is None
            else build(self.model, self.clock)
        )
        still_ms, required = EARLY_MS if gate.gate.early else STILL_MS, gate.required or FINGERS
        self.necessity = Necessity(
            POSES["rest"], FINGERS, required, still_ms, moved_counts=moved_counts
        )
        self.answer: float | None = None
        """Last answer of the network; `answered_ns`: time of the reading that it judged, ns."""
        self.answered_ns = 0
        self.slip = 0, 0
        """Number of the grasp that the network last called slip, and time of the reading, ns."""
        self.judged = 0
        self.asked = 0
        self.random = np.random.default_rng(1)
        self.turned_rad = 0.0
        self.noise_rad = np.zeros(len(JOINTS))
        self.sent: deque[Counts] = deque(maxlen=30)

    def play(self, feel: Feel) -> list[Judgement]:
        """Judge the readings of `feel`; check each judgement, and return them."""
        self.model.answer = RuntimeError("no session") if feel.answer is None else feel.answer
        first: Counts | None = None
        said = []
        if feel.asks:
            self.pipeline.ask()
            self.asked += 1
        for number in range(feel.times):
            self.clock.now_ns += feel.step_ns
            self._turn(feel.joints)
            reading = self._reading(feel, first, feel.age_ns + number * feel.lag_ns)
            first = reading.counts if feel.repeats else None
            said.append(self._judge(reading, feel.answer))
        return said

    def _judge(self, reading: TactileReading, answer: float | None) -> Judgement:
        runs = self.model.runs
        self.necessity.observe(reading)
        judgement = self.pipeline.judge(reading)
        if self.model.runs != runs:
            self.answer, self.answered_ns = answer, reading.t_ns
            if answer is not None and self.limits.slip_threshold <= answer <= 1.0:
                self.slip = judgement.moment.grasp, reading.t_ns
        self.judged += judgement.moment.judged
        unknown = judgement.decision is Decision.UNKNOWN
        assert unknown is bool(judgement.reasons)
        assert unknown is (judgement.p_slip is None)
        if not unknown:
            p_slip = self.answer
            assert p_slip is not None
            assert 0.0 <= p_slip <= 1.0
            assert judgement.p_slip == p_slip
            assert 0 <= reading.t_ns - self.answered_ns <= STANDS_MS * MS
            grasp, slip_ns = self.slip
            doubted = grasp == judgement.moment.grasp and reading.t_ns - slip_ns < STEADY_MS * MS
            slips = p_slip >= self.limits.slip_threshold or doubted
            assert (judgement.decision is Decision.SLIP) is slips
            assert 0 <= self.clock() - reading.t_ns <= self.limits.max_age_ns
            assert not self.necessity.lacks(), self.necessity.lacks()
        return judgement

    def _reading(self, feel: Feel, first: Counts | None, age_ns: int) -> TactileReading:
        faults = np.zeros((3, 24), dtype=np.uint8)
        counts = self._counts(feel.pose) if first is None else first
        if len(counts) == len(faults) and first is None:
            for flaw in feel.flaws:
                where = flaw.finger, slice(flaw.first, flaw.first + flaw.number)
                if flaw.count is not None:
                    counts[where] = flaw.count
        for flaw in feel.flaws:
            faults[flaw.finger, flaw.first : flaw.first + flaw.number] |= flaw.bits
        if len(counts) == len(faults):
            self.sent.append(counts)
        return TactileReading(self.clock() - age_ns, 0, counts, faults[: len(counts)])

    def _counts(self, pose: str) -> Counts:
        if pose == "wild":
            return self.random.integers(0, 65536, (3, 24), dtype=np.uint16)
        if pose == "any":
            return self.random.integers(1000, 3000, (3, 24), dtype=np.uint16)
        if pose == "other fingers":
            return self.random.integers(1000, 3000, (2, 24), dtype=np.uint16)
        if pose == "old":
            return self.sent[int(self.random.integers(len(self.sent)))].copy()
        noise = self.random.integers(-NOISE, NOISE + 1, (3, 24))
        return (POSES[pose] + noise).astype(np.uint16)

    def _turn(self, kind: str) -> None:
        if kind == "none":
            return
        self.turned_rad += TURN_RAD * (kind == "moving")
        if kind != "frozen":
            self.noise_rad = self.random.uniform(-0.0005, 0.0005, len(JOINTS))
        angles = STILL_RAD + self.turned_rad + self.noise_rad
        if kind == "not valid":
            angles[:] = np.nan
        elif kind == "one not valid":
            angles[1] = np.nan
        t_ns = self.clock() + AHEAD_NS * (kind == "ahead")
        reading = JointReading(t_ns, 0, JOINTS, angles)
        self.necessity.observe_joints(reading)
        self.pipeline.observe_joints(reading)


def limits(
    *,
    on_request: bool = False,
    required: tuple[Finger, ...] = FINGERS,
    early: bool = False,
) -> HandLimits:
    """Return limits of a hand with joints, whose effects `Necessity` knows."""
    return HandLimits(
        on_request=on_request, required=required, gate=GateLimits(early=early), joints=True
    )


@cache
def _tared(gate: HandLimits) -> Hand:
    hand = Hand(gate)
    hand.play(Feel("rest", times=QUIET_READINGS))
    return hand


def tared(gate: HandLimits) -> Hand:
    """Return a new copy of a hand that has rested until it was tared."""
    hand = _tared(gate)
    contract = hand.model.contract  # large, and never changed
    return copy.deepcopy(hand, {id(contract): contract})


def often(usual: object, *others: object, times: int = 9) -> st.SearchStrategy[object]:
    """Draw the usual value `times` as often as all others together."""
    return st.sampled_from([usual] * (times * len(others)) + [*others])


flaws = st.builds(
    Flaw,
    finger=st.integers(0, 2),
    first=st.integers(0, 23),
    number=st.sampled_from([1, 1, 2, 4, 8, 9, 24]),
    bits=st.sampled_from([0, 1, 2, 4, 8, 1, 2, 4, 8, 16, 32, 64, 128]),
    count=st.sampled_from([None, 0, 4095, 65535, 1234]),
)
few_everywhere = st.builds(
    lambda number, first: tuple(Flaw(finger, first, number, 1, 0) for finger in range(3)),
    st.integers(1, 6),
    st.integers(0, 18),
)
"""One to six missing electrodes in each finger: five are too many for a hand, not for a finger."""
feels = st.builds(
    Feel,
    pose=often(
        "grasp",
        "rest",
        "other",
        "light",
        "faint",
        "two",
        "lifted",
        "wild",
        "any",
        "other fingers",
        "old",
    ),
    times=st.sampled_from([1, 3, 10, 20, 30]),
    step_ns=often(PERIOD_NS, 0, MS, 14 * MS, 50 * MS, 3000 * MS, -PERIOD_NS, -1000 * MS),
    lag_ns=often(0, 5 * MS, PERIOD_NS, times=5),
    age_ns=often(0, 60 * MS, 100 * MS, 101 * MS, 10_000 * MS, -1),
    repeats=often(False, True, times=9),
    flaws=st.one_of(
        st.just(()), st.just(()), st.lists(flaws, max_size=2).map(tuple), few_everywhere
    ),
    joints=often("still", "moving", "none", "not valid", "one not valid", "ahead", "frozen"),
    answer=st.one_of(st.sampled_from([0.1, 0.9, 0.4999, 0.5]), st.floats(), st.none()),
    asks=often(False, True, times=3),
)
HELD = Feel(times=35, asks=True)
BEGINS = {
    "two fingers of three": (Feel("two", times=40),),
    "let go without a large change": (Feel("faint", times=35), Feel("rest", times=20)),
    "old readings": (HELD, Feel(times=20, lag_ns=PERIOD_NS)),
    "joints late, then lost": (HELD, Feel(times=90, joints="none")),
    "joints away and back": (
        HELD,
        Feel(times=30, joints="none"),
        Feel(times=10, joints="moving"),
        Feel(times=10),
    ),
    "joints of a later time": (HELD, Feel(times=10, joints="ahead"), Feel(times=10)),
    "joints that move": (HELD, Feel(times=10, joints="moving"), Feel(times=20)),
    "joints that do not change by a bit": (
        HELD,
        Feel(times=160, joints="frozen"),
        Feel(times=10),
    ),
    "old sweeps, a few at a time": (HELD, Feel(pose="old", times=40), Feel(times=40)),
    "many at once": (
        Feel("faint", times=35, asks=True),
        Feel("grasp", times=40, step_ns=0, asks=True),
        Feel(times=35, asks=True),
    ),
    "asked once": (HELD, Feel("other", times=40), Feel("grasp", times=40)),
    "held": (HELD,),
    "held lightly": (Feel("faint", times=35, asks=True),),
    "called slip": (Feel(times=35, asks=True, answer=0.9),),
    "at rest": (),
}
"""Readings with which a hand begins, by name."""

begins = st.sampled_from([*BEGINS.values()])
gates = st.builds(
    limits,
    on_request=st.booleans(),
    required=st.sampled_from([FINGERS, ("ff", "th")]),
    early=st.booleans(),
)
