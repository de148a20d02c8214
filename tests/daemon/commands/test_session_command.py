"""`graspd session` and session calibration in a replay, as a user runs them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from graspd.daemon.session.file import KeptSession
from graspd.daemon.session.folder import SessionFolder
from graspd.drivers.recordings.csv_player import DEMO_TABLE
from graspd.models.session_statistics import SessionState
from tests.kit.inside import graspd, output, refused
from tests.kit.scenes import demo_scene, session_scene


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return session_scene(tmp_path, "cnn1-session")


def test_a_session_is_seeded_shown_used_and_forgotten(scene: Path, bts3_dir: Path) -> None:
    recording = bts3_dir / "palm_45.csv"
    shown = graspd("session", "show", scene)
    assert (shown.returncode, shown.stdout.count("no session is kept")) == (0, 1)
    assert "no session was kept" in output("session", "reset", scene)
    assert "no lifts are kept" in refused("session", "settle", scene)
    assert not (scene.parent / "right").exists()  # root would shut the service out
    seeded = graspd("session", "seed", scene, recording)
    assert (seeded.returncode, seeded.stderr) == (0, "")  # cnn1-session has not seen palm_45
    grasps = int(re.search(r": (\d+) grasps of 2133 readings", seeded.stdout)[1])  # type: ignore[index]
    assert grasps > 1500
    shown = graspd("session", "show", scene, "--json")
    document = json.loads(shown.stdout)
    assert document["calibrated"] is False  # a table does not say of which sensors it is
    assert document["session"]["statistics"]["grasps"] == grasps
    assert f"{grasps} grasps, not calibrated yet" in graspd("session", "show", scene).stdout
    kept = ("--session", scene.parent / "right" / "1.session")
    replayed = output("replay", DEMO_TABLE, "--model", "cnn1-session", *kept, "--json")
    first = json.loads(replayed.splitlines()[0])
    assert first["session_calibrated"] is True
    for says in ("forgotten", "no session was kept"):
        assert says in output("session", "reset", scene)


@pytest.mark.parametrize("section", ["", '[session]\nkeep = false\nfolder = "kept"\n'])
def test_seed_and_reset_refuse_scenes_that_keep_no_session(section: str, tmp_path: Path) -> None:
    path = demo_scene(tmp_path, sections=section)
    for words in (("seed", path, DEMO_TABLE), ("reset", path)):
        assert f"{path} keeps no session" in refused("session", *words)
    assert list(tmp_path.iterdir()) == [path]


def test_an_unusable_session_is_not_shown_as_calibrated(tmp_path: Path) -> None:
    """A session of other fingers, and one with mean counts that no grasp has."""
    path = session_scene(tmp_path)
    shown = []
    for fingers in (("ff", "mf", "rf"), ("ff", "mf", "th")):
        odd = SessionState(30.0, 30, (4000.0,) * 150, (1e4,) * 150)
        with SessionFolder(tmp_path / "right") as folder:
            folder.save([KeptSession(odd, fingers, {"ff": "BTSP-1"})])
        program = graspd("session", "show", path, "--json")
        shown.append((json.loads(program.stdout)["calibrated"], program.stderr))
        assert "30 grasps, not calibrated yet" in graspd("session", "show", path).stdout
    assert shown[0][0] is shown[1][0] is False
    assert "is of the fingers ff, mf, rf" in shown[0][1]
    assert shown[1][1] == ""


def test_random_counts_seed_no_session(scene: Path, tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    header = [f"{finger}_biotac_{n}" for finger in ("ff", "mf", "th") for n in range(1, 25)]
    rows = [",".join(map(str, row)) for row in random.integers(1, 4095, (200, 72)).tolist()]
    recording = tmp_path / "garbage.csv"
    recording.write_text("\n".join([",".join(header), *rows]) + "\n")
    *why, problem = refused("session", "seed", scene, recording).splitlines()
    assert "not grasps" in problem or "unlike all grasps" in problem
    assert why[0] == "graspd: nothing was judged:"
    assert len(why) <= 3
    assert graspd("session", "show", scene).stdout.count("no session is kept") == 1


def test_replay_refuses_a_session_of_other_size_in_one_line(tmp_path: Path) -> None:
    with SessionFolder(tmp_path) as folder:
        odd = SessionState(1.0, 1, (1.0,) * 10, (1.0,) * 10)
        folder.save([KeptSession(odd, ("ff", "mf", "th"), {})])
    problem = refused("replay", "--session", tmp_path / "1.session")
    assert problem == "graspd: the kept session is of 10 values, not of 150\n"
