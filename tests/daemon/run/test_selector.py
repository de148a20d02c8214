"""Waiting: for any descriptor, not too long, and not for one that was meant earlier."""

from __future__ import annotations

import os
import random
import resource
import selectors
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing

import pytest

from daemon.run.selector import ExactSelector

SELECT_MAX = 1024
"""Numbers of descriptors that select(2) knows."""
ROUNDS = 300


class Pipe:
    """Something to wait for."""

    def __init__(self) -> None:
        self.reads, self.writes = os.pipe()

    def close(self) -> None:
        os.close(self.reads)
        os.close(self.writes)


@pytest.fixture
def selector() -> Iterator[ExactSelector]:
    with closing(ExactSelector()) as made:
        yield made


@pytest.fixture
def pipe() -> Iterator[Pipe]:
    made = Pipe()
    yield made
    made.close()


def ready(selector: ExactSelector, timeout: float | None) -> list[int]:
    """Descriptors that are ready within that time, s."""
    return [fd for fd, events in selector.select(timeout) if events & selectors.EVENT_READ]


def late_ns(selector: ExactSelector, wait_ns: int) -> int:
    """How much longer than told a wait is in which nothing comes."""
    began_ns = time.monotonic_ns()
    assert selector.select(wait_ns / 1e9) == []
    return time.monotonic_ns() - began_ns - wait_ns


def test_a_deadline_at_odd_microseconds_is_met_and_never_early(selector: ExactSelector) -> None:
    """On a computer with other work most are late by that: what the timer can do, the best say."""
    rng = random.Random(1)
    found = sorted(
        late_ns(selector, rng.randrange(101_001, 1_900_001, 2000)) for _ in range(ROUNDS)
    )
    assert found[0] >= -1  # of the seconds' rounding
    assert found[ROUNDS // 20] < 200_000


@pytest.mark.parametrize("wait_s", [0.0, -1.0])
def test_without_time_left_it_only_looks(
    selector: ExactSelector, pipe: Pipe, wait_s: float
) -> None:
    selector.register(pipe.reads, selectors.EVENT_READ)
    assert ready(selector, wait_s) == []
    os.write(pipe.writes, b"x")
    assert ready(selector, wait_s) == [pipe.reads]


def test_a_wait_that_ended_early_neither_shortens_nor_lengthens_those_that_follow(
    selector: ExactSelector, pipe: Pipe
) -> None:
    selector.register(pipe.reads, selectors.EVENT_READ)
    for former_ns, wait_ns in ((3_000_000, 20_000_000), (60_000_000_000, 3_000_000)):
        os.write(pipe.writes, b"x")
        assert ready(selector, former_ns / 1e9) == [pipe.reads]
        os.read(pipe.reads, 1)
        assert 0 <= late_ns(selector, wait_ns) + 1 < 30_000_000_000


def test_a_timer_that_came_beside_something_else_is_not_taken_for_the_next(
    selector: ExactSelector, pipe: Pipe
) -> None:
    selector.register(pipe.reads, selectors.EVENT_READ)
    os.write(pipe.writes, b"x")
    assert ready(selector, 0.001) == [pipe.reads]
    time.sleep(0.002)
    assert ready(selector, 60.0) == [pipe.reads]
    os.read(pipe.reads, 1)
    assert late_ns(selector, 5_000_001) >= -1


def test_without_a_limit_it_waits_for_what_comes(selector: ExactSelector, pipe: Pipe) -> None:
    selector.register(pipe.reads, selectors.EVENT_READ)
    assert ready(selector, 0.001) == []
    writer = threading.Timer(0.05, os.write, (pipe.writes, b"x"))
    writer.start()
    assert ready(selector, None) == [pipe.reads]
    writer.join()


def test_descriptors_that_select_does_not_know_are_waited_for(selector: ExactSelector) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 2 * SELECT_MAX:
        pytest.skip(f"this process may have no more than {hard} descriptors")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 2 * SELECT_MAX), hard))
    with ExitStack() as stack:
        stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        pipes = []
        for _ in range(SELECT_MAX // 2 + 1):
            pipes.append(Pipe())
            stack.callback(pipes[-1].close)
            selector.register(pipes[-1].reads, selectors.EVENT_READ)
        highest = pipes[-1]
        assert highest.writes > SELECT_MAX
        assert ready(selector, 0.001) == []
        os.write(highest.writes, b"x")
        assert ready(selector, 60.0) == [highest.reads]
        for each in pipes:
            selector.unregister(each.reads)


def test_without_a_descriptor_for_the_timer_it_still_waits(pipe: Pipe) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    lowest_free = os.dup(pipe.reads)
    os.close(lowest_free)
    resource.setrlimit(resource.RLIMIT_NOFILE, (lowest_free, hard))
    try:
        with closing(ExactSelector()) as selector:
            selector.register(pipe.reads, selectors.EVENT_READ)
            assert late_ns(selector, 1_500_000) >= 0
            os.write(pipe.writes, b"x")
            assert ready(selector, None) == [pipe.reads]
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_what_was_closed_and_opened_again_by_the_same_number_is_waited_for(
    selector: ExactSelector, pipe: Pipe
) -> None:
    former, again = Pipe(), pipe
    selector.register(former.reads, selectors.EVENT_READ)
    assert ready(selector, 0.001) == []
    os.dup2(again.reads, former.reads)
    os.write(again.writes, b"x")
    assert ready(selector, 1.0) == [former.reads]
    former.close()
