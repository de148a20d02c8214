"""Lab tables: what would mislead a training is refused in one line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from graspd.models.training.data.datasets import DatasetError, read_with_lab_tables
from tests.models.training.samples import (
    separable_counts,
    table,
    write,
    write_sessions,
    write_table,
)


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
def test_a_lab_table_that_would_mislead_is_refused(
    name: str, rows: Sequence[int], problem: str, tmp_path: Path
) -> None:
    counts, slipped = separable_counts(80)
    path = tmp_path / f"{name}.csv"
    write_table(path, counts[list(rows)], slipped[list(rows)])
    assert refusal([path]) == f"{path}: {problem}"


@pytest.mark.parametrize("beside", ["palm_45", "monday"])
def test_a_grasp_that_is_in_two_tables_is_refused(beside: str, tmp_path: Path) -> None:
    data = tmp_path / "data"
    write_sessions(data, 40)
    monday, both = tmp_path / "monday.csv", tmp_path / "both.csv"
    write(monday, table("monday", 40, 3))
    first = monday if beside == "monday" else data / "palm_45.csv"
    both.write_bytes(first.read_bytes())
    said = f"has counts that are in {beside}, too: the same grasp counts once"
    assert refusal([monday, both], data) == f"{both}: {said}"


def test_two_lab_tables_have_two_names(tmp_path: Path) -> None:
    paths = [tmp_path / day / "lab.csv" for day in ("monday", "friday")]
    for seed, path in enumerate(paths):
        path.parent.mkdir()
        write(path, table("lab", 40, seed))
    assert refusal(paths) == f"{paths[1]}: has the same name as {paths[0]}: rename one"
