"""Exported tables join each outcome with the counts that were judged."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import pandas as pd
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.publish.messages import OutcomeMessage, encode
from graspd.daemon.record.export import collect
from graspd.daemon.record.frames import read_grasps, read_recording
from graspd.daemon.record.mcap import McapWriter
from graspd.daemon.record.topics import EVENT, Judged, flat
from graspd.daemon.trust.lift_book import GraspId
from graspd.drivers.base import ElectrodeFault, RecordingError, TactileReading
from graspd.drivers.recordings.csv_player import DEMO_RECORDING, DEMO_TABLE
from graspd.models.training.data.datasets import read_table
from tests.daemon.record import recorded
from tests.daemon.record.recorded import BOOT
from tests.kit.inside import graspd, output, refused
from tests.kit.scenes import demo_scene

Ending = Literal["stable", "slip"]
HEADER = replace(recorded.HEADER, fingers=("ff", "mf", "th"), wall_minus_monotonic_ns=10**18)


class Writer:
    """Writes a recording message by message."""

    def __init__(self, path: Path, boot_id: str = BOOT) -> None:
        self._file = McapWriter(path, replace(HEADER, boot_id=boot_id))
        self._boot_id = boot_id
        self._now_ns = 10**12

    def judged(
        self, grasp: int, counts: NDArray[np.integer[Any]], *, repaired: Sequence[str] = ()
    ) -> None:
        """Write the counts by which a grasp was judged."""
        message = Judged(
            boot_id=self._boot_id,
            t_mono_ns=self._now_ns,
            grasp=grasp,
            counts=counts.tolist(),
            repaired=list(repaired),
        )
        content = flat(msgspec.to_builtins(message))
        self._file.write(b"judged.right", msgspec.json.encode(content), self._now_ns)

    def verdict(self, grasp: int, decision: str) -> None:
        """Write what of a verdict an export reads; 10 ms pass before it."""
        self._now_ns += 10_000_000
        said = {"boot_id": self._boot_id, "grasp": grasp, "t_mono_ns": self._now_ns}
        content = msgspec.json.encode({"v": 1, "verdict": decision, **said})
        self._file.write(b"verdict.right", content, self._now_ns)

    def announced(self) -> None:
        self._file.write(b"announced.right", EVENT, self._now_ns)

    def outcome(
        self, grasp: int, outcome: Ending, name: str | None = None, judged_by: str | None = None
    ) -> None:
        message = OutcomeMessage(
            boot_id=self._boot_id,
            seq=0,
            t=0.0,
            t_mono_ns=self._now_ns,
            grasp=grasp,
            outcome=outcome,
            object=name,
            grasp_boot_id=judged_by,
        )
        self._file.write(b"outcome.right", encode(message), self._now_ns)

    def close(self) -> None:
        self._file.close()


def sweeps(number: int, seed: int = 0) -> list[NDArray[np.uint16]]:
    """Return counts of sweeps, each shape (3, 24); all electrodes change from sweep to sweep."""
    base = np.random.default_rng(seed).integers(1500, 2500, (3, 24))
    return [(base + 37 * step * (-1) ** step).astype(np.uint16) for step in range(number)]


def record(path: Path, *grasps: tuple[NDArray[np.integer[Any]], Ending, str | None]) -> None:
    """Write a recording of grasps, each given by counts, outcome and object; None: no object."""
    writer = Writer(path)
    for number, (counts, _, _) in enumerate(grasps, 1):
        writer.judged(number, counts)
    for number, (_, outcome, name) in enumerate(grasps, 1):
        writer.outcome(number, outcome, name)
    writer.close()


def test_only_judgements_of_sound_readings_have_judged_counts(tmp_path: Path) -> None:
    wanted = scene.load(demo_scene(tmp_path, sections='[model]\nname = "cnn1"'))
    pipeline = assembly.build_pipeline(Plan.of(wanted), assembly.load_model(wanted), lambda: 10**12)
    counts, sound = read_table(DEMO_TABLE).counts[0], np.zeros((3, 24), dtype=np.uint8)
    broken = sound.copy()
    broken[1, 3] = ElectrodeFault.MISSING
    late = np.full_like(sound, ElectrodeFault.CUT_OFF)
    well, repaired, unusable = (
        pipeline.judge(TactileReading(10**12, seq, counts + seq, faults))
        for seq, faults in enumerate((sound, broken, late))
    )
    assert well.judged_counts is not None
    assert np.array_equal(well.judged_counts, counts)
    assert repaired.opinion.repaired == ("mf_4",)
    assert repaired.judged_counts is None
    assert unusable.judged_counts is None


def test_the_export_counts_grasps_and_outcomes_left_out(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "a.mcap")
    for grasp, counts in enumerate(sweeps(8)):
        if grasp >= 4:
            writer.judged(grasp, counts, repaired=["ff_7"] if grasp == 5 else ())
    writer.outcome(4, "stable")
    writer.outcome(4, "slip")
    writer.outcome(5, "slip")
    writer.outcome(9, "slip")
    writer.close()
    found = collect([tmp_path / "a.mcap"])
    assert [grasp.slipped for grasp in found.grasps.values()] == [True]  # the later counts
    assert (found.without_outcome, found.repaired, found.unjoined) == (2, 1, 1)
    lacks = "2 left out without an outcome; 1 left out with repaired electrodes; 1 outcomes of"
    with pytest.warns(UserWarning, match=lacks):
        assert len(read_grasps(tmp_path / "a.mcap")) == 1


LIFTS = {
    "first stable": ("1 stable judged, 1 stable judged", 1),
    "never stable": ("1 unknown judged, 1 slip judged", 2),
    "stable later": ("1 unknown judged, 1 stable, 1 stable judged", 1),
    "asked": ("1 stable judged, 1 stable announced judged, 1 stable judged", 2),
    "asked later": ("1 stable judged, 1 stable judged, 1 stable announced, 1 slip judged", 2),
    "asked again": ("1 stable announced judged, 1 stable announced judged, 1 slip judged", 2),
    "supervised": ("1 unknown announced judged, 1 stable judged", 1),
    "another": ("1 stable announced judged, 1 stable judged, 2 stable announced", 1),
}
"""Verdicts (number of the grasp, decision, what follows); which counts of grasp 1 are its row."""


@pytest.mark.parametrize(("verdicts", "lifted"), LIFTS.values(), ids=LIFTS)
def test_an_exported_grasp_has_the_counts_judged_before_its_lift(
    tmp_path: Path, verdicts: str, lifted: int
) -> None:
    writer, counts = Writer(tmp_path / "a.mcap"), iter(sweeps(3))
    for words in map(str.split, verdicts.split(", ")):
        writer.verdict(int(words[0]), words[1])
        if "announced" in words:  # the lift was answered before the counts are recorded
            writer.announced()
        if "judged" in words:
            writer.judged(int(words[0]), next(counts))
    writer.outcome(1, "stable")
    writer.close()
    found = collect([tmp_path / "a.mcap"]).grasps[GraspId(BOOT, 1)]
    assert np.array_equal(found.counts, sweeps(3)[lifted - 1])


def test_of_grasps_with_the_same_counts_the_first_is_kept(tmp_path: Path) -> None:
    mug, bowl = sweeps(2)
    record(tmp_path / "a.mcap", (mug, "slip", None), (bowl, "stable", None), (mug, "stable", None))
    found = collect([tmp_path / "a.mcap"])
    slipped = {number: row.slipped for (_, number), row in found.grasps.items()}
    assert slipped == {1: True, 2: False}
    assert found.repeated == 1
    result = graspd("export-grasps", tmp_path / "a.mcap", "--out", tmp_path / "a.csv")
    assert "1 left out with the very counts of one before" in result.stdout
    assert len(read_table(tmp_path / "a.csv").slipped) == 2


def test_an_exported_grasp_without_object_gets_that_of_the_option(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "a.mcap")
    for grasp, counts in enumerate(sweeps(6), 1):
        writer.judged(grasp, counts)
    writer.outcome(1, "slip", "mug")
    writer.outcome(2, "stable", "ball")
    writer.outcome(3, "stable")
    writer.outcome(4, "slip")
    writer.outcome(5, "slip", "mug")
    writer.outcome(5, "stable", "box")  # the later counts, with its object ...
    writer.outcome(6, "slip", "mug")
    writer.outcome(6, "stable")  # ... or without
    writer.close()
    out = tmp_path / "t.csv"
    for options, other in (((), "unknown"), (("--object", "cup"), "cup")):
        text = output("export-grasps", tmp_path / "a.mcap", "--out", out, "--force", *options)
        assert text == "6 grasps, 2 slipped; 3 objects by name; 3 grasps without an object\n"
        table = read_table(out)
        assert table.objects == ("mug", "ball", other, other, "box", other)
        assert table.slipped.tolist() == [True, False, False, True, False, False]


def test_the_library_reads_the_grasps_that_are_exported(tmp_path: Path) -> None:
    first, second, third = sweeps(3)
    record(
        tmp_path / "a.mcap",
        (first, "stable", "mug"),
        (second, "slip", "mug"),
        (third, "stable", "mug"),
    )
    out = {name: tmp_path / f"t.{name}" for name in ("csv", "parquet")}
    for name, options in (("csv", ()), ("parquet", ("--parquet",))):
        words = "export-grasps", tmp_path / "a.mcap", "--out", out[name], *options
        assert graspd(*words).returncode == 0
    expected = read_table(out["csv"])
    for path in (*out.values(), tmp_path / "a.mcap"):
        table = read_grasps(path)
        assert table["slipped"].tolist() == expected.slipped.tolist() == [False, True, False]
        assert table["object"].tolist() == ["mug"] * 3
        assert np.array_equal(table.iloc[:, 2:], expected.counts.reshape(3, -1))


def test_standard_streams_serve_as_recording_and_as_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record(tmp_path / "a.mcap", (sweeps(1)[0], "slip", "mug"))
    output("export-grasps", tmp_path / "a.mcap", "--out", tmp_path / "t.csv")
    piped = io.TextIOWrapper(io.BytesIO((tmp_path / "a.mcap").read_bytes()))
    monkeypatch.setattr("sys.stdin", piped)
    monkeypatch.chdir(tmp_path)
    done = graspd("export-grasps", "-", "--out", "-")
    assert (done.returncode, done.stdout) == (0, (tmp_path / "t.csv").read_text())
    assert done.stderr == "graspd: 1 grasps, 1 slipped; 1 objects by name\n"
    assert not Path("-").exists()


def test_export_checks_folder_and_extra_before_reading_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unread, missing = tmp_path / "not-there.mcap", tmp_path / "missing"
    said = refused("export-grasps", unread, "--out", missing / "t.csv")
    assert said == f"graspd: {missing}: No such file or directory\n"
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    said = refused("export-grasps", unread, "--out", tmp_path / "t.parquet", "--parquet")
    assert said.startswith("graspd: --parquet needs the package 'pyarrow'")


@pytest.mark.parametrize("name", ["=HYPERLINK(0)", "mug\n=1"])
def test_an_object_name_that_a_spreadsheet_calculates_is_refused(tmp_path: Path, name: str) -> None:
    record(tmp_path / "a.mcap", (sweeps(1)[0], "slip", name))
    out = tmp_path / "t.csv"
    result = graspd("export-grasps", tmp_path / "a.mcap", "--out", out)
    assert (result.returncode, out.exists()) == (2, False)
    assert "a.mcap: outcome message: " in result.stderr
    result = graspd("export-grasps", tmp_path / "a.mcap", "--out", out, f"--object={name}")
    assert (result.returncode, out.exists()) == (2, False)
    assert "an object has a name of letters" in result.stderr


def test_an_outcome_reported_after_a_restart_finds_its_grasp(tmp_path: Path) -> None:
    first, second = Writer(tmp_path / "a.mcap"), Writer(tmp_path / "b.mcap", boot_id="f" * 32)
    first.judged(1, sweeps(1)[0])
    second.judged(1, sweeps(1, seed=1)[0])
    second.outcome(1, "slip", judged_by=BOOT)
    first.close()
    second.close()
    found = collect([tmp_path / "a.mcap", tmp_path / "b.mcap"])
    assert list(found.grasps) == [(BOOT, 1)]
    assert found.without_outcome == 1


@pytest.mark.parametrize("counts", [[[1] * 24] * 2, [[1] * 23] * 3, [[70_000] * 24] * 3, []])
def test_counts_of_wrong_shape_or_beyond_16_bits_are_refused(
    tmp_path: Path, counts: list[list[int]]
) -> None:
    record(tmp_path / "a.mcap", (np.array(counts), "slip", None))
    with pytest.raises(RecordingError, match=r"a\.mcap: outcome message"):
        collect([tmp_path / "a.mcap"])


def test_without_any_outcome_nothing_is_written(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap")
    result = graspd("export-grasps", tmp_path / "a.mcap", "--out", tmp_path / "t.csv")
    assert result.returncode == 1
    assert "no judged grasp with an outcome" in result.stderr
    assert not (tmp_path / "t.csv").exists()


# Tables of pandas.


def test_readers_refuse_files_of_another_kind_or_without_outcomes(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="is a stream and no grasp table: read_recording"):
        read_grasps(DEMO_RECORDING)
    with pytest.raises(RecordingError, match="is a grasp table and no stream: read_grasps"):
        read_recording(DEMO_TABLE)
    assert len(read_recording(DEMO_TABLE, read_as="stream", rate_hz=1.0)) == 200
    table = tmp_path / "grasps.csv"
    pd.read_csv(DEMO_TABLE).drop(columns="slipped").to_csv(table, index=False)
    with pytest.raises(RecordingError, match="no column `slipped`"):
        read_grasps(table)
