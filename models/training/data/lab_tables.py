"""Lab tables: grasp tables of the user's own hand, beside the published ones or alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from graspd.models.bts3 import TABLES
from graspd.models.training.data.datasets import (
    DatasetError,
    Grasps,
    concatenate,
    read_all,
    read_table,
)

FEWEST_GRASPS = 20
"""Fewest grasps of a lab table; from this number a session counts as calibrated."""
ENOUGH_GRASPS = 200
"""Fewest grasps of lab tables without the published ones.

The daemon refuses readings that are unlike the training. With 20 grasps of palm_45 in the training
it refuses 98 % of the others; with 100 grasps 20 %, with 200 6 %, with 500 2.5 %.
"""


def read_with_lab_tables(folder: Path | None, lab: Sequence[Path]) -> Grasps:
    """Return the published tables of `folder`, if given, then each lab table.

    Raises `DatasetError` for a file that is no grasp table. A lab table is also refused if it has
    the name of another, repeats a grasp, has only one label, or under `FEWEST_GRASPS` grasps.
    Raises `ValueError` if there is neither a folder nor a lab table.
    """
    parts = [] if folder is None else [read_all(folder)]
    paths: dict[str, Path] = {}
    for path in lab:
        _check_name(path, paths)
        paths[path.stem] = path
        parts.append(_read_lab_table(path))
    grasps = concatenate(parts)
    _check_once(grasps, paths)
    return grasps


def _check_name(path: Path, others: dict[str, Path]) -> None:
    name = path.stem
    if not name.isprintable():
        raise DatasetError(path, "has a name that cannot be printed")
    if name in {table.name for table in TABLES}:
        raise DatasetError(path, "has the name of a published table: rename it, or use --data")
    if name in others:
        raise DatasetError(path, f"has the same name as {others[name]}: rename one")


def _read_lab_table(path: Path) -> Grasps:
    grasps = read_table(path)
    if len(grasps) < FEWEST_GRASPS:
        raise DatasetError(path, f"has {len(grasps)} grasps, {FEWEST_GRASPS} are the fewest")
    if grasps.slipped.all() or not grasps.slipped.any():
        kind = "stayed" if grasps.slipped.all() else "slipped"
        raise DatasetError(path, f"has no grasp that {kind}, a session needs both kinds")
    return grasps


def _check_once(grasps: Grasps, lab: dict[str, Path]) -> None:
    """Raise `DatasetError` if a grasp is there twice: training and test would share it."""
    first: dict[bytes, str] = {}
    for table, counts in zip(grasps.table_of.tolist(), grasps.counts, strict=True):
        name, key = grasps.files[table].name, counts.tobytes()
        if key in first and name in lab:
            where = "twice" if first[key] == name else f"that are in {first[key]}, too"
            raise DatasetError(lab[name], f"has counts {where}: the same grasp counts once")
        first.setdefault(key, name)
