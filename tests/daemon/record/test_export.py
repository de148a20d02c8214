"""Outcomes find the very reading that was judged, and the table is one that training takes."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.judge.reasons import GateState, Outcome
from daemon.publish.messages import OutcomeMessage, Tactile, Verdict, encode
from daemon.record.export import collect
from daemon.record.files import MessageFile
from drivers.base import RecordingError
from drivers.recordings.csv_player import DEMO_TABLE
from models.training.data.datasets import read_table
from tests.daemon.processes import graspd

BOOT = "0123456789abcdef" * 2
PERIOD_NS = 10_000_000
Ending = Literal["stable", "slip"]


class Writer:
    """Writes a recording message by message."""

    def __init__(self, path: Path, mode: str = "settled", boot_id: str = BOOT) -> None:
        scene = {"gate": {"mode": mode, "gap_ms": 100.0}}
        header = {
            "fingers": '["ff", "mf", "th"]',
            "joints": "false",
            "boot_id": boot_id,
            "scene": json.dumps(scene),
        }
        self._file = MessageFile(path, header, 10**18)
        self._boot_id = boot_id
        self._now_ns = 10**12
        self._seq = 0

    def tactile(self, counts: NDArray[np.uint16], *, lost: int = 0) -> None:
        self._seq += 1 + lost
        self._now_ns += PERIOD_NS * (1 + lost)
        message = Tactile(
            boot_id=self._boot_id,
            seq=self._seq,
            t=0.0,
            t_mono_ns=self._now_ns,
            fingers=["ff", "mf", "th"],
            counts=counts.tolist(),
            faults=np.zeros((3, 24), dtype=int).tolist(),
        )
        self._file.write(b"tactile.right", encode(message), self._now_ns)

    def verdict(self, grasp: int, *, judged: bool = True, repaired: Sequence[str] = ()) -> None:
        message = Verdict(
            boot_id=self._boot_id,
            seq=self._seq,
            t=0.0,
            t_mono_ns=self._now_ns,
            grasp=grasp,
            verdict=Outcome.SLIP,
            verdict_code=2,
            p_slip=0.9,
            valid=True,
            reasons=[],
            age_ms=0.0,
            latency_us=0.0,
            judged=judged,
            repaired=list(repaired),
            gate=GateState.JUDGED,
            silence_ms=100.0,
            model="fake",
            model_sha="0" * 12,
        )
        self._file.write(b"verdict.right", encode(message), self._now_ns)

    def outcome(self, grasp: int, outcome: Ending, name: str | None = None) -> None:
        message = OutcomeMessage(
            boot_id=self._boot_id,
            seq=0,
            t=0.0,
            t_mono_ns=self._now_ns,
            grasp=grasp,
            outcome=outcome,
            object=name,
        )
        self._file.write(b"outcome.right", encode(message), self._now_ns)

    def outcome_without_the_field(self, grasp: int, outcome: Ending) -> None:
        """As it was recorded before objects were told."""
        content = {"v": 1, "boot_id": self._boot_id, "seq": 0, "t": 0.0, "t_mono_ns": self._now_ns}
        payload = json.dumps(content | {"grasp": grasp, "outcome": outcome}).encode()
        self._file.write(b"outcome.right", payload, self._now_ns)

    def close(self) -> None:
        self._file.close()


def sweeps(number: int, seed: int = 0) -> list[NDArray[np.uint16]]:
    """Counts as those of grasps, each electrode different in each sweep: all fresh."""
    base = np.random.default_rng(seed).integers(1500, 2500, (3, 24))
    return [(base + 7 * step * (-1) ** step).astype(np.uint16) for step in range(number)]


def recorded(
    path: Path, *, lost: int = 0, mode: str = "settled", seed: int = 0
) -> NDArray[np.uint16]:
    """One grasp of six sweeps that is judged with the fifth, and slips; the five sweeps."""
    rows = sweeps(6, seed)
    writer = Writer(path, mode)
    for step, counts in enumerate(rows):
        writer.tactile(counts, lost=lost if step == 4 else 0)
        writer.verdict(1, judged=step == 4)
    writer.outcome(1, "slip")
    writer.close()
    return np.array(rows[:5])


def test_a_row_is_the_median_of_the_three_sweeps_that_were_judged(tmp_path: Path) -> None:
    rows = recorded(tmp_path / "a.mcap")
    (grasp,) = collect([tmp_path / "a.mcap"]).grasps.values()
    assert np.array_equal(grasp.counts, np.median(rows[2:5], axis=0))
    assert grasp.slipped


def test_where_every_reading_is_a_grasp_a_row_is_the_reading(tmp_path: Path) -> None:
    rows = recorded(tmp_path / "a.mcap", mode="every")
    (grasp,) = collect([tmp_path / "a.mcap"]).grasps.values()
    assert np.array_equal(grasp.counts, rows[4])


def test_a_judgement_whose_sweeps_were_not_all_recorded_is_none_to_learn_from(
    tmp_path: Path,
) -> None:
    recorded(tmp_path / "a.mcap", lost=1)
    found = collect([tmp_path / "a.mcap"])
    assert not found.grasps
    assert found.unjoined == 1


def test_what_is_left_out_is_counted(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "a.mcap")
    for grasp, counts in enumerate(sweeps(8)):
        writer.tactile(counts)
        writer.verdict(grasp, judged=grasp >= 4, repaired=["ff_7"] if grasp == 5 else ())
    writer.outcome(4, "stable")
    writer.outcome(4, "slip")
    writer.outcome(5, "slip")
    writer.outcome(9, "slip")
    writer.close()
    found = collect([tmp_path / "a.mcap"])
    assert [grasp.slipped for grasp in found.grasps.values()] == [True]  # the later counts
    assert (found.without_outcome, found.repaired, found.unjoined) == (2, 1, 1)


def test_each_row_has_the_object_that_was_told_and_the_option_names_the_others(
    tmp_path: Path,
) -> None:
    writer = Writer(tmp_path / "a.mcap", mode="every")
    for grasp, counts in enumerate(sweeps(6), 1):
        writer.tactile(counts)
        writer.verdict(grasp)
    writer.outcome(1, "slip", "mug")
    writer.outcome(2, "stable", "ball")
    writer.outcome(3, "stable")
    writer.outcome_without_the_field(4, "slip")
    writer.outcome(5, "slip", "mug")
    writer.outcome(5, "stable", "box")  # the later counts, with its object ...
    writer.outcome(6, "slip", "mug")
    writer.outcome(6, "stable")  # ... or without
    writer.close()
    out = tmp_path / "t.csv"
    for options, other in (((), "unknown"), (("--object", "cup"), "cup")):
        result = graspd("export-grasps", tmp_path / "a.mcap", "--out", out, *options)
        assert result.returncode == 0, result.stderr
        assert result.stdout == (
            "6 grasps, 2 slipped; 3 objects by name; 3 grasps without an object\n"
        )
        table = read_table(out)
        assert table.objects == ("mug", "ball", other, other, "box", other)
        assert table.slipped.tolist() == [True, False, False, True, False, False]


def test_grasps_of_two_starts_are_told_apart(tmp_path: Path) -> None:
    recorded(tmp_path / "a.mcap")
    writer = Writer(tmp_path / "b.mcap", boot_id="f" * 32)
    for counts in sweeps(4, seed=1):
        writer.tactile(counts)
    writer.verdict(1)
    writer.outcome(1, "stable")
    writer.close()
    found = collect([tmp_path / "a.mcap", tmp_path / "b.mcap"])
    assert [grasp.slipped for grasp in found.grasps.values()] == [True, False]


def test_a_judgement_and_its_outcome_may_stand_in_two_files(tmp_path: Path) -> None:
    first, second = Writer(tmp_path / "a.mcap"), Writer(tmp_path / "b.mcap")
    for counts in sweeps(4):
        first.tactile(counts)
    first.verdict(1)
    second.outcome(1, "slip")
    first.close()
    second.close()
    assert len(collect([tmp_path / "a.mcap", tmp_path / "b.mcap"]).grasps) == 1


def test_a_recording_that_does_not_say_how_it_judged_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    header = {"fingers": '["ff"]', "joints": "false", "boot_id": BOOT, "scene": "{}"}
    MessageFile(path, header, 0).close()
    with pytest.raises(RecordingError, match="how it was judged"):
        collect([path])


def test_without_any_outcome_nothing_is_written(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "a.mcap")
    writer.close()
    result = graspd("export-grasps", tmp_path / "a.mcap", "--out", tmp_path / "t.csv")
    assert result.returncode == 1
    assert "no judged grasp with an outcome" in result.stderr
    assert not (tmp_path / "t.csv").exists()


def test_what_was_recorded_of_a_table_is_that_table_and_a_network_learns_from_it(
    tmp_path: Path,
) -> None:
    for package in ("torch", "rich"):
        pytest.importorskip(package, reason="the train extra is not installed")
    with DEMO_TABLE.open(newline="") as file:
        table = list(csv.DictReader(file))
    known = read_table(DEMO_TABLE)
    writer = Writer(tmp_path / "a.mcap", mode="every")
    for grasp, row in enumerate(table, 1):
        writer.tactile(known.counts[grasp - 1])
        writer.verdict(grasp)
        writer.outcome(grasp, "slip" if row["slipped"] == "1" else "stable")
    writer.close()
    out = tmp_path / "lab.csv"
    result = graspd("export-grasps", tmp_path / "a.mcap", "--out", out, "--object", "mug")
    assert result.returncode == 0, result.stderr
    grasps = read_table(out)
    assert np.array_equal(grasps.counts, known.counts)
    assert np.array_equal(grasps.slipped, known.slipped)
    made = graspd(
        *("train", "svm", "--own", out, "--out", tmp_path / "svm"),
        *("--only", "cv", "--folds", 2, "--quiet"),
    )
    assert made.returncode == 0, made.stderr
    assert made.stderr == ""
    judged = graspd("replay", DEMO_TABLE, "--model", tmp_path / "svm" / "svm.onnx", "--json")
    assert judged.returncode == 0, judged.stderr
    scores = json.loads(judged.stderr.splitlines()[-1])["scores"]
    assert scores is not None
