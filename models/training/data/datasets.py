"""Read grasp tables (BTS3): a row per grasp, with counts before the lift, object and outcome."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import TABLE_FINGERS, Finger
from graspd.drivers.base import RecordingError
from graspd.drivers.recordings.columns import OBJECT, SLIPPED
from graspd.drivers.recordings.csv_rows import read_rows
from graspd.drivers.recordings.layout import NEAR_COUNTS, ReadAs, layout_of
from graspd.models.bts3 import NEW_SESSION, TABLES, WHOLE
from graspd.models.contract import Dataset
from graspd.models.training.arrays import Bools, Ints

MAX_TABLE_BYTES = 64 * 2**20
"""Largest table that is read, bytes. 2133 grasps take 0.8 MB."""
FEWEST_GRASPS = 20
"""Fewest grasps of a lab table; from this number a session counts as calibrated."""
ENOUGH_GRASPS = 200
"""Number of grasps below which a training on lab tables alone is warned of.

Trained on 20 grasps of palm_45, the daemon refuses 98 % of its others as unlike the training; on
100 grasps 20 %, on 200 6 %, on 500 2.5 %.
"""
UNNAMED = "unknown"
"""Object of a table without object names, as `graspd export-grasps` calls it."""

DatasetError = RecordingError
"""A grasp table is missing or has wrong content. A retry cannot succeed."""


@dataclass(frozen=True, slots=True, eq=False)
class Grasps:
    """Labelled grasps and the files they come from."""

    counts: NDArray[np.uint16]
    """Shape (N, fingers, 24), raw counts 0..4095."""
    slipped: Bools
    """Shape (N,): True where the object slipped in the lift."""
    objects: tuple[str, ...]
    """Object name of each grasp."""
    files: tuple[Dataset, ...]
    """Name, digest and rows of each file, in the order of the grasps."""
    without_outcome: int = 0
    """Rows of the files that are left out, because their outcome is not known."""
    fingers: tuple[Finger, ...] = TABLE_FINGERS
    """Fingers in the order of the counts."""

    def __len__(self) -> int:
        return len(self.slipped)

    @property
    def table_of(self) -> Ints:
        """Shape (N,): index in `files` of the file that each grasp comes from."""
        return np.repeat(np.arange(len(self.files)), [file.rows for file in self.files])

    def rows(self, indices: Ints) -> Grasps:
        """Return only these grasps, indices ascending. Rows in `files` then count only these."""
        kept = np.bincount(self.table_of[indices], minlength=len(self.files))
        return Grasps(
            self.counts[indices],
            self.slipped[indices],
            tuple(self.objects[index] for index in indices),
            tuple(
                Dataset(file.name, file.sha256, int(rows))
                for file, rows in zip(self.files, kept, strict=True)
            ),
            fingers=self.fingers,
        )

    def few(self) -> Grasps:
        """Return every 20th grasp, to try a report quickly."""
        return self.rows(np.arange(0, len(self), 20))

    def rows_of(self, tables: Collection[str]) -> Ints:
        """Indices, ascending, of the grasps of the tables with these names."""
        wanted = [index for index, file in enumerate(self.files) if file.name in tables]
        return np.flatnonzero(np.isin(self.table_of, wanted)).astype(np.int64)

    def of_fingers(self, fingers: Sequence[Finger]) -> Grasps:
        """Return the grasps with these fingers alone, in this order.
        Raises `ValueError` for a finger that a table lacks."""
        if not set(fingers) <= set(self.fingers):
            have = ", ".join(self.fingers)
            raise ValueError(f"the grasps have not the fingers {', '.join(fingers)}, but {have}")
        chosen = [self.fingers.index(finger) for finger in fingers]
        counts = np.ascontiguousarray(self.counts[:, chosen])
        return dataclasses.replace(self, counts=counts, fingers=tuple(fingers))

    def digest(self) -> str:
        """SHA-256, hexadecimal, of counts, labels, objects and the tables' names and rows."""
        text = json.dumps([self.objects, [(file.name, file.rows) for file in self.files]])
        parts = (self.counts.tobytes(), self.slipped.tobytes(), text.encode())
        return hashlib.sha256(b"".join(parts)).hexdigest()


def read_table(path: Path, read_as: ReadAs | None = None) -> Grasps:
    """Read the grasps of one table that have an outcome.

    Without object names all grasps are of one object, `UNNAMED`.

    Pass `read_as="table"` for a table in which many rows repeat each other. Raises
    `DatasetError`, with file, line and column.
    """
    data = _read(path)
    layout = layout_of(path, (), read_as)
    fingers = layout.columns.fingers
    if layout.is_stream:
        raise DatasetError(path, "is a stream: its rows are sweeps, and not grasps")
    if layout.columns.slipped is None:
        raise DatasetError(path, "column is missing", line=1, column=SLIPPED)
    objects: list[str | None] = []
    nameless: list[int | None] = []
    slipped: list[bool] = []
    counts: list[NDArray[np.uint16]] = []
    without = 0
    for row in read_rows(path, fingers, strict=True, outcomes=True, layout=layout):
        note = row.annotation
        if note.slipped is None:
            without += 1
            continue
        if note.object_name is None:
            nameless.append(note.line)
        objects.append(note.object_name)
        slipped.append(note.slipped)
        counts.append(row.counts)
    if not counts:
        raise DatasetError(path, "has no grasp with an outcome")
    if 0 < len(nameless) < len(counts):
        raise DatasetError(path, "object has no name", line=nameless[0], column=OBJECT)
    return Grasps(
        np.array(counts),
        np.array(slipped, dtype=np.bool_),
        tuple(name or UNNAMED for name in objects),
        (Dataset(table_name(path), hashlib.sha256(data).hexdigest(), len(counts)),),
        without,
        fingers,
    )


