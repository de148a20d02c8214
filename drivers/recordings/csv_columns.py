"""Which column of a recording holds what: the header of a CSV file, checked against the fingers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.base import ELECTRODES, FINGERS, RecordingError
from drivers.hand import joint_name

TIME = "t"
"""Seconds, any offset. A file with this column is a stream; one without it is a grasp table."""
OBJECT = "object"
SLIPPED = "slipped"


def electrode_columns(finger: str) -> list[str]:
    """Column names of one finger, E1 first, as the BioTac SP Stability Set writes them."""
    return [f"{finger}_biotac_{electrode}" for electrode in range(1, ELECTRODES + 1)]


@dataclass(frozen=True, slots=True)
class Columns:
    """Where a row keeps what is read; all indices count cells from 0."""

    names: tuple[str, ...]
    """Every column of the file, left to right."""
    electrodes: tuple[int, ...]
    """Finger by finger as asked for, E1..E24 each."""
    time: int | None
    object_name: int | None
    slipped: int | None
    joints: tuple[int, ...]
    """Empty for tables."""
    joint_names: tuple[str, ...]
    """Without hand prefix, in the order of `joints`."""
    ignored: tuple[str, ...]
    """Columns of unknown names. Those of fingers not asked for are known."""

    @classmethod
    def from_header(
        cls, path: Path, line: int, cells: Sequence[str], fingers: Sequence[str]
    ) -> Columns:
        """Find the columns in the header's cells. Raises `RecordingError` if they are not there."""
        names = tuple(cell.strip() for cell in cells)
        electrode_names = [name for finger in fingers for name in electrode_columns(finger)]
        is_stream = TIME in names
        joints = {name: joint for name in names if is_stream and (joint := joint_name(name))}
        read = [*electrode_names, TIME, OBJECT, SLIPPED, *joints]
        _refuse_duplicates(path, line, names, frozenset(read), joints)
        place = {name: index for index, name in enumerate(names)}
        _refuse_missing(path, line, [name for name in electrode_names if name not in place])
        known = {name for finger in FINGERS for name in electrode_columns(finger)}.union(read)
        return cls(
            names=names,
            electrodes=tuple(place[name] for name in electrode_names),
            time=place.get(TIME),
            object_name=place.get(OBJECT),
            slipped=place.get(SLIPPED),
            joints=tuple(place[name] for name in joints),
            joint_names=tuple(joints.values()),
            ignored=tuple(name for name in names if name not in known),
        )


def _refuse_duplicates(
    path: Path, line: int, names: Sequence[str], read: frozenset[str], joints: dict[str, str]
) -> None:
    """A column that is read must stand once, and a joint under one name only."""
    seen: dict[str, str] = {}
    for name in names:
        if name not in read:
            continue
        value = joints.get(name, name)
        if value in seen:
            first = seen[value]
            problem = "stands twice" if first == name else f"is the same joint as {first}"
            raise RecordingError(path, f"this column {problem}", line=line, column=name)
        seen[value] = name


def _refuse_missing(path: Path, line: int, missing: Sequence[str]) -> None:
    if not missing:
        return
    problem = "this column is missing"
    if len(missing) > 1:
        problem += f", the first of {len(missing)} that are"
    raise RecordingError(path, problem, line=line, column=missing[0])
