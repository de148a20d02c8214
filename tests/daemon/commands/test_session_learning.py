"""`graspd session` and what was learned: seeded from recorded outcomes, shown, forgotten."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from graspd.daemon import scene as scenes
from graspd.daemon.assembly import assembly
from graspd.daemon.session.file import SessionFile, former_of, kept_now, load
from graspd.daemon.trust.trust import Trust, TrustState, decode
from graspd.drivers.recordings.csv_player import DEMO_TABLE
from graspd.drivers.recordings.csv_rows import read_rows
from tests.daemon.record.test_export import Writer
from tests.kit.inside import graspd
from tests.kit.scenes import session_scene, unlabelled_demo

FINGERS = ("ff", "mf", "th")
ROWS = list(read_rows(DEMO_TABLE, FINGERS))


def seed(path: Path, recording: Path) -> TrustState | None:
    """What is kept after seeding."""
    seeded = graspd("session", "seed", path, recording)
    assert seeded.returncode == 0, seeded.stderr
    kept = load(path.with_name("right.json"))
    assert kept is not None
    return None if kept.trust is None else decode(kept.trust)


def shown(path: Path) -> dict[str, Any]:
    result = graspd("session", "show", path, "--json")
    assert result.returncode == 0, result.stderr
    document: dict[str, Any] = json.loads(result.stdout)
    return document


def live_trust(path: Path) -> Trust:
    """That of a daemon which starts now."""
    wanted = scenes.load(path)
    trust = assembly.build_pipeline(wanted, assembly.load_model(wanted)).trust
    assert trust is not None
    return trust


def test_a_table_teaches_and_ends_the_warm_up_and_counts_no_lift(tmp_path: Path) -> None:
    path = session_scene(tmp_path, sections="[risk]\nmax_slip_when_stable = 0.1\n")
    learned = seed(path, DEMO_TABLE)
    assert learned is not None
    known = sum(row.annotation.slipped is not None for row in ROWS)
    assert known * 0.9 < learned.learner.outcomes <= known == len(ROWS)
    trust, fresh = live_trust(path), live_trust(path)
    trust.restore(learned)
    assert trust.learner.outcomes == trust.risk.proven == learned.learner.outcomes
    assert trust.risk.warm_up_left == 0
    report = trust.report()
    assert (report.lifts, report.slips, report.outstanding) == (0, 0, 0)
    assert (trust.risk.budget, trust.risk.bound) == (fresh.risk.budget, fresh.risk.bound)
    document = shown(path)
    assert document["session"]["trust"] == {
        "model": learned.model,
        "outcomes": learned.learner.outcomes,
        "told": {},
        "max_slip_when_stable": None,
        "lifts": 0,
        "slips": 0,
        "outstanding": 0,
        "unreported": 0,
        "proven": learned.learner.outcomes,
    }
    text = graspd("session", "show", path).stdout
    assert f"  learned  {learned.learner.outcomes} outcomes, by the model" in text
    assert "  stable   0 lifts reported, 0 slipped, 0 outstanding, 0 never reported" in text


def test_a_recording_teaches_as_the_table_of_its_grasps_does(tmp_path: Path) -> None:
    table = session_scene(tmp_path / "table")
    recording = tmp_path / "monday.mcap"
    writer = Writer(recording)
    for number, row in enumerate(ROWS, 1):
        writer.judged(number, row.counts)
        writer.outcome(number, "slip" if row.annotation.slipped else "stable")
    writer.close()
    recorded = session_scene(tmp_path / "recorded")
    assert seed(recorded, recording) == seed(table, DEMO_TABLE)


def test_a_table_without_labels_seeds_the_session_alone(tmp_path: Path) -> None:
    learned = seed(session_scene(tmp_path), unlabelled_demo(tmp_path))
    assert learned is not None
    assert (learned.learner.outcomes, learned.risk.proven) == (0, 0)


def test_a_model_without_session_learns_from_outcomes_or_refuses(tmp_path: Path) -> None:
    path = session_scene(tmp_path, model="mlp")
    refused = graspd("session", "seed", path, unlabelled_demo(tmp_path))
    assert refused.returncode == 2
    assert "none is a grasp whose outcome is known" in refused.stderr
    learned = seed(path, DEMO_TABLE)
    assert learned is not None
    assert learned.learner.outcomes > 0.9 * len(ROWS)
    document = shown(path)
    assert document["session"]["statistics"] is None
    assert document["calibrated"] is False


def test_seeding_where_nothing_learns_keeps_what_was_learned(tmp_path: Path) -> None:
    learned = seed(session_scene(tmp_path), DEMO_TABLE)
    assert learned is not None
    assert learned.learner.outcomes > 0
    off = session_scene(tmp_path, sections="[learn]\nenabled = false\n")
    assert seed(off, unlabelled_demo(tmp_path)) == learned


def test_seeding_and_forgetting_leave_nothing_of_before(tmp_path: Path) -> None:
    path, kept = session_scene(tmp_path), tmp_path / "right.json"
    seed(path, DEMO_TABLE)
    with SessionFile(kept) as file:
        first = file.load()
        assert first is not None
        file.save(kept_now(first.statistics, FINGERS, {}))
    assert shown(path)["former_saved_at"] == first.saved_at
    assert "  before   " in graspd("session", "show", path).stdout
    assert "  learned  nothing" in graspd("session", "show", path).stdout
    with SessionFile(kept):
        for arguments in (("reset", path), ("seed", path, DEMO_TABLE)):
            refused = graspd("session", *arguments)
            assert (refused.returncode, "in use by another graspd" in refused.stderr) == (2, True)
    seed(path, DEMO_TABLE)
    assert not former_of(kept).exists()
    kept.rename(former_of(kept))  # as after a kill between two steps
    assert graspd("session", "reset", path).stdout.endswith(": forgotten\n")
    assert shown(path)["session"] is None


@pytest.mark.parametrize("damaged", [("right.json",), ("right.json", "right.json.former")])
def test_what_is_damaged_is_said(tmp_path: Path, damaged: tuple[str, ...]) -> None:
    path, kept = session_scene(tmp_path, model="mlp"), tmp_path / "right.json"
    with SessionFile(kept) as file:
        file.save(kept_now(None, FINGERS, {}))
        file.save(kept_now(None, FINGERS, {"ff": "A"}))
    for name in damaged:
        tmp_path.joinpath(name).write_bytes(b"?")
    result = graspd("session", "show", path)
    assert f"{kept}: not a session" in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert result.returncode == (0 if len(damaged) == 1 else 2)
