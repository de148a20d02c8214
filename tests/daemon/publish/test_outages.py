"""A sensor or link lost in the middle of a grasp gives `unknown`, with the reason.

The daemon is a real process, the serial line and the sockets are real; only the hardware is a
twin. Lost joints are tested in the simulated days, a killed daemon in
tests/clients/test_against_daemon.py.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from graspd.daemon.judge.reasons import Decision, Reason
from graspd.daemon.publish.messages import Verdict
from graspd.drivers.twins.spi import SpiTwin
from tests.bench.attacks.doors import hand
from tests.bench.attacks.hang_ups import HANG_UPS, hang_up
from tests.bench.live import PATIENCE_S, Subscriber, held_grasp, running, spi_section
from tests.daemon.processes import before_others
from tests.threads import at_work

SENSOR_MAX, LINK_MAX = 2, 0
"""Most readings judged after a loss (README): the third without a sensor is `unknown`."""
CLOCK = 1
"""Readings before the outage that the mapping of the bridge's clock may put after it."""
AGE_MAX_MS = 100.0


class Twin(SpiTwin):
    """A twin of the SPI bridge that calls functions in the thread that serves it."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, held_grasp())
        self._deeds: queue.Queue[Callable[[], object]] = queue.Queue()

    def work(self, stop: threading.Event) -> None:
        """Serve until `stop` is set, and call the functions given to `do`."""

        def is_over() -> bool:
            while not self._deeds.empty():
                self._deeds.get()()
                self._deeds.task_done()
            return stop.is_set()

        self.serve(is_over)

    def do(self, deed: Callable[[], object]) -> None:
        """Have `deed` done in the other thread; return when it is done."""
        self._deeds.put(deed)
        self._deeds.join()


def is_valid(verdict: Verdict) -> bool:
    assert not verdict.valid or verdict.age_ms <= AGE_MAX_MS
    return verdict.valid


def until_unknown(subscriber: Subscriber, deed: Callable[[], object], reason: Reason) -> int:
    """Call `deed` while verdicts are valid, and wait until one is unknown for this reason.

    Return how many readings made after `deed` were judged. A busy computer that stands still makes
    verdicts unknown for another reason.
    """
    subscriber.drain()
    subscriber.wait_for(is_valid)
    deed()
    done_ns, judged = time.monotonic_ns(), set()

    def is_unknown(verdict: Verdict) -> bool:
        if is_valid(verdict) and verdict.t_mono_ns > done_ns:
            judged.add(verdict.t_mono_ns)
        return verdict.verdict is Decision.UNKNOWN and reason in verdict.reasons

    subscriber.wait_for(is_unknown)
    return len(judged)


def test_peers_that_hang_up_do_not_end_the_daemon(tmp_path: Path) -> None:
    with hand(tmp_path) as daemon:
        for door in daemon.doors:
            for says in HANG_UPS:
                hang_up(door, *says)
        daemon.friend.drain()
        assert daemon.friend.take(PATIENCE_S) is not None
        assert daemon.process.poll() is None


def test_a_lost_sensor_or_link_is_unknown_with_its_reason(tmp_path: Path) -> None:
    sections = spi_section(tmp_path) + '[model]\nname = "cnn1"\n'
    with (
        before_others(),
        Twin(tmp_path / "bridge") as twin,
        at_work(twin.work),
        running(tmp_path, sections) as (_, subscriber),
    ):
        pull = partial(twin.do, partial(twin.pull_fingers, 1))
        judged = until_unknown(subscriber, pull, Reason.SENSOR_MISSING)
        assert judged <= SENSOR_MAX + CLOCK
        twin.do(twin.pull_fingers)
        judged = until_unknown(subscriber, partial(twin.do, twin.unplug), Reason.STALE)
        assert judged <= LINK_MAX + CLOCK
        twin.do(twin.plug)
        subscriber.wait_for(is_valid)
