"""Hands with one or two sensors, from the recording to the verdict, with networks of their own."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import pytest

from graspd.daemon.publish.messages import Verdict
from graspd.drivers.recordings.csv_player import DEMO_TABLE
from tests.kit.inside import output, refused
from tests.kit.messages import decode_verdict

HANDS = {"small-session-th": ("th",), "small-session-ff-th": ("ff", "th")}
"""Fingers by model."""


def cut(source: Path, fingers: Sequence[str], folder: Path) -> Path:
    """Copy a recording with no other sensors than those of `fingers`; return the copy's path."""
    path = folder / source.name
    with source.open(newline="") as whole, path.open("w", newline="") as part:
        rows = csv.DictReader(whole)
        kept = [
            name
            for name in rows.fieldnames or ()
            if "_biotac_" not in name or name.split("_")[0] in fingers
        ]
        writer = csv.DictWriter(part, kept, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return path


def verdicts_of(text: str) -> list[Verdict]:
    return [decode_verdict(line.encode()) for line in text.splitlines()]


@pytest.mark.parametrize("name", HANDS)
def test_a_table_without_unused_fingers_gets_the_same_verdicts(name: str, tmp_path: Path) -> None:
    part = output("replay", cut(DEMO_TABLE, HANDS[name], tmp_path), "--model", name, "--json")
    whole = output("replay", DEMO_TABLE, "--model", name, "--json")
    verdicts = verdicts_of(part)
    assert len(verdicts) == 200
    assert {verdict.model for verdict in verdicts} == {name}
    assert sum(verdict.valid for verdict in verdicts) > 150
    assert [(v.verdict, v.p_slip, v.reasons) for v in verdicts] == [
        (v.verdict, v.p_slip, v.reasons) for v in verdicts_of(whole)
    ]


def test_a_table_without_a_finger_of_the_model_is_refused(tmp_path: Path) -> None:
    problem = refused("replay", cut(DEMO_TABLE, ("ff", "th"), tmp_path))
    assert "has ff, th; small-session also needs mf" in problem
