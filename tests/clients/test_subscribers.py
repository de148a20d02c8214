"""Many subscribers, stopped and hostile ones among them, change nothing of what the others hear."""

from __future__ import annotations

from daemon.publish.messages import Verdict
from drivers.recordings.csv_player import DEMO_TABLE
from tests.bench.subscribers import Crowd, Setup, take_turn
from tests.daemon.processes import before_others

CROWD = Crowd(listeners=27, stopped=3, flood=True, garbage=True)
SETUP = Setup(learns=False, high_water_mark=1000)
"""Ten seconds of messages: a busy computer must not lose any."""
ROWS = len(DEMO_TABLE.read_text().splitlines()) - 1


def row_of(verdict: Verdict) -> int:
    """Row of the demo table, which is played over and over."""
    return verdict.seq % ROWS


def said(verdict: Verdict) -> tuple[str, float | None, list[str]]:
    return verdict.verdict, verdict.p_slip, verdict.repaired


def test_a_crowd_changes_no_verdict_and_loses_none() -> None:
    with before_others():
        alone, crowded = (take_turn(crowd, 3.0, SETUP) for crowd in (Crowd(), CROWD))
    for turn in (alone, crowded):
        assert turn.lost == 0
        assert len(turn.verdicts) > 50
    judged = {row_of(each): said(each) for each in alone.verdicts if each.valid}
    both = [each for each in crowded.verdicts if each.valid and row_of(each) in judged]
    assert both
    assert [said(each) for each in both] == [judged[row_of(each)] for each in both]