def table_name(path: Path) -> str:
    """Return a table's name: its file's name without endings such as `.csv.gz`."""
    return Path(path.stem).stem if path.suffix == ".gz" else path.stem


def read_all(folder: Path) -> Grasps:
    """Return palm_down, palm_side and, if the folder has it, palm_45. Raises `DatasetError`."""
    if not folder.is_dir():
        raise DatasetError(folder, "no such folder")
    paths = [folder / f"{name}.csv" for name in (*WHOLE, NEW_SESSION)]
    return concatenate([read_table(path) for path in paths if path != paths[-1] or path.exists()])


def read_with_lab_tables(
    folder: Path | None, lab: Sequence[Path], read_as: ReadAs | None = None
) -> Grasps:
    """Return the published tables of `folder`, if given, then each lab table, the user's own.

    Raises `DatasetError` for a file that is not a grasp table. A lab table is also refused if it
    has the name of another or of a published one, has the exact counts of another grasp, only one
    label, or under `FEWEST_GRASPS` grasps. One of `folder` and `lab` must be given.
    """
    parts = [] if folder is None else [read_all(folder)]
    paths: dict[str, Path] = {}
    for path in lab:
        _check_name(path, paths)
        paths[table_name(path)] = path
        parts.append(_read_lab_table(path, read_as))
    grasps = concatenate(parts)
    check_once(grasps, paths)
    return grasps


def concatenate(parts: Sequence[Grasps]) -> Grasps:
    """Return the grasps of several tables in order, with the fingers that all tables have.

    Raises `DatasetError` if they have no finger in common.
    """
    has = set.intersection(*(set(part.fingers) for part in parts))
    fingers = tuple(finger for finger in parts[0].fingers if finger in has)
    if not fingers:
        raise DatasetError(Path(parts[-1].files[0].name), "has no finger of the other tables")
    parts = [part.of_fingers(fingers) for part in parts]
    return Grasps(
        np.concatenate([part.counts for part in parts]),
        np.concatenate([part.slipped for part in parts]),
        tuple(name for part in parts for name in part.objects),
        tuple(file for part in parts for file in part.files),
        sum(part.without_outcome for part in parts),
        fingers,
    )


def unpublished(files: Sequence[Dataset]) -> list[str]:
    """Return the names of files without both name and content of a published table."""
    published = {(table.name, table.sha256) for table in TABLES}
    return [file.name for file in files if (file.name, file.sha256) not in published]


def lab_table_names(files: Sequence[Dataset]) -> tuple[str, ...]:
    """Return the names of files that do not have a published table's name, in order."""
    published = {table.name for table in TABLES}
    return tuple(file.name for file in files if file.name not in published)


def _read(path: Path) -> bytes:
    try:
        if path.stat().st_size > MAX_TABLE_BYTES:
            raise DatasetError(path, f"larger than {MAX_TABLE_BYTES} bytes, not a grasp table")
        return path.read_bytes()
    except OSError as error:
        raise DatasetError(path, f"cannot read: {error.strerror}") from error


def _check_name(path: Path, others: dict[str, Path]) -> None:
    name = table_name(path)
    if not name.isprintable():
        raise DatasetError(path, "has a name that cannot be printed")
    if name in {table.name for table in TABLES}:
        raise DatasetError(path, "has the name of a published table: rename it, or use --data")
    if name in others:
        raise DatasetError(path, f"has the same name as {others[name]}: rename one")


def _read_lab_table(path: Path, read_as: ReadAs | None) -> Grasps:
    grasps = read_table(path, read_as)
    number = len(np.unique(first_readings(grasps.counts)))
    if number < FEWEST_GRASPS:
        raise DatasetError(path, f"has {number} grasps, {FEWEST_GRASPS} are the fewest")
    if grasps.slipped.all() or not grasps.slipped.any():
        kind = "stayed" if grasps.slipped.all() else "slipped"
        raise DatasetError(path, f"has no grasp that {kind}, a session needs both kinds")
    return grasps


def first_readings(counts: NDArray[np.uint16]) -> Ints:
    """Return the index of the first row of each row's group, shape (N,).

    Rows that nearly repeat each other, directly or by way of other rows, form a group."""
    from sklearn.cluster import DBSCAN

    if not len(counts):
        return np.empty(0, dtype=np.int64)
    rows = counts.reshape(len(counts), -1).astype(np.float64)
    apart_max = NEAR_COUNTS * math.sqrt(rows.shape[1])
    # Rows linked by near rows form a group; the tree compares only rows that may be near.
    linked = DBSCAN(apart_max, min_samples=1, algorithm="kd_tree").fit_predict(rows)
    _, first, of = np.unique(linked, return_index=True, return_inverse=True)
    found: Ints = first[of]
    return found


def check_once(grasps: Grasps, lab: Mapping[str, Path]) -> None:
    """Raise `DatasetError` if a lab table has the exact counts of an earlier grasp, which training
    and test could share.

    `lab`: path of each lab table by its name.
    """
    first: dict[bytes, str] = {}
    for table, counts in zip(grasps.table_of.tolist(), grasps.counts, strict=True):
        name, key = grasps.files[table].name, counts.tobytes()
        if key in first and name in lab:
            where = "twice" if first[key] == name else f"that are in {first[key]}, too"
            raise DatasetError(lab[name], f"has counts {where}: the same grasp counts once")
        first.setdefault(key, name)
