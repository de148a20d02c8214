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
"""Of one lab table: the number from which the daemon takes a session for calibrated."""
ENOUGH_GRASPS = 200
"""Of lab tables without the published ones. The daemon refuses readings that are unlike all of the
training: of other grasps of palm_45, 98 % by 20 of its grasps, 20 % by 100, 6 % by 200, 2.5 % by
500."""


def read_with_lab_tables(folder: Path | None, lab: Sequence[Path]) -> Grasps:
    """The published tables of `folder`, if it is given, and after them each lab table.

    Raises `DatasetError` for a file that is no grasp table, and for a lab table that has the name
    of another, repeats a grasp, has grasps of one label only or fewer than `FEWEST_GRASPS`;
    `ValueError` if there is neither a folder nor a lab table.
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
    """A grasp that is there twice would be trained on and judged by: figures too good."""
    first: dict[bytes, str] = {}
    for table, counts in zip(grasps.table_of.tolist(), grasps.counts, strict=True):
        name, key = grasps.files[table].name, counts.tobytes()
        if key in first and name in lab:
            where = "twice" if first[key] == name else f"that are in {first[key]}, too"
            raise DatasetError(lab[name], f"has counts {where}: the same grasp counts once")
        first.setdefault(key, name)
