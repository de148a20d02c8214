"""Figures and the table: what is published, what was run, and `-` for what was not."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

from graspd.models.training.data.datasets import Grasps
from graspd.models.training.data.protocols import EvalProtocol, splits
from graspd.models.training.evaluating import frame
from graspd.models.training.evaluating.figures import (
    Figures,
    by_age,
    by_day,
    read,
    with_probability,
    write,
)
from graspd.models.training.evaluating.frame import Job, evaluated, jobs_of
from graspd.models.training.evaluating.metrics import confusion, f1_interval
from graspd.models.training.evaluating.results_table import difference, results_table
from graspd.models.training.systems.registry import SYSTEMS, digest
from tests.conftest import ROOT
from tests.models.training.samples import sessions

GRASPS = sessions(200)
MADE = "graspd evaluate --data DIR", {"machine": "a desk", "numpy": "2"}
TRUTH = np.where(GRASPS.slipped, 2.0, -2.0)


def figures_of(name: str, protocol: EvalProtocol, wrong: float, seeds: int = 2) -> Figures:
    """Return figures of a system that is wrong on the share `wrong` of the grasps, at random."""
    flip = np.random.default_rng(len(name)).random(len(GRASPS)) < wrong
    margins = np.where(flip, -TRUTH, TRUTH)
    several = ("none", "n50", "running") if protocol == "session" else ("none",)

    def trained(job: Job, grasps: Grasps) -> pd.DataFrame:
        split = splits(protocol, grasps, job.seed, job.folds)[job.fold]
        parts = [
            pd.DataFrame({"variant": variant, "grasp": split.test, "margin": margins[split.test]})
            for variant in several
        ]
        return pd.concat(parts, ignore_index=True).assign(
            refused=pd.NA,
            age=np.tile(np.arange(len(split.test)), len(several)),
            fold_name=split.name,
            train_grasps=len(split.train),
            parameters=1000,
            seconds=2.0,
        )

    jobs = jobs_of(SYSTEMS[name], protocol, GRASPS, range(seeds), 4)
    with pytest.MonkeyPatch.context() as patched, TemporaryDirectory() as folder:
        patched.setattr(frame, "judged", trained)
        parts = [rows for _, rows in evaluated(jobs, GRASPS, Path(folder))]
    return Figures.of(with_probability(pd.concat(parts, ignore_index=True)))


def test_figures_count_every_grasp() -> None:
    made = figures_of("cnn1", "cv", wrong=0.1)
    (stable, false_alarm), (missed, slip) = confusion(made.of_variant())
    assert stable + false_alarm == 2 * int((~GRASPS.slipped[:400]).sum())
    assert missed + slip == 2 * int(GRASPS.slipped[:400].sum())
    assert made.spread("accuracy").mean == pytest.approx((stable + slip) / 800)
    assert made.rows["table"].value_counts().to_dict() == {"palm_down": 400, "palm_side": 400}
    assert (made.seeds, made.folds, made.test_grasps) == ([0, 1], 4, 100.0)
    assert set(made.trainings["train_grasps"]) == {300}
    low, high = f1_interval(made.of_variant()) or (1.0, 0.0)
    assert low < made.spread().mean < high


def test_streams_and_refused_grasps_are_counted_apart() -> None:
    parts = []
    for split in splits("days", GRASPS, 0, 2):
        test = split.test
        table = np.array([file.name for file in GRASPS.files])[GRASPS.table_of[test]]
        sign = -1.0 if split.name.startswith("B") else 1.0
        parts.append(
            pd.DataFrame(
                {
                    "fold_name": split.name,
                    "margin": sign * TRUTH[test],
                    "slipped": GRASPS.slipped[test],
                    "table": table,
                    "refused": pd.array(table == "palm_45", dtype="boolean"),
                }
            )
        )
    found = by_day(pd.concat(parts, ignore_index=True))
    rights = [found[name]["every"]["f1"] for name in ("A palm_45", "B palm_down", "C palm_side")]
    assert rights == [1.0, 0.0, 1.0]
    first = found["A palm_45"]
    assert (first["every"]["grasps"], first["coverage"]) == (200, 0.0)
    assert first["judged"]["slips_among_stable"] is None
    assert first["refused_slipped"] == pytest.approx(GRASPS.slipped[400:].mean())
    assert found["A and C"]["coverage"] == pytest.approx(2 / 3)
    assert found["B palm_side"]["every"]["slips_called_stable"] == 1.0
    slips = int(GRASPS.slipped[:400].sum())
    every = 2 * slips + int(GRASPS.slipped[400:].sum())
    assert found["all"]["every"]["slips_called_stable"] == pytest.approx(slips / every)


def test_written_figures_are_read_and_foreign_files_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    made = figures_of("cnn1", "cv", wrong=0.1)
    write(made, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["cnn1.cv.parquet"]
    for name, other in (("cnn2", {"system": "cnn2"}), ("cnn3", {"data": "other"})):
        write(dataclasses.replace(made, rows=made.rows.assign(protocol=name, **other)), tmp_path)
    (tmp_path / "rf.cv.parquet").write_text("{")
    digests = {name: digest(system) for name, system in SYSTEMS.items()}
    with caplog.at_level(logging.WARNING):
        (found,) = read(tmp_path, GRASPS.digest(), digests)
    assert len(caplog.records) == 3
    pd.testing.assert_frame_equal(found.scores, made.scores)


def rows(text: str, section: int) -> list[list[str]]:
    """Cells of the table's rows in the section with this number of the page `text`."""
    part = text.split("\n## ")[section]
    lines = [line for line in part.splitlines() if line.startswith("| ") and "| --- |" not in line]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_the_papers_figures_stand_beside_ours() -> None:
    ours = figures_of("cnn1", "cv", wrong=0.1)
    f1 = ours.spread()
    text = results_table([ours], GRASPS, *MADE)
    first = rows(text, 1)
    assert "## Findings" not in text
    found = {(row[0], row[1], row[2]): row[3:] for row in first}
    assert found["`cnn1`", "`cv`", "F1"] == [
        "94.2 +- 0.8",
        f"{100 * f1.mean:.1f} +- {100 * f1.std:.1f}",
        f"{100 * f1.mean - 94.2:+.1f}",
    ]
    assert found["`cnn1`", "`unknown`", "F1"] == ["87.7 +- 0.4", "-", "-"]
    del found["`cnn1`", "`cv`", "F1"]
    assert all(row[1:] == ["-", "-"] for key, row in found.items() if key[0] != "system")


