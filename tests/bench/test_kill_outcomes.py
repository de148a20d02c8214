"""The bench that kills a daemon while it is told outcomes, in short."""

from __future__ import annotations

from pathlib import Path

from tests.bench.outcomes import kill_often


def test_no_acknowledged_outcome_is_lost_by_a_kill(tmp_path: Path) -> None:
    found = kill_often(tmp_path, outcomes=200, kills=3, seed=7)
    assert (found.acknowledged, found.kills) == (200, 3)
    assert found.not_learned < 20
