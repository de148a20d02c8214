"""A scene is prepared beside the loop, one at a time, and what is raised there ends nothing."""

from __future__ import annotations

import os
import select
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import cast

import pytest

from graspd.daemon.assembly.parts import Parts
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.run import reload
from graspd.daemon.run.reload import Reload, losses
from graspd.daemon.trust.lift_book import GraspId
from tests.daemon.judge.test_only_stable_if import HELD, Feel, limits, tared
from tests.kit.waiting import PATIENCE_S, wait_until

PARTS = cast(Parts, object())


class Preparing:
    """Ends each preparation when it is told to, with what it is told to."""

    def __init__(self) -> None:
        self.began: list[int] = []
        """Threads of the preparations."""
        self.go = threading.Semaphore(0)
        self.ends: Callable[[], Parts] = lambda: PARTS
        self.told = 0

    def tell(self) -> None:
        self.told += 1

    def prepare(self) -> Parts:
        self.began.append(threading.get_native_id())
        assert self.go.acquire(timeout=PATIENCE_S)
        return self.ends()


@contextmanager
def reloading() -> Iterator[tuple[Reload, Preparing]]:
    preparing = Preparing()
    with StopSignal(reloads=True) as stop:
        found = Reload(stop, preparing.prepare, preparing.tell)
        try:
            yield found, preparing
        finally:
            preparing.go.release(100)
            found.close()


def hang_up() -> None:
    os.kill(os.getpid(), signal.SIGHUP)


@pytest.fixture(autouse=True)
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reload, "PERIOD_NS", 50_000_000)


def test_the_loop_goes_on_until_there_is_what_to_run() -> None:
    with reloading() as (found, preparing):
        assert not found.take_reload()
        assert found.filenos() == []
        hang_up()
        assert not found.take_reload()
        wait_until(lambda: len(preparing.began) == 1)
        assert preparing.began != [threading.get_native_id()]
        assert preparing.told == 1
        for _ in range(100):
            assert not found.take_reload()
        preparing.go.release()
        readable, _, _ = select.select([found.fileno(), *found.filenos()], [], [], PATIENCE_S)
        assert readable == found.filenos()
        assert found.take_reload()
        assert found.take() is PARTS
        assert found.filenos() == []
        assert not found.take_reload()


def test_whatever_is_raised_is_handed_over() -> None:
    error = MemoryError()

    def fail() -> Parts:
        raise error

    with reloading() as (found, preparing):
        preparing.ends = fail
        preparing.go.release()
        hang_up()
        wait_until(found.take_reload)
        assert found.take() is error
        preparing.ends = lambda: PARTS
        preparing.go.release()
        hang_up()
        wait_until(found.take_reload)
        assert found.take() is PARTS


def test_a_storm_prepares_one_scene_and_one_more() -> None:
    with reloading() as (found, preparing):
        hang_up()
        found.take_reload()
        wait_until(lambda: len(preparing.began) == 1)
        for _ in range(500):
            hang_up()
            assert not found.take_reload()
        preparing.go.release()
        wait_until(found.take_reload)
        found.take()
        preparing.go.release()
        wait_until(found.take_reload)  # what came in between is not forgotten
        found.take()
        time.sleep(0.1)
        assert not found.take_reload()
        assert len(preparing.began) == preparing.told == 2


def test_the_loop_is_woken_for_the_next_preparation_only_where_one_is_requested(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reload, "PERIOD_NS", 60_000_000_000)
    with reloading() as (found, preparing):
        assert found.due_ns() is None
        preparing.go.release()
        began_ns = time.monotonic_ns()
        hang_up()
        wait_until(found.take_reload)
        found.take()
        assert found.due_ns() is None
        hang_up()
        assert not found.take_reload()
        due_ns = found.due_ns()
        assert due_ns is not None
        assert due_ns - began_ns >= 60_000_000_000
        assert not found.take_reload()
        assert len(preparing.began) == 1


def test_losses_name_outcomes_without_a_file_and_the_held_grasp() -> None:
    hand = tared(limits())
    hand.play(HELD)
    assert list(losses(hand.pipeline, kept=True)) == [
        "grasp 1 was held: release it, because the hand must be tared again"
    ]
    hand.pipeline.outcome(GraspId("", 1), slipped=True)
    forgotten = next(losses(hand.pipeline, kept=False))
    assert forgotten.startswith("1 told outcomes and a session of 0 grasps are forgotten: ")
    hand.play(Feel("rest", times=40))
    assert list(losses(hand.pipeline, kept=False)) == [forgotten]
    assert list(losses(hand.pipeline, kept=True)) == []
