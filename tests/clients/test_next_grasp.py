"""Waiting for the next grasp that is surely judged."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.clients.messages import MS, TEACHES, frames, supervised, verdict
from tests.clients.probe import Probe
from tests.clients.test_both_ask import false_daemon, told
from tests.clients.test_lift import START_NS, World, client

TAKEN = b'{"v":1,"ok":true}'


def world(*messages: tuple[str, dict[str, Any]]) -> World:
    """One message every 10 ms, with its verdict and what else differs."""
    coming = []
    for seq, (outcome, more) in enumerate(messages):
        at_ns = START_NS + seq * 10 * MS
        coming.append((at_ns, frames(verdict(seq, at_ns - MS, outcome, **more))))
    return World(coming, acknowledged=[(MS, TAKEN)] * 9)


def test_each_grasp_is_returned_once_as_soon_as_it_is_judged() -> None:
    first, second = {"grasp": 1}, {"grasp": 2}
    coming = world(
        *[("unknown", first)] * 3,
        *[("stable", first)] * 3,
        *[("unknown", second)] * 3,
        *[("slip", second)] * 3,
    )
    with client(coming) as graspd:
        stable, slip = graspd.wait_for_grasp(1.0), graspd.wait_for_grasp(1.0)
        assert stable is not None
        assert slip is not None
        assert (stable.decision, stable.grasp, stable.seq) == ("stable", 1, 3)
        assert (slip.decision, slip.grasp, slip.seq) == ("slip", 2, 9)
        assert graspd.wait_for_grasp(1.0) is None


def test_a_grasp_that_is_judged_already_is_returned_at_once() -> None:
    with client(world(("stable", {}))) as graspd:
        assert graspd.verdict()
        assert graspd.wait_for_grasp(0.0)
        assert graspd.wait_for_grasp(0.0) is None


@pytest.mark.parametrize(
    ("outcome", "more", "watch"),
    [("stable", {}, False), ("slip", {}, False), ("unknown", TEACHES, True)],
    ids=["stable", "slip", "supervised"],
)
def test_what_is_early_is_not_sure(outcome: str, more: dict[str, Any], watch: bool) -> None:
    early = (outcome, more | {"early": True})
    with client(world(*[early] * 3, (outcome, more | {"early": False}))) as graspd:
        found = graspd.wait_for_grasp(1.0, supervised=watch)
        assert found is not None
        assert found.seq == 3


@pytest.mark.parametrize("watch", [False, True])
def test_what_is_to_be_watched_is_returned_where_a_person_watches(watch: bool) -> None:
    coming = World([(START_NS, frames(supervised(0, START_NS - MS)))])
    with client(coming) as graspd:
        found = graspd.wait_for_grasp(0.05, supervised=watch)
        assert (found is not None and found.supervised) is watch


def test_a_grasp_that_was_told_is_not_returned() -> None:
    with client(world(*[("stable", {})] * 5), ask=True) as graspd:
        answered = graspd.verdict(0.1)
        assert graspd.tell(answered, "held")
        assert graspd.wait_for_grasp(0.1) is None


def test_a_closed_client_waits_for_nothing() -> None:
    coming = world(("stable", {}))
    with client(coming) as graspd:
        graspd.close()
        began_ns = coming.now_ns
        assert graspd.wait_for_grasp(1.0) is None
        assert coming.now_ns - began_ns < MS


def test_in_cpp_each_grasp_is_returned_once(probe: Probe, tmp_path: Path) -> None:
    with false_daemon(tmp_path, told(), messages_each=10):
        probe.tell("client", f"ipc://{tmp_path}/out")
        grasps = [int(probe.ask("wait 30 0")) for _ in range(5)]
    assert len(set(grasps)) == 5
    assert grasps == sorted(grasps)
    assert grasps[0] > 0


@pytest.mark.parametrize(
    ("more", "watch", "expected"),
    [
        ({"early": True}, 0, "-1"),
        ({"early": False}, 0, "1"),
        ({"supervised": True}, 0, "1"),
        ({"supervised": True, "early": True}, 1, "-1"),
    ],
)
def test_in_cpp_what_is_early_is_not_sure(
    probe: Probe, tmp_path: Path, more: dict[str, Any], watch: int, expected: str
) -> None:
    with false_daemon(tmp_path, told(), **more):
        probe.tell("client", f"ipc://{tmp_path}/out")
        assert probe.ask("wait", 0.3 if expected == "-1" else 30, watch) == expected
