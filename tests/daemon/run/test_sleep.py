"""After a sleep, which stops the monotonic clock, no earlier reading is judged."""

from __future__ import annotations

import pytest

from graspd.daemon.judge.reasons import Decision, Reason
from graspd.daemon.process.sleep import Sleep
from graspd.daemon.publish.messages import State
from graspd.daemon.run.loop import Ended
from tests.daemon.fakes import MS, Clock, FakeDriver, FakeModel, reading
from tests.kit.loops import LoopBench

HOUR_NS = 3600 * 1000 * MS


class Sleeper(FakeModel):
    """Model during whose third run the computer sleeps, which moves only the clock `boot`."""

    def __init__(self, boot: Clock) -> None:
        super().__init__()
        self.boot = boot

    def run(self) -> tuple[float, float]:
        if self.runs == 2:
            self.boot.now_ns += HOUR_NS
        return super().run()


def test_a_sleep_while_judging_makes_the_last_verdict_unknown() -> None:
    clock, boot = Clock(), Clock()
    driver = FakeDriver([reading(clock(), seed) for seed in range(9)], clock)
    bench = LoopBench(driver, clock, model=Sleeper(boot), sleep=Sleep(clock, boot))
    assert bench.run() is Ended.SLEPT
    *before, last = bench.verdicts
    assert [verdict.verdict for verdict in before] == [Decision.STABLE] * 2
    assert (last.verdict, last.reasons) == (Decision.UNKNOWN, [Reason.STALE])
    assert bench.statuses[-1].state is State.STOPPING


def test_a_sleep_before_the_first_reading_gives_only_unknown() -> None:
    clock, boot = Clock(), Clock()
    sleep = Sleep(clock, boot)
    boot.now_ns += HOUR_NS
    bench = LoopBench(FakeDriver([reading(clock())], clock), clock, sleep=sleep)
    assert bench.run() is Ended.SLEPT  # before it has read anything
    assert [verdict.verdict for verdict in bench.verdicts] == [Decision.UNKNOWN]


@pytest.mark.parametrize(("apart_ms", "slept"), [(0, False), (49, False), (-90, False), (51, True)])
def test_a_sleep_is_detected_by_clocks_over_50_ms_apart(apart_ms: int, slept: bool) -> None:
    clock, boot = Clock(), Clock(7 * HOUR_NS)
    sleep = Sleep(clock, boot)
    clock.now_ns += HOUR_NS
    boot.now_ns += HOUR_NS + apart_ms * MS
    assert sleep.has_slept() is slept
