"""Whether rows are grasps of a table or sweeps of a stream."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.drivers.base import RecordingError
from graspd.drivers.recordings.csv_player import DEMO_RECORDING, DEMO_TABLE
from graspd.drivers.recordings.csv_rows import read_rows
from graspd.drivers.recordings.layout import ReadAs, are_labelled, layout_of, problem_of_sweeps
from tests.drivers.recordings.tables import (
    FINGERS,
    stream,
    write,
)


def sweeps(number: int = 260) -> tuple[list[str], NDArray[np.str_]]:
    """Header and cells of the first `number` rows of the demo's stream; 260 hold one grasp."""
    header, *lines = DEMO_RECORDING.read_text().splitlines()[: number + 1]
    return header.split(","), np.array([line.split(",") for line in lines])


def written(names: Sequence[str], cells: NDArray[np.str_]) -> bytes:
    return "".join(",".join(row) + "\n" for row in [names, *cells.tolist()]).encode()


def layout(content: bytes, folder: Path, read_as: ReadAs | None = None) -> bool:
    rate_hz = 100.0 if read_as == "stream" else None
    return layout_of(write(folder, content), FINGERS, read_as, rate_hz).is_stream


@pytest.mark.parametrize("unit_s", [1e-3, 1e-6, 1e-9])
def test_the_unit_of_times_is_known_by_their_steps(tmp_path: Path, unit_s: float) -> None:
    names, cells = sweeps()
    place = names.index("t")
    cells[:, place] = [f"{float(value) / unit_s:.0f}" for value in cells[:, place]]
    found = layout_of(write(tmp_path, written(names, cells)), FINGERS)
    assert (found.is_stream, found.unit_s, found.has_outcomes) == (True, unit_s, True)


@pytest.mark.parametrize(
    ("first", "step", "unit_s"),
    [
        *((0, 1.9, 1.0), (0, 2, 1e-3), (0, 500, 1e-3), (0, 501, 1.0)),
        *((0.9e11, 1, 1.0), (1.1e11, 1, 1e-3), (0.9e14, 1, 1e-3), (1.1e14, 1, 1e-6)),
        *((0.9e17, 100, 1e-6), (1.1e17, 100, 1e-9)),
    ],
)
def test_the_unit_of_times_is_known_by_step_or_size(
    tmp_path: Path, first: float, step: float, unit_s: float
) -> None:
    """By steps of 2 to 500 ms, or by the size of a time since 1970, as 1.1e11 ms of 1973."""
    path = write(tmp_path, stream([f"{first + step * row}" for row in range(4)]))
    assert layout_of(path, FINGERS, "stream").unit_s == unit_s


@pytest.mark.parametrize(
    ("times", "said"),
    [
        *(([0.99 * n for n in range(12)], None), (range(12), "rows are 1 apart")),
        ([*[0, -1] * 2, *[0.1 * n for n in range(16)]], None),
        ([*[0, -1] * 3, *[0.1 * n for n in range(14)]], "3 of 20 rows have a time before"),
        *(([0, -0.1] * 5, "5 of 10 rows"), ([0, -0.1] * 4, None)),
        *(([1] * 10, "most rows have the time of the row before"), ([1] * 9, None)),
    ],
)
def test_slow_falling_or_standing_times_are_refused_beyond_limits(
    tmp_path: Path, times: Sequence[float], said: str | None
) -> None:
    path = write(tmp_path, stream([f"{t:g}" for t in times]))
    with nullcontext() if said is None else pytest.raises(RecordingError, match=said):
        assert layout_of(path, FINGERS).is_stream


@pytest.mark.parametrize(
    ("time", "apart_s"),
    [(lambda n: f"{60 * n + 60}", "0.06"), (lambda n: f"{n // 6:02}:{n % 6}0:00", "600")],
)
def test_grasps_with_times_minutes_apart_are_refused_without_read_as(
    tmp_path: Path, time: Callable[[int], str], apart_s: str
) -> None:
    header, *lines = DEMO_TABLE.read_text().splitlines()[:100]
    content = "\n".join(["time," + header, *(f"{time(n)},{line}" for n, line in enumerate(lines))])
    path = write(tmp_path, content.encode() + b"\n")
    with pytest.raises(RecordingError, match=rf"grasps .*--as table.* {apart_s} s apart .*--as st"):
        layout_of(path, FINGERS)
    assert not layout_of(path, FINGERS, "table").is_stream
    assert layout_of(path, FINGERS, "stream").is_stream


