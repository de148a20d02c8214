"""Grasp tables: the real ones against the facts published of them, broken ones against errors."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from graspd.models import zoo
from graspd.models.bts3 import TABLES
from graspd.models.training.data.datasets import (
    DatasetError,
    concatenate,
    read_all,
    read_table,
    read_with_lab_tables,
    unpublished,
)
from tests.kit.tables import write_table
from tests.models.training.samples import (
    separable_counts,
    table,
    write,
    write_sessions,
)

STABLE_AND_SLIP = {"palm_down": (667, 609), "palm_side": (603, 670), "palm_45": (1058, 1075)}
"""Grasps of each table, as recorded when the data was taken in."""
CARD = {table["name"]: table for table in zoo.card("small-session")["contract"]["datasets"]}
"""Published tables by name, as listed in the card of `small-session`, which is made of them."""


def test_a_published_table_is_read_whole(bts3_dir: Path) -> None:
    for name, counted in STABLE_AND_SLIP.items():
        rows, sha256 = sum(counted), CARD[name]["sha256"]
        path = bts3_dir / f"{name}.csv"
        grasps = read_table(path)
        assert len(grasps) == rows
        assert (int((~grasps.slipped).sum()), int(grasps.slipped.sum())) == counted
        assert len(set(grasps.objects)) == 41
        (file,) = grasps.files
        assert (file.name, file.sha256, file.rows) == (name, sha256, rows)
        assert hashlib.sha256(path.read_bytes()).hexdigest() == sha256
        assert unpublished(grasps.files) == []


def test_a_folders_tables_are_read_in_their_fixed_order(bts3_dir: Path) -> None:
    grasps = read_all(bts3_dir)
    whole = grasps.rows(grasps.rows_of(("palm_down", "palm_side")))
    assert (len(grasps), len(whole), int(whole.slipped.sum())) == (4682, 2549, 1279)
    assert 5 <= int(whole.counts.min()) < int(whole.counts.max()) <= 3975
    assert [file.name for file in grasps.files] == list(STABLE_AND_SLIP)
    assert np.array_equal(grasps.counts[:1276], read_table(bts3_dir / "palm_down.csv").counts)


def test_the_list_of_published_tables_has_recorded_rows_and_digests() -> None:
    listed = [{"name": each.name, "sha256": each.sha256, "rows": each.rows} for each in TABLES]
    assert listed == list(CARD.values())
    assert [table.upstream_name for table in TABLES] == [f"bts3v2_{name}.csv" for name in CARD]


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("mf_biotac_7,", "", "line 1, column mf_biotac_7: this column is missing"),
        ("slipped,", "kept,", "line 1, column slipped: column is missing"),
        ("\nball,", "\n,", "column object: object has no name"),
        (",1,", ",yes,", "column slipped: 'yes' is not an outcome"),
        (",1,", ",1,-", "is not a count"),
    ],
)
def test_a_broken_table_is_refused_with_its_line_number(
    tmp_path: Path, before: str, after: str, message: str
) -> None:
    path = tmp_path / "palm_down.csv"
    write_table(path, *separable_counts(6))
    assert before in path.read_text()
    path.write_text(path.read_text().replace(before, after, 1))
    with pytest.raises(DatasetError) as caught:
        read_table(path)
    assert str(caught.value).startswith(f"{path}, line ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("column", ["object", "about"], ids=["blank", "missing"])
def test_a_table_without_object_names_has_one_object(tmp_path: Path, column: str) -> None:
    path, counts = tmp_path / "lab.csv", separable_counts(20)
    write_table(path, *counts, [""] * 20)
    path.write_text(path.read_text().replace("object", column, 1))
    assert read_table(path).objects == ("unknown",) * 20


def test_missing_files_and_folders_are_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="nowhere: no such folder"):
        read_all(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match=r"palm_down\.csv: cannot read: No such file"):
        read_all(tmp_path)


@pytest.fixture
def made_up(tmp_path: Path) -> Path:
    """Folder of two tables of six grasps."""
    for seed, name in enumerate(("palm_down", "palm_side")):
        write_table(tmp_path / f"{name}.csv", *separable_counts(6, seed))
    return tmp_path


def test_selected_rows_keep_their_counts_labels_and_tables(made_up: Path) -> None:
    whole = read_all(made_up)
    assert unpublished(whole.files) == ["palm_down", "palm_side"]
    some = whole.rows(np.array([1, 5, 7]))
    assert np.array_equal(some.counts, whole.counts[[1, 5, 7]])
    assert some.slipped.tolist() == [True, True, True]
    assert some.table_of.tolist() == [0, 0, 1]
    assert [file.rows for file in some.files] == [2, 1]
    assert some.digest() != whole.digest()
    assert whole.rows(np.arange(12)).digest() == whole.digest()


def test_the_digest_changes_with_each_part_of_grasps(made_up: Path) -> None:
    down, side = (read_table(made_up / f"{name}.csv") for name in ("palm_down", "palm_side"))
    digests = {
        concatenate([down, side]).digest(),
        concatenate([side, down]).digest(),
        dataclasses.replace(down, slipped=~down.slipped).digest(),
        dataclasses.replace(down, objects=("cup",) * 6).digest(),
        dataclasses.replace(down, counts=down.counts + np.uint16(1)).digest(),
        down.digest(),
    }
    assert len(digests) == 6


def refusal(lab: Sequence[Path], folder: Path | None = None) -> str:
    with pytest.raises(DatasetError) as caught:
        read_with_lab_tables(folder, lab)
    return str(caught.value)


@pytest.mark.parametrize(
    ("name", "rows", "problem"),
    [
        ("palm_45", range(80), "has the name of a published table: rename it, or use --data"),
        ("la\nb", range(80), "has a name that cannot be printed"),
        ("lab", range(19), "has 19 grasps, 20 are the fewest"),
        ("lab", range(0, 80, 2), "has no grasp that slipped, a session needs both kinds"),
        ("lab", range(1, 80, 2), "has no grasp that stayed, a session needs both kinds"),
        ("lab", (*range(80), 7), "has counts twice: the same grasp counts once"),
    ],
)
def test_a_lab_table_of_bad_name_or_grasps_is_refused(
    name: str, rows: Sequence[int], problem: str, tmp_path: Path
) -> None:
    counts, slipped = separable_counts(80)
    path = tmp_path / f"{name}.csv"
    write_table(path, counts[list(rows)], slipped[list(rows)])
    assert refusal([path]) == f"{path}: {problem}"


def test_repeated_readings_of_a_grasp_count_as_one(tmp_path: Path) -> None:
    counts, slipped = separable_counts(19)
    noise = np.random.default_rng(1).normal(0.0, 3.0, (6 * 19, 3, 24))
    readings = (counts.repeat(6, axis=0) + noise).round().astype(np.uint16)
    path = tmp_path / "lab.csv"
    write_table(path, readings, slipped.repeat(6))
    with pytest.raises(DatasetError, match="has 19 grasps, 20 are the fewest"):
        read_with_lab_tables(None, [path], "table")


def test_a_grasp_that_is_in_two_tables_is_refused(tmp_path: Path) -> None:
    data, monday, both = (tmp_path / name for name in ("data", "monday.csv", "both.csv"))
    write_sessions(data, 40)
    write(monday, table("monday", 40, 3))
    for first in (monday, data / "palm_45.csv"):
        both.write_bytes(first.read_bytes())
        said = f"has counts that are in {first.stem}, too: the same grasp counts once"
        assert refusal([monday, both], data) == f"{both}: {said}"


def test_two_lab_tables_of_one_name_are_refused(tmp_path: Path) -> None:
    paths = [tmp_path / day / "lab.csv" for day in ("monday", "friday")]
    for seed, path in enumerate(paths):
        path.parent.mkdir()
        write(path, table("lab", 40, seed))
    assert refusal(paths) == f"{paths[1]}: has the same name as {paths[0]}: rename one"


def test_a_table_has_the_fingers_of_its_header(tmp_path: Path) -> None:
    counts, slipped = separable_counts(30)
    write_table(tmp_path / "three.csv", counts, slipped)
    write_table(tmp_path / "two.csv", counts[:, [0, 2]], slipped, fingers=("ff", "th"))
    two = read_table(tmp_path / "two.csv")
    assert two.fingers == ("ff", "th")
    np.testing.assert_array_equal(two.counts, counts[:, [0, 2]])
    both = concatenate([read_table(tmp_path / "three.csv"), two])
    assert both.fingers == ("ff", "th")
