"""What is remembered: five minutes of seconds, and grasps by the gate's numbers."""

from __future__ import annotations

import pytest

from daemon.judge.reasons import Decision, GateState
from daemon.watch.pixels import Canvas
from daemon.watch.snapshot import Tone
from daemon.watch.timeline import Timeline
from tests.daemon.watch.watch_fakes import MS, a_view, after, text_of, verdict


@pytest.mark.parametrize(
    ("moments", "tones", "shares"),
    [
        ([(0, Tone.STABLE, 0.1), (900, Tone.STABLE, 0.2)], ["s"], [20]),
        ([(0, Tone.SLIP, 0.9), (999, Tone.STABLE, 0.1)], ["xs"], [90]),
        (
            [(0, Tone.STABLE, 0.1), (999, Tone.TROUBLE, None), (1000, Tone.WAITING, None)],
            ["ts", "w"],
            [10, -1],
        ),
        (
            [(0, Tone.STABLE, 0.1), (4000, Tone.SLIP, 0.8)],
            ["s", ".", ".", ".", "x"],
            [10, -1, -1, -1, 80],
        ),
        (
            [(0, Tone.WAITING, None), (3_600_000, Tone.STABLE, 0.0)],
            ["."] * 299 + ["s"],
            [-1] * 299 + [0],
        ),
    ],
    ids=["one", "worst", "next", "gap", "hour"],
)
def test_a_second_has_all_that_was_said_in_it_and_one_unwatched_is_silent(
    moments: list[tuple[int, Tone, float | None]], tones: list[str], shares: list[int]
) -> None:
    timeline = Timeline()
    for at_ms, tone, p_slip in moments:
        timeline.add(at_ms * MS, tone, p_slip)
    assert (timeline.tones, timeline.shares) == (tones, shares)


def test_grasps_are_counted_once_each_however_many_readings_they_have() -> None:
    view = a_view()
    seq = 0
    # As the gate numbers them: 1 slips, 2 turns from stable to slip, 3 is let go unjudged, 4 holds.
    said = {1: [Decision.SLIP], 2: [Decision.STABLE, Decision.SLIP], 3: [], 4: [Decision.STABLE]}
    for grasp, decisions in said.items():
        steps = [(GateState.CLOSING, Decision.UNKNOWN)] * 9
        steps += [(GateState.JUDGED, decision) for decision in decisions for _ in range(20)]
        steps += [(GateState.RELEASED, Decision.UNKNOWN), (GateState.IDLE, Decision.UNKNOWN)] * 5
        for gate, decision in steps:
            view.take(b"verdict.right", verdict(seq, decision, grasp=grasp, gate=gate), 0)
            seq += 1
        if grasp == 3:
            assert view.snapshot(0).counts == {"stable": 0, "slip": 2, "unknown": 1}
    seen = view.snapshot(0)
    assert seen.counts == {"stable": 1, "slip": 2, "unknown": 1}
    assert "since watch began 1 stable, 2 slip, 1 unknown" in "\n".join(
        text_of(seen, 80, 24, Canvas())
    )
    closing = verdict(seq, grasp=5, gate=GateState.CLOSING)
    view.take(b"verdict.right", closing, 0)
    assert view.snapshot(0).counts == seen.counts  # not known yet
    restarted = verdict(0, Decision.STABLE, grasp=1, boot_id="another")
    view.take(b"verdict.right", restarted, 0)
    assert view.snapshot(0).counts == {"stable": 2, "slip": 2, "unknown": 2}


def test_a_grasp_that_was_over_before_anybody_watched_is_not_counted() -> None:
    view = after((b"verdict.right", verdict(0, grasp=41, gate=GateState.IDLE)))
    assert view.snapshot(0).counts == {"stable": 0, "slip": 0, "unknown": 0}