def test_a_rate_replaces_times_only_when_read_as_stream(tmp_path: Path) -> None:
    path = write(tmp_path, stream(["100.00", "100.01", "100.02", "100.03"]))
    layout = layout_of(path, FINGERS, "stream", 50.0)
    assert [row.t_s for row in read_rows(path, FINGERS, layout=layout)] == [0.0, 0.02, 0.04, 0.06]
    with pytest.raises(RecordingError, match="column t: the rows have times: --rate-hz is for"):
        layout_of(path, FINGERS, None, 50.0)


@pytest.mark.parametrize(
    ("times", "said"),
    [
        (["1.2", "0.9", "1.1", "0.7"], "100 of 200 rows have a time before that of the row above"),
        (["0.5"], "most rows have the time of the row before"),
    ],
)
def test_times_that_fall_or_stand_are_refused_without_read_as(
    tmp_path: Path, times: Sequence[str], said: str
) -> None:
    header, *lines = DEMO_TABLE.read_text().splitlines()
    rows = [f"{times[n % len(times)]},{line}\n" for n, line in enumerate(lines)]
    path = write(tmp_path, f"time,{header}\n{''.join(rows)}".encode())
    with pytest.raises(RecordingError, match=rf"column time: {said}.*grasps of a table \(--as tab"):
        layout_of(path, FINGERS)
    assert not layout_of(path, FINGERS, "table").is_stream
    assert layout_of(path, FINGERS, "stream", 10.0).is_stream


@pytest.mark.parametrize(("every", "mixed"), [(1, False), (10, True), (25, True)])
def test_sweeps_without_times_are_refused_unless_read_as_stream(
    tmp_path: Path, every: int, mixed: bool
) -> None:
    names, cells = sweeps(2000)
    cells = cells[::every]
    if mixed:
        cells = np.random.default_rng(1).permutation(cells)
    names[names.index("t")] = "number"
    content = written(names, cells)
    with pytest.raises(RecordingError, match=r"nearly repeat another: sweeps .*--as stream"):
        layout(content, tmp_path)
    assert layout(content, tmp_path, "stream")
    if every <= 10:
        with pytest.raises(RecordingError, match="change as sweeps of a stream do"):
            layout(content, tmp_path, "table")


def any_value(cells: NDArray[np.str_], random: np.random.Generator) -> None:
    for place in (5, 30, 60):
        cells[:, place] = random.integers(0, 4096, len(cells))


def missing(cells: NDArray[np.str_], random: np.random.Generator) -> None:
    cells[random.random(cells.shape) < 0.05] = ""


def noisy(cells: NDArray[np.str_], random: np.random.Generator) -> None:
    values = cells.astype(float) + random.normal(0.0, 8.0, cells.shape)
    cells[:] = np.clip(values, 0.0, 4095.0).astype(int)


@pytest.mark.parametrize("damage", [any_value, missing, noisy])
def test_sweeps_with_broken_electrodes_are_never_a_table(
    tmp_path: Path, damage: Callable[..., None]
) -> None:
    names, cells = sweeps()
    damage(cells[:, 3:75], np.random.default_rng(3))
    names[names.index("t")] = "number"
    content = written(names, cells)
    with pytest.raises(RecordingError, match=r"sweeps of a stream \(--as stream.*--as table"):
        layout(content, tmp_path)
    with pytest.raises(RecordingError, match="change as sweeps of a stream do"):
        layout(content, tmp_path, "table")


