"""`graspd session` and what was learned: seeded from recorded outcomes, shown, forgotten."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from graspd.biotac import electrode_columns
from graspd.daemon import scene as scenes
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.session.file import KeptSession
from graspd.daemon.session.folder import SessionFolder
from graspd.daemon.trust.lift_book import GraspId
from graspd.daemon.trust.trust import Trust, TrustState
from graspd.drivers.recordings.columns import SLIPPED
from graspd.drivers.recordings.csv_player import DEMO_TABLE
from graspd.drivers.recordings.csv_rows import read_rows
from graspd.drivers.twins.grasps.grasp_script import EndPoint
from graspd.drivers.twins.grasps.whole_grasps import RATE_HZ, WholeGrasps, rest_above
from tests.daemon.record.test_export import Writer
from tests.daemon.session.learning import SHORT, kept_in, last_kept
from tests.kit.inside import graspd, output, refused
from tests.kit.scenes import session_scene, unlabelled_demo

FINGERS = ("ff", "mf", "th")
ROWS = list(read_rows(DEMO_TABLE, FINGERS))


def seed(path: Path, recording: Path) -> TrustState:
    """Seed the session of the scene `path` from a recording; return what it has learned."""
    output("session", "seed", path, recording)
    kept = last_kept(path.with_name("right"))
    assert kept.trust is not None
    return kept.trust


def shown(path: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(output("session", "show", path, "--json"))
    return document


def live_trust(path: Path) -> Trust:
    """The trust of a daemon that starts with this scene, with nothing learned yet."""
    wanted = scenes.load(path)
    trust = assembly.build_pipeline(Plan.of(wanted), assembly.load_model(wanted)).trust
    assert trust is not None
    return trust


def test_seeding_from_a_table_teaches_but_counts_no_lifts(tmp_path: Path) -> None:
    path = session_scene(tmp_path, sections="[risk]\nmax_slip_when_stable = 0.1\n")
    learned = seed(path, DEMO_TABLE)
    known = sum(row.annotation.slipped is not None for row in ROWS)
    assert known * 0.9 < learned.learner.outcomes <= known == len(ROWS)
    trust, fresh = live_trust(path), live_trust(path)
    trust.restore(learned)
    assert trust.learner.outcomes == learned.learner.outcomes
    assert trust.risk.warm_up_left == fresh.risk.warm_up_left == 50
    report = trust.report()
    assert (report.lifts, report.slips, report.outstanding) == (0, 0, 0)
    assert (trust.risk.budget, trust.risk.bound) == (fresh.risk.budget, fresh.risk.bound)
    told = shown(path)["session"]["trust"]
    assert (told["outcomes"], told["lifts"]) == (learned.learner.outcomes, 0)


@pytest.mark.slow
def test_seeding_from_a_stream_keeps_the_sensors_resting_counts(tmp_path: Path) -> None:
    """Forty grasps hold and slip in turn; their outcomes end the warm-up."""
    counts = [row.counts for row in ROWS[:40]]
    ends = [EndPoint(each, bool(number % 2), "mug") for number, each in enumerate(counts)]
    rest = rest_above(np.array([row.counts for row in ROWS]))
    names = [name for finger in FINGERS for name in electrode_columns(finger)]
    recording = tmp_path / "stream.csv"
    with recording.open("w", newline="") as out:
        table = csv.writer(out)
        table.writerow(["t", SLIPPED, *names])
        for row in WholeGrasps(rest, ends, rate_hz=RATE_HZ, durations=SHORT):
            label = int(bool(row.slipped))
            table.writerow([f"{row.t_s:.4f}", label, *row.counts.ravel().tolist()])
    path = session_scene(tmp_path, sections="[risk]\nmax_slip_when_stable = 0.1\nwarm_up = 5\n")
    learned = seed(path, recording)
    kept = last_kept(tmp_path / "right")
    assert kept.rest is not None
    assert np.abs(np.array(kept.rest) - rest.ravel()).max() < 10.0  # of measured noise
    assert learned.risk.proven == learned.learner.outcomes > 5
    assert shown(path)["calibrated"] is True


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


def test_seeding_a_model_without_session_needs_known_outcomes(tmp_path: Path) -> None:
    path = session_scene(tmp_path, model="mlp")
    problem = refused("session", "seed", path, unlabelled_demo(tmp_path))
    assert "none is a grasp whose outcome is known" in problem
    learned = seed(path, DEMO_TABLE)
    assert learned.learner.outcomes > 0.9 * len(ROWS)
    document = shown(path)
    assert document["session"]["statistics"] is None
    assert document["calibrated"] is False


def test_seeding_refuses_outcomes_that_cannot_be_read(tmp_path: Path) -> None:
    words = {"0": "held", "1": "dropped"}
    header, *lines = DEMO_TABLE.read_text().splitlines()
    assert header.split(",")[1] == SLIPPED
    cells = [line.split(",", 2) for line in lines]
    rows = [",".join([name, words[outcome], counts]) for name, outcome, counts in cells]
    table = tmp_path / "words.csv"
    table.write_text("\n".join([header, *rows, ""]))
    path = session_scene(tmp_path)
    problem = "line 2, column slipped: 'dropped' is not an outcome"
    assert problem in refused("session", "seed", path, table)
    assert kept_in(tmp_path / "right") == []


def test_seeding_with_learning_off_keeps_what_was_learned(tmp_path: Path) -> None:
    learned = seed(session_scene(tmp_path), DEMO_TABLE)
    assert learned.learner.outcomes > 0
    off = session_scene(tmp_path, sections="[learn]\nenabled = false\n")
    assert seed(off, unlabelled_demo(tmp_path)) == learned


def test_reset_forgets_a_session_unless_another_graspd_uses_it(tmp_path: Path) -> None:
    path, kept = session_scene(tmp_path), tmp_path / "right"
    seed(path, DEMO_TABLE)
    with SessionFolder(kept) as folder:
        folder.load()
        first = last_kept(kept)
        folder.save([KeptSession(first.statistics, FINGERS, {})])
    assert "  learned  nothing" in graspd("session", "show", path).stdout
    with SessionFolder(kept):
        for arguments in (("reset", path), ("seed", path, DEMO_TABLE)):
            assert "in use by another graspd" in refused("session", *arguments)
    seed(path, DEMO_TABLE)
    assert graspd("session", "reset", path).stdout.endswith(": forgotten\n")
    assert shown(path)["session"] is None


def test_settling_announced_lifts_learns_as_if_their_controller_reported(tmp_path: Path) -> None:
    """`session settle` has the effect that the outcomes have if a controller reports them."""
    sections = "keep = true\n[risk]\nmax_slip_when_stable = 0.1\n"
    path, kept = session_scene(tmp_path, "mlp", sections), tmp_path / "right"
    trust, boot = live_trust(path), "0123456789abcdef" * 2
    for number in range(1, 6):
        grasp = GraspId(boot, number)
        trust.note(grasp, trust.judge(grasp, 0.01, -5.0, np.zeros(0)), stable=True)
        trust.lifts.announce()
    with SessionFolder(kept) as folder:
        folder.save([KeptSession(None, FINGERS, {"ff": "A"}, trust.state())])
        problem = refused("session", "settle", path)
        assert "in use by another graspd, stop that one first" in problem
    names = [f"01234567-{number}" for number in range(1, 6)]
    assert graspd("session", "settle", path).stdout.splitlines()[1:] == names
    problem = refused("session", "settle", path, "01234567-9", "--as", "held")
    assert "01234567-9: not open" in problem
    for told, lifts, number in (("slipped", [0, 0], 1), ("not-lifted", [1, 2], 2), ("held", (), 2)):
        said = output("session", "settle", path, *(names[lift] for lift in lifts), "--as", told)
        assert f": {number} lifts {told}" in said
    for number, slipped in ((1, True), (4, False), (5, False)):
        trust.outcome(GraspId(boot, number), slipped=slipped)
    now, found = last_kept(kept), live_trust(path)
    assert now.trust is not None
    assert now.serials == {"ff": "A"}
    found.restore(now.trust)
    assert found.learner.state() == trust.learner.state()
    assert found.risk.state() == trust.risk.state()
    assert (found.lifts.announced, found.lifts.awaited) == (3, 0)
    files = {each.name: each.read_bytes() for each in kept.iterdir()}
    assert "0 lifts held" in graspd("session", "settle", path, "--as", "held").stdout
    assert {each.name: each.read_bytes() for each in kept.iterdir()} == files


def test_settling_lifts_keeps_the_order_of_the_session_files(tmp_path: Path) -> None:
    """The files of two sets of sensors have the same lift open; another model ran last."""
    path = session_scene(tmp_path, "mlp", "keep = true\n[risk]\nmax_slip_when_stable = 0.1\n")
    kept, trust = tmp_path / "right", live_trust(path)
    told, grasp = (GraspId("0123456789abcdef" * 2, number) for number in (1, 2))
    for each in (told, grasp):
        trust.note(each, trust.judge(each, 0.01, -5.0, np.zeros(0)), stable=True)
        trust.lifts.announce()
    former = KeptSession(None, FINGERS, {"ff": "B"}, trust.state())
    trust.outcome(told, slipped=True)  # after the exchange
    mine = KeptSession(None, FINGERS, {"ff": "A"}, trust.state())
    with SessionFolder(kept) as folder:
        folder.save([KeptSession(None, FINGERS, {"ff": "C"}), mine, former])
    settled = graspd("session", "settle", path, "--as", "held")
    assert settled.stdout.endswith(": 1 lifts held\n"), settled.stderr
    trust.outcome(grasp, slipped=False)
    found = [(each.serials["ff"], each.trust) for each in kept_in(kept)]
    assert [sensor for sensor, _ in found] == ["C", "A", "B"]
    assert found[1][1] is not None
    assert found[1][1].risk == trust.risk.state()
    assert found[2][1] != former.trust
    assert "0 lifts without" in graspd("session", "settle", path).stdout


def test_session_show_lists_first_the_session_a_start_continues(tmp_path: Path) -> None:
    """A model that keeps no statistics ran last, with the same sensors."""
    path = session_scene(tmp_path)
    learned = seed(path, DEMO_TABLE)
    seeded = last_kept(tmp_path / "right")
    other = live_trust(session_scene(tmp_path / "other", "mlp")).state()
    with SessionFolder(tmp_path / "right") as folder:
        folder.load()
        mine = replace(seeded, serials={"ff": "A"})
        folder.save([KeptSession(None, FINGERS, {"ff": "A"}, other), mine])
    document = shown(path)
    assert document["calibrated"] is True
    assert document["session"]["file"] == "2.session"
    assert document["session"]["trust"]["outcomes"] == learned.learner.outcomes > 0
    assert [each["file"] for each in document["others"]] == ["3.session"]


def test_show_seed_and_settle_name_a_damaged_session_file(tmp_path: Path) -> None:
    path, kept = session_scene(tmp_path, model="mlp"), tmp_path / "right" / "1.session"
    kept.parent.mkdir()
    kept.write_bytes(b"?")
    for arguments in (("show", path), ("seed", path, DEMO_TABLE), ("settle", path)):
        result = graspd("session", *arguments)
        assert f"{kept}: not a session" in result.stderr
        assert len(result.stderr.splitlines()) == 1
        assert result.returncode == (2 if arguments[0] == "show" else 0)
