"""Convert counts of grasps, given as a table, an array or lists, to one array. No table library is
imported: a table only has to give its column names, and each column by name."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graspd.biotac import COUNT_MAX, ELECTRODES, FINGERS, Finger, electrode_columns, electrode_name


def counts_of(given: ArrayLike, fingers: Sequence[Finger] = ()) -> NDArray[np.float64]:
    """Return the counts of n grasps, shape (n, fingers, 24), NaN for a broken electrode.

    `given`: a table of pandas, polars or Arrow, or columns by name, such as `ff_biotac_1`; or an
    array or nested lists of that shape. A missing or masked value is a broken electrode.
    `fingers`: fingers to take from a table, or those of an array, in order; empty: all of a table,
    or any of an array.
    Raises `ValueError` for anything else, and for values that are not counts.
    """
    names = column_names(given)
    if names:
        fingers = fingers or fingers_of(names)
        counts = _of_table(given, names, fingers)
    else:
        counts = _numbers(given, "counts")
    number = len(fingers) or (counts.shape[1] if counts.ndim == 3 else 0)
    if counts.ndim != 3 or counts.shape[1:] != (number, ELECTRODES) or not 0 < number <= 5:
        takes = f"{len(fingers)}, {ELECTRODES}): {', '.join(fingers)}"
        raise ValueError(
            f"counts have shape {counts.shape}; it takes (n, "
            + (takes if fingers else f"fingers, {ELECTRODES})")
        )
    _check_range(counts, fingers)
    return counts


def column_names(given: object) -> list[str]:
    """Return a table's column names; empty: not a table. Raises `ValueError` for a lazy table."""
    if isinstance(given, Mapping):
        return list(given)
    if not hasattr(given, "__array__"):
        if hasattr(type(given), "columns"):
            raise ValueError(f"a {type(given).__name__} has no values yet: collect it first")
        return []
    names = getattr(getattr(given, "dtype", None), "names", None)  # a structured array
    for attribute in ("columns", "column_names"):
        names = getattr(given, attribute, names)
    return [] if names is None else list(names)


def fingers_of(names: Sequence[str]) -> tuple[Finger, ...]:
    """Return the fingers whose first electrode is in the column `names`, in the hand's order."""
    return tuple(finger for finger in FINGERS if electrode_columns(finger)[0] in names)


def write_csv(table: Any, folder: str) -> Path:  # noqa: ANN401
    """Write `table.csv` in a folder, missing values as `nan` or empty; return the path.

    NUL is left out of text; what UTF-8 cannot encode is escaped, as `\\udcff`. Raises `ValueError`
    for a column that occurs twice, is of float16, or differs in length.
    """
    names, path = column_names(table), Path(folder, "table.csv")
    columns = [_cells(column, what) for what, column in _columns(table, names, names).items()]
    with path.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        rows = [names, *zip(*columns, strict=True)]
        csv.writer(file, quoting=csv.QUOTE_NONNUMERIC).writerows(rows)  # `#1` is not a comment
    return path


def _cells(column: Any, what: str) -> list[Any]:  # noqa: ANN401
    """Return a column's values as they are written into a file; `what` names it in errors."""
    values: Any = np.ma.array(column)
    _refuse_rounded(values.dtype, what)
    if values.dtype.kind == "b":
        values = values.astype(int)  # an outcome
    elif values.dtype == np.float32:
        values = values.astype(str)  # 28.35, not 28.350000381, which it is as a double
    elif values.dtype.kind in "mM":  # dates as text, because numbers would have a unit
        since = values - values.dtype.type(0, "us")
        if since.dtype != np.dtype("m8[us]"):  # finer, which a cast would cut
            since = since + np.timedelta64(500, "ns")
        values = np.datetime64(0, "us") + since.astype("timedelta64[us]")
    cells: list[Any] = values.tolist()
    return [cell.replace("\0", "") if isinstance(cell, str) else cell for cell in cells]


