"""Recordings written for tests: grasp tables and streams, with cells replaced at will."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from graspd.drivers.base import RecordingError
from graspd.drivers.recordings.csv_rows import Recording, Row
from graspd.drivers.recordings.layout import survey

FINGERS = ("ff", "mf", "th")
ELECTRODES = [f"{finger}_biotac_{number}" for finger in FINGERS for number in range(1, 25)]
TABLE_HEADER = ["object", "slipped", *ELECTRODES]


def count(row: int, electrode: int) -> int:
    """A count that tells its row and its electrode, 0..71."""
    return 1000 + (row * (37 if electrode % 2 else 87) + electrode) % 2000


def cells(row: int, changes: Mapping[str, str] | None = None) -> dict[str, str]:
    """One row of a table by column name; `changes` replaces cells."""
    values = {"object": f"thing_{row}", "slipped": str(row % 2)}
    values.update({name: str(count(row, index)) for index, name in enumerate(ELECTRODES)})
    values.update(changes or {})
    return values


def line(columns: Sequence[str], values: Mapping[str, str]) -> str:
    return ",".join(values[name] for name in columns)


def table(
    rows: int = 3,
    changes: Mapping[int, Mapping[str, str]] | None = None,
    columns: Sequence[str] = TABLE_HEADER,
    end: str = "\n",
) -> bytes:
    """A table of `rows`; `changes` replaces cells by row (from 0) and column name. `end`: that of
    each line."""
    lines = [",".join(columns)]
    lines += [line(columns, cells(row, (changes or {}).get(row))) for row in range(rows)]
    return "".join(text + end for text in lines).encode()


def stream(
    times: Sequence[str],
    joints: Mapping[str, Sequence[str]] | None = None,
    columns: Sequence[str] | None = None,
) -> bytes:
    """A stream without labels; `joints`: cells by joint column; `columns`: header, None for all."""
    joints = joints or {}
    columns = columns or ["t", *ELECTRODES, *joints]
    lines = [",".join(columns)]
    for row, t in enumerate(times):
        changes = {"t": t} | {name: angles[row] for name, angles in joints.items()}
        lines.append(line(columns, cells(row, changes)))
    return "\n".join([*lines, ""]).encode()


def write(folder: Path, content: bytes, name: str = "grasps.csv") -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


PATH = Path("grasps.csv")


def rows_of(
    content: bytes,
    fingers: Sequence[str] = FINGERS,
    *,
    strict: bool = False,
    outcomes: bool = False,
) -> list[Row]:
    file = io.BytesIO(content)
    layout = survey(PATH, file, fingers)
    return list(Recording(PATH, file, layout, strict=strict, outcomes=outcomes))


def rows_or_message(content: bytes) -> list[Row] | str:
    try:
        return rows_of(content)
    except RecordingError as error:
        return str(error)


def refusal(content: bytes, fingers: Sequence[str] = FINGERS) -> str:
    """Why a recording is refused, in one line."""
    with pytest.raises(RecordingError) as caught:
        rows_of(content, fingers)
    assert "\n" not in str(caught.value)
    return str(caught.value)
