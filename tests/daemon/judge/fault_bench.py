"""A hand that plays a whole grasp soundly until it is judged, and under a fault from there."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from graspd.daemon.judge.decision import HandLimits, Limits
from graspd.daemon.judge.pipeline import Judgement, Pipeline
from graspd.daemon.judge.reasons import Decision, GateState, Reason
from graspd.drivers.base import JointReading, TactileReading
from graspd.drivers.twins.grasps.grasp_script import Durations
from graspd.drivers.twins.grasps.whole_grasps import synthetic_grasps
from graspd.models import zoo
from graspd.models.runtime import TactileModel
from tests.daemon.fakes import FINGERS, MS, Clock

START_NS = 10**12
MAX_AGE_NS = 100 * MS
DURATIONS = Durations(
    first_rest_s=(3.0, 3.0), close_s=(0.7, 0.7), settle_s=(1.2, 1.2), rest_s=(1.0, 1.0)
)
"""Each state of the gate, but `released`, lasts longer than the readings under fault."""


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """What comes when the daemon's own clock shows `now_ns`; None is nothing."""

    now_ns: int
    tactile: TactileReading | None
    joints: JointReading | None


Fault = Callable[[Sequence[Step]], list[Step]]
"""From sound steps, the first of which is the last one before the fault, to what comes after it."""


@dataclass(frozen=True, slots=True)
class Finding:
    """What is said under a fault, and without it."""

    decision: Decision
    reasons: tuple[Reason, ...]
    sound: Judgement
    """Of the last sound reading by then."""


@dataclass(frozen=True, slots=True, eq=False)
class _Hand:
    pipeline: Pipeline
    clock: Clock
    silence_ns: int

    def copy(self) -> _Hand:
        """Another one that goes on from here; the network is the same."""
        shared = {id(network()): network()}
        return _Hand(*copy.deepcopy((self.pipeline, self.clock), shared), self.silence_ns)

    def play(self, steps: Sequence[Step]) -> Iterator[tuple[Step, Judgement]]:
        """Judge what comes after the first step, as the service does."""
        last_ns, due_ns = steps[0].now_ns, steps[0].now_ns + self.silence_ns
        for step in steps[1:]:
            self.clock.now_ns = step.now_ns
            if step.joints is not None:
                self.pipeline.observe_joints(step.joints)
            if step.tactile is not None:
                last_ns, due_ns = step.tactile.t_ns, step.now_ns + self.silence_ns
                yield step, self.pipeline.judge(step.tactile)
            elif step.now_ns >= due_ns:
                due_ns = step.now_ns + self.silence_ns
                yield step, self.pipeline.silence(last_ns)


class Grasp:
    """One whole grasp, what is said of it, and what is said of it under faults."""

    def __init__(self, rate_hz: float, durations: Durations = DURATIONS) -> None:
        self._period_ns = round(1e9 / rate_hz)
        self._steps = self._sound_steps(rate_hz, durations)
        clock = Clock(START_NS)
        pipeline = Pipeline(
            network(), FINGERS, Limits(MAX_AGE_NS), clock, hand=HandLimits(joints=True)
        )
        # A daemon tells of silence after ten periods, and not before the age limit.
        hand = _Hand(pipeline, clock, max(MAX_AGE_NS, 10 * self._period_ns))
        self._sound: list[Judgement] = []
        self._at = 0
        """Number of the first step that finds the grasp judged."""
        for _, judgement in hand.play(self._steps):
            self._sound.append(judgement)
            if judgement.moment.state is GateState.JUDGED and not self._at:
                self._at, self._judged = len(self._sound), hand.copy()

    def under(self, fault: Fault, periods: int) -> list[Finding]:
        """What is said in so many periods after the grasp was judged."""
        sound = self._steps[self._at : self._at + periods + 1]
        return [
            Finding(judgement.decision, judgement.reasons, self._judgement_at(step.now_ns))
            for step, judgement in self._judged.copy().play([sound[0], *fault(sound)])
        ]

    def _judgement_at(self, now_ns: int) -> Judgement:
        number = (now_ns - START_NS) // self._period_ns
        return self._sound[min(number, len(self._sound)) - 1]

    def _sound_steps(self, rate_hz: float, durations: Durations) -> list[Step]:
        steps = []
        for number, moment in enumerate(
            synthetic_grasps(1, rate_hz=rate_hz, durations=durations, seed=0)
        ):
            t_ns = START_NS + number * self._period_ns
            faults = np.zeros(moment.counts.shape, dtype=np.uint8)
            tactile = TactileReading(t_ns, number, moment.counts, faults)
            joints = JointReading(t_ns, number, moment.joint_names, moment.position_rad)
            steps.append(Step(t_ns, tactile, joints))
        return steps


@cache
def network() -> TactileModel:
    """A real one, by which counts that are like those of no grasp are refused."""
    return TactileModel(zoo.find("cnn1"))