def test_every_published_row_is_there_even_if_nothing_was_run() -> None:
    """The page has the figures of arXiv:1809.05551: table III, figure 4, sections III-B to E."""
    _head, *published = rows((ROOT / "models/RESULTS.md").read_text(), 2)
    assert len(published) == 24
    shown = rows(results_table([], GRASPS, *MADE), 1)
    for row in published:
        assert [*row[:4], "-", "-"] in shown


def test_the_session_table_has_f1_by_number_of_calibration_grasps() -> None:
    ours = figures_of("svm-session", "session", wrong=0.2)
    assert ours.headline == "n50"
    assert list(by_age(ours.of_variant("running"))) == [0, 5, 10, 20]
    _, row, *_ = rows(results_table([ours], GRASPS, *MADE), 3)
    f1 = ours.spread()
    value = f"{100 * f1.mean:.1f} +- {100 * f1.std:.1f}"
    assert row == ["`svm-session`", value, "-", "-", "-", value, "-", value, "-"]


def test_differences_are_taken_fold_by_fold_on_common_seeds() -> None:
    good, bad = figures_of("cnn2", "cv", 0.05, seeds=3), figures_of("cnn1", "cv", 0.15, seeds=2)
    mean, error = difference(good, bad) or (0.0, None)
    assert error is not None
    figures = [each.folds_of("f1").to_numpy()[:2] for each in (good, bad)]
    gaps = (figures[0] - figures[1]).ravel()
    assert len(gaps) == 8
    assert mean == pytest.approx(gaps.mean())
    # Four folds: 100 judged, 300 trained on.
    assert error == pytest.approx(np.sqrt((1 / 8 + 1 / 3) * gaps.var(ddof=1)))
    fifth = rows(results_table([bad, good], GRASPS, *MADE), 5)
    cell = f"{100 * mean:+.1f} +- {100 * error:.1f}"
    assert ["`cnn2`", "`cv`", cell, "-"] in fifth


def test_only_the_same_splits_are_compared() -> None:
    one, alone = figures_of("cnn1", "cv", 0.1), figures_of("cnn2", "unknown", 0.1)
    other = one.scores.rename(index={0: 8, 1: 9}, level="seed")
    assert difference(one, dataclasses.replace(one, scores=other)) is None
    assert difference(one, alone) is None