def test_repeated_readings_of_grasps_need_read_as_table(tmp_path: Path) -> None:
    header, *lines = DEMO_TABLE.read_text().splitlines()
    cells = np.array([line.split(",") for line in lines[:40]]).repeat(6, axis=0)
    noise = np.random.default_rng(2).normal(0.0, 5.0, (240, 72))
    cells[:, 2:] = np.round(cells[:, 2:].astype(float) + noise).astype(int)
    content = written(header.split(","), cells)
    with pytest.raises(RecordingError, match="240 of 240 rows nearly repeat another"):
        layout(content, tmp_path)
    assert not layout(content, tmp_path, "table")


@pytest.mark.parametrize(
    ("cells", "both"),
    [(["0", "1"], True), (["stable", "True"], True), (["0", "stable"], False), (["1", ""], False)],
)
def test_rows_are_labelled_if_lifts_ended_in_both_ways(cells: Sequence[str], both: bool) -> None:
    assert are_labelled(("mug", cell) for cell in cells) == both


@pytest.mark.parametrize(
    ("near", "between", "far", "labelled", "read_as", "said"),
    [
        *((4, 0, 16, True, None, None), (5, 0, 15, True, None, "5 of 20 rows nearly repeat")),
        *((4, 9, 7, True, None, None), (4, 10, 6, True, None, "most of 20 rows are much like")),
        *((2, 8, 10, False, None, None), (2, 9, 9, False, None, "most of 20 rows")),
        (3, 0, 17, False, None, "3 of 20 rows nearly"),
        *((18, 2, 0, False, "table", None), (17, 3, 0, False, "table", "change as sweeps")),
        *((14, 3, 2, False, "table", None), (13, 4, 2, False, "table", "change as sweeps")),
        *((49, 0, 1, False, "table", None), (50, 0, 1, False, "table", "change as sweeps")),
        *((9, 0, 0, False, "table", None), (10, 0, 0, False, "table", "change as sweeps")),
    ],
)
def test_rows_alike_beyond_each_limit_are_sweeps(
    near: int, between: int, far: int, labelled: bool, read_as: ReadAs | None, said: str | None
) -> None:
    """Rows up to 8 counts from another are near, up to 25 between, others far. By hand: 0.6 of all
    beyond 8 counts is 3 of 5, and 3.6 of 6."""
    steps = [26, *[8] * (near - 1), *[26, 9, *[25] * between][:between]]
    rows = np.cumsum(steps + [26] * far)[:, np.newaxis].repeat(24, axis=1).astype(np.float32)
    problem = problem_of_sweeps([rows], read_as, labelled=labelled)
    assert (problem is None) if said is None else said in (problem or "")


def test_few_repeated_grasps_need_labels_or_read_as_table(tmp_path: Path) -> None:
    header, *lines = DEMO_TABLE.read_text().splitlines()
    labelled = "\n".join([header, *lines[:100], *lines[:8], ""])
    unknown = labelled.replace("slipped", "x", 1).encode()
    assert not layout(labelled.encode(), tmp_path)
    with pytest.raises(RecordingError, match="16 of 108 rows nearly repeat another"):
        layout(unknown, tmp_path)
    assert not layout(unknown, tmp_path, "table")


@pytest.mark.parametrize(
    ("first", "rows", "said"),
    [
        (0, 16, "3 of 16 rows nearly repeat another"),
        (100, 12, "2 of 12 rows nearly repeat another"),
        (1250, 12, "most of 12 rows are much like another"),
    ],
)
def test_few_slow_sweeps_without_times_are_refused(
    tmp_path: Path, first: int, rows: int, said: str
) -> None:
    names, cells = sweeps(first + 25 * rows)
    names[names.index("t")] = "number"
    with pytest.raises(RecordingError, match=rf"{said}: sweeps of a stream .*--as table"):
        layout(written(names, cells[first::25]), tmp_path)


def test_published_grasps_are_tables(bts3_dir: Path, tmp_path: Path) -> None:
    for pose in ("down", "side", "45"):
        path = bts3_dir / f"palm_{pose}.csv"
        assert not layout_of(path, FINGERS).is_stream
        header, *lines = path.read_text().splitlines()
        few = "\n".join([header, *lines[:: len(lines) // 12]])
        assert not layout(few.encode() + b"\n", tmp_path)
