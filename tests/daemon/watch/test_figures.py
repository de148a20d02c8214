"""What a verdict rests on, and a slip that is held, in words."""

from __future__ import annotations

from typing import Any

import pytest
from msgspec import structs

from graspd.daemon.judge.reasons import Decision
from tests.daemon.watch.watch_fakes import MS, RISK, after, verdict

NETWORK = "slip probability by the network alone 30 %"
NOTHING_TOLD = structs.replace(RISK, lifts=0, slips=0)


@pytest.mark.parametrize(
    ("change", "evidence"),
    [
        (
            {},
            NETWORK + ", rests on 57 lifts; of 41 `stable` ones 2 slipped, target 10 %",
        ),
        (
            {"outcomes": 1, "risk": structs.replace(NOTHING_TOLD, target=0.05)},
            NETWORK + ", rests on 1 lift; no `stable` one told yet, target 5 %",
        ),
        (
            {"risk": structs.replace(RISK, target=None)},
            NETWORK + ", rests on 57 lifts; of 41 `stable` ones 2 slipped",
        ),
        (
            {"risk": NOTHING_TOLD, "outcomes": 0},
            NETWORK + ", no outcome told yet",
        ),
        ({"risk": None, "outcomes": 0, "p_slip_model": None}, "no outcome told yet"),
    ],
)
def test_a_verdict_says_what_it_rests_on(change: dict[str, Any], evidence: str) -> None:
    seen = after((b"verdict.right", verdict(0, Decision.STABLE, **change))).snapshot(0)
    assert seen.evidence == evidence


@pytest.mark.parametrize(
    ("after_ms", "grasp", "is_held"), [(900, 7, True), (1100, 7, False), (900, 8, False)]
)
def test_a_slip_that_is_held_for_its_second_says_so(
    after_ms: int, grasp: int, is_held: bool
) -> None:
    seen = after((b"verdict.right", verdict(0, Decision.SLIP)))
    assert [line.what for line in seen.snapshot(0).why] == ["do not lift"]
    fallen = verdict(1, Decision.SLIP, p_slip=0.4, grasp=grasp)
    seen.take(b"verdict.right", fallen, after_ms * MS)
    held = [line.advice for line in seen.snapshot(after_ms * MS).why if line.what == "slip, held"]
    assert bool(held) == is_held
    assert all("a moment ago its probability was 50 % or more" in advice for advice in held)
