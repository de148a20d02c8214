"""From datagrams to a verdict: no network and no sender makes old counts `stable`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

from hypothesis import given, settings

from graspd.daemon.judge.reasons import Decision
from graspd.drivers.datagrams.tactile import TactileStream
from graspd.drivers.twins.grasps.whole_grasps import RATE_HZ
from tests.daemon.judge.fault_bench import MAX_AGE_NS, Grasp, Step
from tests.drivers.datagrams.network import FINGERS, HERE, PERIOD_NS, Plan, arrivals, links

CLOCK_NS = 10_000_000
"""Error of a sender's clock that is not seen in ten seconds, ns."""


@cache
def grasp() -> Grasp:
    return Grasp(RATE_HZ)


@settings(max_examples=60, deadline=None)
@given(links())
def test_no_stable_rests_on_counts_older_than_the_limit(plan: Plan) -> None:
    ages_ns: list[int] = []

    def spoil(sound: Sequence[Step]) -> list[Step]:
        sweeps = [step.tactile.counts.tolist() for step in sound if step.tactile is not None]
        stream, start_ns, steps = TactileStream(FINGERS, "right"), sound[0].now_ns, list[Step]()
        for received_ns, datagram, place in arrivals(plan[: len(sweeps)], lambda at: sweeps[at]):
            if datagram.sender != HERE:
                continue  # the driver's socket drops it
            joints = sound[min(received_ns // PERIOD_NS, len(sound) - 1)].joints
            for reading in stream.receive(datagram.data, start_ns + received_ns) or ():
                if place:  # the first was judged before
                    steps.append(Step(start_ns + received_ns, reading, joints))
                    ages_ns.append(received_ns - place * PERIOD_NS)
        return steps

    found = grasp().under(spoil, len(plan))
    for finding, age_ns in zip(found, ages_ns, strict=True):
        assert finding.decision is not Decision.STABLE or age_ns <= MAX_AGE_NS + CLOCK_NS
