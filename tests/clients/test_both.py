"""Both clients ask a stand-in daemon with right and wrong answers: only right ones allow a lift."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import zmq

from tests.clients.either import Connect
from tests.clients.false_daemon import Answer, false_daemon, of, told
from tests.clients.messages import TEACHES
from tests.kit.waiting import wait_until
from tests.ports import free_ipv6_endpoint

LONG_S, DEADLINE_S = 100.0, 0.3
"""Deadlines of a lift that is allowed in the end, and of one that never is, s."""
UNKNOWN, SLIP = {"outcome": "unknown"}, {"outcome": "slip"}
WATCHED = UNKNOWN | TEACHES
"""Fields of a verdict published in the warm-up."""
UNSAID: dict[str, Any] = {"verdict": "unknown", "verdict_code": 0, "valid": False, "p_slip": None}
"""Fields that make a `stable` message unknown."""
WATCHES, STILL = {"supervised": True}, {"still_ms": 240.0}
"""Arguments of `lift`: supervision by a person, stillness."""
RESTARTS = {"boot_id": lambda heard: "b" if heard else "a"}
"""The daemon is restarted at the first question."""
NO_RISK = {"target": 0.05, "lifts": 1, "slips": 0}
Fields = dict[str, Any]
Case = tuple[Fields, Answer | None, Fields, str]
"""Changes to a published `stable`, the daemon's answer (None: not asked), arguments of `lift`, and
the decision expected, or `supervised`."""


def restarted(lost: Answer) -> Answer:
    """Answer right from start `b` on, and `lost` before."""
    return lambda published: (lost if published["boot_id"] == "a" else told())(published)


ANSWERS: dict[str, Case] = {
    "the same": ({}, told(), {}, "stable"),
    "with a later field": ({}, told(later="field"), {}, "stable"),
    "slip": ({}, of("slip"), {}, "slip"),
    "unknown": ({}, of("unknown"), {}, "unknown"),
    "of another grasp": ({}, told(grasp=2), {}, "unknown"),
    "of another start": ({}, told(boot_id="b"), {}, "unknown"),
    "to come": ({}, told(seq=10**6), {}, "unknown"),
    "to come, then a restart": (RESTARTS, restarted(told(seq=10**6)), {}, "stable"),
    "lost in a restart": (RESTARTS, restarted(lambda _: []), {}, "stable"),
    "without sense": ({}, told(p_slip=None), {}, "unknown"),
    "not JSON": ({}, lambda _: [b"stable"], {}, "unknown"),
    "empty": ({}, lambda _: [b""], {}, "unknown"),
    "of two frames": ({}, lambda published: told()(published) * 2, {}, "unknown"),
    "alone, to unknown": (UNKNOWN, of("stable"), {}, "unknown"),
    "alone, to slip": (SLIP, of("stable"), {}, "unknown"),
}
SUPERVISED: dict[str, Case] = {
    "supervised": (WATCHED, told(), WATCHES, "supervised"),
    "supervised, not asked for": (WATCHED, told(), {}, "unknown"),
    "supervised, and nothing is asked": (WATCHED, None, WATCHES, "supervised"),
    "stable and supervised": ({"supervised": True}, None, WATCHES, "supervised"),
    "slip and supervised": (SLIP | {"supervised": True}, None, WATCHES, "supervised"),
    "answer not supervised": (WATCHED, told(supervised=False), WATCHES, "unknown"),
    "answer of another grasp": (WATCHED, told(grasp=2), WATCHES, "unknown"),
    "moving too": (WATCHED, told(reasons=["unproven", "moving"]), WATCHES, "unknown"),
    "of a later version": (WATCHED, told(v=2), WATCHES, "unknown"),
    "a number": (WATCHED, told(supervised=1), WATCHES, "unknown"),
    "without a risk's bound": (WATCHED, told(risk=NO_RISK), WATCHES, "unknown"),
    "answer stable": (WATCHED, of("stable"), WATCHES, "unknown"),
    "early answer": (WATCHED, told(early=True), WATCHES, "unknown"),
    "early": (WATCHED | {"early": True}, None, WATCHES, "unknown"),
}
STILL_FOR: dict[str, Case] = {
    "for long": ({"still_ms": 1000}, None, STILL, "stable"),
    "for just long enough": ({"still_ms": 240.0}, None, STILL, "stable"),
    "for a moment less": ({"still_ms": 239.999999}, None, STILL, "unknown"),
    "early for who waits": ({"still_ms": 130.0, "early": True}, None, STILL, "unknown"),
    "early for who does not": ({"still_ms": 130.0, "early": True}, None, {}, "stable"),
    "not known": ({"still_ms": None}, None, STILL, "unknown"),
    "not told": ({}, None, STILL, "unknown"),
    "no number": ({"still_ms": float("nan")}, None, {}, "unknown"),
    "true": ({"still_ms": True}, None, {}, "unknown"),
    "both": ({"still_ms": 250.0}, told(), STILL, "stable"),
    "the answer alone": ({"still_ms": 130.0}, told(still_ms=250.0), STILL, "unknown"),
    "the newest alone": ({"still_ms": 250.0}, told(still_ms=130.0), STILL, "unknown"),
    "not in the answer": ({"still_ms": 250.0}, told(still_ms=None), STILL, "unknown"),
}
CASES = ANSWERS | SUPERVISED | STILL_FOR


@pytest.mark.parametrize(("published", "answer", "wants", "word"), CASES.values(), ids=CASES)
def test_only_a_fitting_verdict_and_answer_allow_a_lift(
    connect: Connect,
    tmp_path: Path,
    published: Fields,
    answer: Answer | None,
    wants: Fields,
    word: str,
) -> None:
    deadline_s = DEADLINE_S if word == "unknown" else LONG_S
    with false_daemon(tmp_path, answer, **published):
        said = connect(tmp_path, None if answer is None else "ask").lift(deadline_s, **wants)
    assert (said.word, said.may) == (word, word in ("stable", "supervised"))


@pytest.mark.parametrize(
    ("published", "ask", "wants", "reasons"),
    [
        (WATCHED | {"early": True}, None, WATCHES, ["not-still"]),
        ({"still_ms": 239.9}, None, STILL, ["not-still"]),
        ({"still_ms": None}, None, STILL, ["not-still"]),
        (UNKNOWN | {"reasons": ["moving"]}, "ask", {}, ["moving"]),
        (UNKNOWN | {"reasons": ["moving"]}, "nobody", {}, ["moving", "no-answer"]),
        (UNKNOWN | {"reasons": ["moving"]}, "out", {}, ["moving", "no-answer"]),  # turned away
        (
            UNKNOWN | {"reasons": ["settling", "joints-late"]},
            "ask",
            {},
            ["settling", "joints-late"],
        ),
    ],
)
def test_a_refused_lift_has_its_reasons(
    connect: Connect,
    tmp_path: Path,
    published: Fields,
    ask: str | None,
    wants: Fields,
    reasons: list[str],
) -> None:
    """Asks until these reasons come, as on a busy machine a message may be too old first."""
    with false_daemon(tmp_path, **published):
        graspd = connect(tmp_path, ask)
        wait_until(lambda: graspd.lift(DEADLINE_S, **wants).reasons == tuple(reasons))


@pytest.mark.parametrize(
    ("published", "change", "wants", "reasons", "owner"),
    [
        ({}, UNSAID | {"reasons": ["not-kept"]}, {}, ["not-kept"], None),
        ({}, UNSAID | {"reasons": ["not-kept"], "grasp": 2}, {}, ["no-answer"], None),
        ({}, UNSAID | {"reasons": ["not-kept"], "boot_id": "b"}, {}, ["no-answer"], None),
        (WATCHED, {"supervised": False, "owner": "another"}, WATCHES, ["unproven"], "another"),
    ],
)
def test_a_refusing_answer_gives_its_reasons_and_owner(
    connect: Connect,
    tmp_path: Path,
    published: Fields,
    change: Fields,
    wants: Fields,
    reasons: list[str],
    owner: str | None,
) -> None:
    with false_daemon(tmp_path, told(**change), **published):
        graspd = connect(tmp_path, "ask")

        def is_told() -> bool:  # on a busy machine a message may be too old first
            said = graspd.lift(DEADLINE_S, **wants)
            return (said.reasons, said.owner) == (tuple(reasons), owner)

        wait_until(is_told)


def test_clients_reach_a_daemon_on_an_ipv6_address(connect: Connect, tmp_path: Path) -> None:
    endpoint = free_ipv6_endpoint()
    with false_daemon(tmp_path, endpoint=endpoint):
        assert connect(tmp_path, out=endpoint).lift(LONG_S).may


@pytest.mark.parametrize("still_ms", [-1.0, float("nan"), float("inf")])
def test_a_negative_or_not_finite_still_ms_is_refused(
    connect: Connect, tmp_path: Path, still_ms: float
) -> None:
    with pytest.raises(ValueError, match="still_ms"):
        connect(tmp_path).lift(DEADLINE_S, still_ms=still_ms)


def test_a_wrong_ask_endpoint_is_refused_before_the_first_call(
    connect: Connect, tmp_path: Path
) -> None:
    with pytest.raises((ValueError, zmq.ZMQError), match="name too long"):
        connect(tmp_path, "x" * 200).grasp(0.0)


@pytest.mark.parametrize(
    ("answer", "outcome", "may"),
    [(told(), "stable", True), (told(), "unknown", False), (told(grasp=2), "stable", False)],
    ids=["yes", "no", "of another grasp"],
)
def test_a_client_that_says_no_sends_not_lifting(
    connect: Connect, tmp_path: Path, answer: Answer, outcome: str, may: bool
) -> None:
    with false_daemon(tmp_path, answer, outcome) as heard:

        def is_over() -> bool:  # on a busy machine a client may not get to ask in time
            assert connect(tmp_path).lift(LONG_S if may else DEADLINE_S).may is may
            return may or b"not-lifting" in heard

        wait_until(is_over)
    assert (heard[0], b"not-lifting" in heard) == (b"lift", not may)


@pytest.mark.parametrize(
    ("published", "watch", "found"),
    [
        ({}, False, 1),
        (SLIP, False, 1),
        (UNKNOWN, False, None),
        ({"early": True}, False, None),
        (SLIP | {"early": True}, False, None),
        ({"supervised": True, "early": True}, True, None),
        (WATCHED, False, None),
        (WATCHED, True, 1),
        (WATCHED | {"early": True}, True, None),
    ],
)
def test_wait_for_grasp_returns_only_a_grasp_judged_for_sure(
    connect: Connect, tmp_path: Path, published: Fields, watch: bool, found: int | None
) -> None:
    with false_daemon(tmp_path, **published):
        deadline_s = LONG_S if found else DEADLINE_S
        assert connect(tmp_path).grasp(deadline_s, supervised=watch) == found


def test_wait_for_grasp_returns_each_grasp_once(connect: Connect, tmp_path: Path) -> None:
    with false_daemon(tmp_path, messages_each=10):
        graspd = connect(tmp_path)
        grasps = [graspd.grasp(LONG_S) or 0 for _ in range(5)]
    assert sorted(set(grasps)) == grasps
    assert grasps[0] > 0