def check_fingers(fingers: Sequence[str]) -> None:
    """Raise `ValueError` for a name that is not a finger's, or that occurs twice."""
    unknown = [finger for finger in fingers if finger not in FINGERS]
    if unknown:
        raise ValueError(f"no finger is called {unknown[0]!r}: they are {', '.join(FINGERS)}")
    if len(set(fingers)) != len(fingers):
        raise ValueError(f"a finger is there twice: {', '.join(fingers)}")


def _of_table(table: Any, names: Sequence[str], fingers: Sequence[str]) -> NDArray[np.float64]:  # noqa: ANN401
    needed = [name for finger in fingers for name in electrode_columns(finger)]
    missing = [name for name in needed if name not in names]
    if missing or not needed:
        begin = ", ".join(map(str, names[:3]))
        first = missing[0] if missing else "ff_biotac_1"
        raise ValueError(f"the table has no column {first}; its columns begin with {begin}")
    columns = [_numbers(column, what) for what, column in _columns(table, needed, names).items()]
    return np.stack(columns, axis=-1).reshape(-1, len(fingers), ELECTRODES)


def _columns(table: Any, needed: Sequence[str], names: Sequence[str]) -> dict[str, Any]:  # noqa: ANN401
    """Return the `needed` columns, with None for pandas' NA. Keys are `the column NAME`.

    `names`: all columns. Raises `ValueError` for one that occurs twice or differs in length."""
    found: dict[str, Any] = {}
    shape = None
    for name in needed:
        what = f"the column {name}"
        if names.count(name) > 1:
            raise ValueError(f"the table has {what} more than once")
        column = table[name]
        values = np.asarray(column)
        shape = (values.size,) if shape is None else shape
        if values.shape != shape:
            raise ValueError(f"{what} has shape {values.shape}, and others {shape}")
        if values.dtype.kind == "O" and hasattr(column, "isna"):
            values = values.copy()
            values[np.asarray(column.isna())] = None
        found[what] = column if isinstance(column, np.ma.MaskedArray) else values
    return found


def _numbers(given: Any, what: str) -> NDArray[np.float64]:  # noqa: ANN401
    """Return values as numbers, NaN for missing or masked ones; `what` names them in errors.

    Raises `ValueError` for text, float16 and lists of different lengths.
    """
    try:
        # numpy loses the masks of arrays within lists.
        nested = isinstance(given, list | tuple) and any(
            isinstance(each, list | tuple) for each in given
        )
        values: Any = np.ma.stack(list(map(np.ma.array, given))) if nested else np.ma.array(given)
    except ValueError as error:
        raise ValueError(f"{what}: lists of different lengths") from error
    _refuse_rounded(values.dtype, what)
    if values.dtype.kind not in "iuf":
        odd = [each for each in values.compressed().tolist() if not _is_number(each)]
        if odd:
            raise ValueError(f"{what}: {odd[0]!r} and the like are not numbers")
    counts: NDArray[np.float64] = values.astype(np.float64).filled(np.nan)
    return counts


def _refuse_rounded(dtype: np.dtype[Any], what: str) -> None:
    if dtype == np.float16:
        raise ValueError(f"{what}: float16 rounds counts above 2048: give integers or float32")


def _is_number(value: object) -> bool:
    """Return True for a number, and for None, which is a missing number."""
    return value is None or (isinstance(value, Real) and not isinstance(value, bool))


def _check_range(counts: NDArray[np.float64], fingers: Sequence[Finger]) -> None:
    inside = (counts >= 0) & (counts <= COUNT_MAX) & (counts == np.trunc(counts))
    wrong = np.argwhere(~(inside | np.isnan(counts)))
    if len(wrong):
        grasp, finger, place = wrong[0].tolist()
        name = electrode_name(fingers[finger] if fingers else f"finger {finger}, electrode", place)
        raise ValueError(
            f"counts must be whole numbers in 0..{COUNT_MAX}, or NaN; of grasp {grasp} (from 0) "
            f"{name} has {counts[grasp, finger, place]:g}"
        )
