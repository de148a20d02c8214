"""Reading recordings: what is a row, what is a faulty value, and what is refused, and how."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from graspd.drivers.base import ElectrodeFault, RecordingError
from graspd.drivers.recordings.kinds import open_recording
from graspd.drivers.recordings.layout import survey
from graspd.drivers.recordings.values import count_of, problem_with, time_of
from tests.drivers.recordings.tables import (
    ELECTRODES,
    FINGERS,
    PATH,
    TABLE_HEADER,
    cells,
    count,
    line,
    refusal,
    rows_of,
    rows_or_message,
    stream,
    table,
)

LINE_LENGTH_MAX = 65_536


def test_a_table_gives_its_counts_and_annotations() -> None:
    rows = rows_of(table(3))
    for index, row in enumerate(rows):
        expected = np.array([count(index, electrode) for electrode in range(72)]).reshape(3, 24)
        np.testing.assert_array_equal(row.counts, expected)
        assert row.counts.dtype == np.uint16
        assert not row.faults.any()
        assert row.t_s is None
        assert row.joint_names == ()
        assert row.annotation.source == PATH
        assert row.annotation.line == index + 2
        assert row.annotation.object_name == f"thing_{index}"
        assert row.annotation.slipped == bool(index % 2)


def test_columns_may_stand_in_any_order() -> None:
    columns = [*reversed(ELECTRODES), "slipped"]
    (row,) = rows_of(table(1, columns=columns), ("th", "ff"))
    expected = [[count(0, 48 + k) for k in range(24)], [count(0, k) for k in range(24)]]
    np.testing.assert_array_equal(row.counts, expected)
    assert row.annotation.object_name is None


def test_only_unknown_columns_are_listed_as_ignored() -> None:
    header = [*TABLE_HEADER, "force", "", "s", "force", "FFJ3"]
    content = ",".join(header).encode() + b"\n" + b"0," * 78 + b"0\n"
    found = survey(PATH, io.BytesIO(content), ("mf",))
    assert found.columns.ignored == ("force", "", "s", "force")


GOOD = table(2)
BAD_FILES = {
    "empty": (b"", "grasps.csv: the file is empty"),
    "Latin-1": (table(2, {1: {"object": "x"}}).replace(b"x", b"\xe9"), "line 3: not UTF-8"),
    "odd UTF-16": (GOOD.decode().encode("utf-16")[:-1], "not UTF-16: this is a binary"),
    "one column missing": (
        table(2, columns=[name for name in TABLE_HEADER if name != "mf_biotac_7"]),
        "line 1, column mf_biotac_7: this column is missing; the file has the fingers ff, mf, th",
    ),
    "in a comment": (b"# " + GOOD.replace(b"ff_biotac_7,", b"x,"), "line 1, column ff_biotac_7: "),
    "a finger missing": (
        table(2, columns=TABLE_HEADER[:-24]),
        "line 1, column th_biotac_1: this column is missing, the first of 24 that are",
    ),
    "electrode twice": (
        table(2, columns=[*TABLE_HEADER, "ff_biotac_3"]),
        "line 1, column ff_biotac_3: this column is there twice",
    ),
    "short row": (
        GOOD + b"apple,0,12,13\n",
        "line 4: the row has 4 cells, the header 74",
    ),
    "long row": (
        GOOD.replace(b"thing_1", b"thing,1"),
        "line 3: the row has 75 cells, the header 74",
    ),
    "short row at the end": (
        GOOD + b"apple,0,12",
        "line 4: the row has 3 cells, the header 74; the file ends here without a line end",
    ),
    "no line ends": (b"7," * LINE_LENGTH_MAX, "line 1: the line is longer than 65536 characters"),
    "open quote": (GOOD.replace(b"thing_1", b'"thing_1'), "line 3: this is not CSV: unexpected"),
    "no header": (GOOD.split(b"\n", 1)[1], "line 1: has numbers in place of names: the header is"),
    "another header": (
        GOOD + GOOD.split(b"\n")[0] + b"\n",
        "line 4: has text in place of counts: another header, or units?",
    ),
    "one row with separators of thousands": (
        GOOD + GOOD.split(b"\n")[1].replace(b",1", b",1 ") + b"\n",
        "line 4: 72 of 72 values are not counts, whole numbers in 0..4095, the first is '1 000': "
        "write them without a separator of thousands",
    ),
    "a row of units": (
        GOOD + b"thing,0" + b",counts" * 72 + b"\n",
        "line 4: has text in place of counts: another header, or units?",
    ),
    "time backwards": (
        stream(["5", "5.01", "5.0"]),
        "line 4, column t: time goes backwards, from 5.01 s to 5.0 s",
    ),
    "a missing time of 64 bits": (
        stream([*(f"1700000000{n}0000000" for n in range(10, 50)), "18446744073709551615"]),
        "line 42, column t: 18446744073.7 s is too far from the first time, 1700000000.1 s",
    ),
    "a missing time among seconds": (
        stream([*(f"{n / 100}" for n in range(40)), "9223372036854775807"]),
        "line 42, column t: 9.22337203685e+18 s is too far from the first time, 0 s",
    ),
    "joint twice": (
        stream(["0"], {"rh_FFJ3": ["0"], "FFJ3": ["0"]}),
        "line 1, column FFJ3: this column is there twice, as rh_FFJ3 too",
    ),
}


@pytest.mark.parametrize(("content", "message"), BAD_FILES.values(), ids=BAD_FILES)
def test_a_wrong_recording_is_refused_with_line_and_column(content: bytes, message: str) -> None:
    with pytest.raises(RecordingError) as caught:
        rows_of(content)
    assert message in str(caught.value)
    assert str(caught.value).startswith("grasps.csv")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("read", "unread"),
    [
        *(("stable", "slipped"), ("stable", "unstable"), ("slip", "no slip")),
        *(("1", "-1"), ("1", "2"), ("0", "\u0661")),
    ],
)
@pytest.mark.parametrize("row", [1, 599])
def test_outcomes_of_which_only_a_part_is_readable_are_refused(
    read: str, unread: str, row: int
) -> None:
    changes = {each: {"slipped": read} for each in range(600)} | {row: {"slipped": unread}}
    told = f"line {row + 2}, column slipped: {unread!r} is not an outcome: 0, False or stable; 1, "
    assert told in refusal(table(600, changes))


def test_outcomes_all_unreadable_are_unknown_or_refused_if_required() -> None:
    content = table(3, {0: {"slipped": "yes"}, 1: {"slipped": ""}, 2: {"slipped": "no"}})
    assert [row.annotation.slipped for row in rows_of(content)] == [None] * 3
    with pytest.raises(RecordingError, match=r"line 2, column slipped: 'yes' is not an outcome"):
        rows_of(content, outcomes=True)


@pytest.mark.parametrize("t", ["nan", "", "1e999", "1_0"])
def test_a_cell_that_is_not_a_time_is_refused(t: str) -> None:
    with pytest.raises(RecordingError, match=r"line 2, column t: .* is not a time"):
        rows_of(stream([t, "1"]))


@pytest.mark.parametrize(
    ("cell", "t_s"),
    [
        ("2023-11-14T22:13:20.5Z", 1_700_000_000.5),
        ("2023-11-15 00:13:20.5+02:00", 1_700_000_000.5),
        ("9:05:20,5", 32_720.5),
        ("2 days 01:02:03", 176_523.0),
    ],
)
def test_dates_times_of_day_and_spans_are_read_in_seconds(cell: str, t_s: float) -> None:
    assert time_of(cell) == t_s


def test_a_line_of_exactly_the_limit_is_read() -> None:
    room = LINE_LENGTH_MAX - len(line(TABLE_HEADER, cells(0, {"object": ""}))) - 1
    assert len(rows_of(table(1, {0: {"object": "x" * room}}))) == 1
    with pytest.raises(RecordingError, match="line 2: the line is longer than 65536 characters"):
        rows_of(table(1, {0: {"object": "x" * (room + 1)}}))


def test_a_last_row_without_line_end_is_flagged_cut_off() -> None:
    *whole, last = rows_of(table(3).rstrip(b"\n"))
    assert all(not row.faults.any() for row in whole)
    assert (last.faults == ElectrodeFault.CUT_OFF).all()
    with pytest.raises(RecordingError, match=r"line 4: the last row has no line end; .* cut off"):
        rows_of(table(3).rstrip(b"\n"), strict=True)
    (wrong,) = rows_of(table(1, {0: {"th_biotac_24": "26x"}}).rstrip(b"\n"))
    assert wrong.faults[2, 23] == ElectrodeFault.CUT_OFF | ElectrodeFault.NOT_A_COUNT
    (row,) = rows_of(stream(["0"], {"FFJ1": ["0.5"]}).rstrip(b"\n"))
    assert np.isnan(row.position_rad).all()


@pytest.mark.parametrize("cell", ["nan", "", "1e999"])
def test_an_angle_that_is_not_a_number_is_nan(cell: str) -> None:
    content = stream(["0"], {"FFJ1": ["0.5"], "FFJ2": [cell]})
    (row,) = rows_of(content)
    np.testing.assert_array_equal(row.position_rad, [0.5, math.nan])
    with pytest.raises(RecordingError, match=r"line 2, column FFJ2: .* is not an angle in radians"):
        rows_of(content, strict=True)


def test_a_missing_file_a_directory_and_a_device_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"nowhere.csv: no such file or directory"):
        open_recording(tmp_path / "nowhere.csv")
    with pytest.raises(RecordingError, match="is a directory"):
        open_recording(tmp_path)
    with pytest.raises(RecordingError, match="/dev/zero: is not a regular file"):
        open_recording(Path("/dev/zero"))
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(RecordingError, match="is not a regular file"):
        open_recording(tmp_path / "pipe")
    with pytest.raises(RecordingError, match="null byte"):
        open_recording(Path("a\0b"))


def test_an_error_while_reading_is_a_recording_error() -> None:
    class Broken(io.BytesIO):
        def read1(self, size: int | None = -1, /) -> bytes:
            raise OSError(5, "Input/output error")

    with pytest.raises(RecordingError, match=r"grasps.csv: input/output error"):
        survey(PATH, Broken(GOOD), FINGERS)


NOT_COUNTS = [
    *("nan", "-1", "4096", "2602.5", "", "1_000", "1,", "\u0661\u0662", "9" * 5000, "4095.0000001"),
    "2 602",
]
COUNTS = {
    **{"0": 0, "4095": 4095, " 12\t": 12, "2602.": 2602, "2.602000000000000000e+03": 2602},
    **{"+5": 5, ".5e1": 5, "0.0": 0, "4095.0": 4095},
}


@pytest.mark.parametrize("cell", NOT_COUNTS, ids=lambda cell: repr(cell)[:24])
def test_a_malformed_count_makes_its_electrode_faulty(cell: str) -> None:
    quoted = f'"{cell}"'
    content = table(3, {1: {"mf_biotac_2": quoted}})
    before, row, after = rows_of(content)
    expected = np.zeros((3, 24), dtype=np.uint8)
    expected[1, 1] = ElectrodeFault.NOT_A_COUNT
    np.testing.assert_array_equal(row.faults, expected)
    assert row.counts[1, 1] == 0
    assert row.counts[1, 2] == count(1, 26)
    assert not before.faults.any()
    assert not after.faults.any()
    told = r"line 3, column mf_biotac_2: .* is not a count, an integer in 0..4095"
    with pytest.raises(RecordingError, match=told):
        rows_of(content, strict=True)


@pytest.mark.parametrize(("cell", "expected"), COUNTS.items())
def test_a_count_may_be_written_in_several_ways(cell: str, expected: int) -> None:
    (row,) = rows_of(table(1, {0: {"th_biotac_24": cell}}), strict=True)
    assert row.counts[2, 23] == expected
    assert not row.faults.any()


@given(st.text(max_size=12) | st.from_regex(r"[0-9.eE+_ -]{1,8}", fullmatch=True))
@example("1_0")
def test_an_accepted_count_is_what_python_float_reads(cell: str) -> None:
    value = count_of(cell)
    if value is not None:
        assert set(cell.strip()) <= set("0123456789.eE+-")
        assert float(cell) == value
        assert 0 <= value <= 4095


@given(st.binary(max_size=400) | st.binary(max_size=200).map(lambda tail: table(2) + tail))
def test_bytes_of_any_kind_give_rows_or_a_recording_error(content: bytes) -> None:
    outcome = rows_or_message(content)
    if isinstance(outcome, str):
        assert outcome.startswith("grasps.csv")
    else:
        assert outcome
        assert all(row.counts.max() <= 4095 for row in outcome)


PLAIN = table(4)
TIMES = ["100.00", "100.01", "100.02", "100.03"]


def scaled(change: Callable[[int], str], separator: str = ",") -> bytes:
    lines = PLAIN.decode().splitlines()
    cells = [line.split(",") for line in lines[1:]]
    rows = [[*row[:2], *(change(int(cell)) for cell in row[2:])] for row in cells]
    return "".join(separator.join(row) + "\n" for row in [lines[0].split(","), *rows]).encode()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (scaled(lambda n: f"{n / 4095 * 3.3:.3f}"), "volts?"),
        (scaled(lambda n: str(n - 1100)), "differences?"),
        (scaled(lambda n: str(n * 16)), "another sensor, or another scale?"),
        (scaled(lambda n: f'"{n // 1000},{n % 1000:03}"'), "without a separator of thousands"),
        (scaled(lambda n: f"{n // 1000} {n % 1000:03}", ";"), "without a separator of thousands"),
        (scaled(lambda n: f"{n / 1000:.3f}", ";"), "thousands with a point, or volts?"),
        (scaled(lambda _: "0.99"), "normalised? multiply by 4095"),
        (scaled(lambda _: "5.5"), "volts?"),
        (scaled(lambda _: "5.6"), "percent, or another scale?"),
        (scaled(lambda _: "99.5"), "percent, or another scale?"),
        (scaled(lambda _: "100.5"), "means of several readings?"),
        (scaled(lambda _: "4095.5"), "another sensor, or another scale?"),
        (scaled(hex), "hexadecimal?"),
        (scaled(lambda _: "high"), "text in place of numbers?"),
    ],
)
def test_values_that_are_not_counts_are_refused_with_a_guess(content: bytes, said: str) -> None:
    message = refusal(content)
    assert "of 288 values are not counts, whole numbers in 0..4095, the first is '" in message
    assert said in message


def test_up_to_half_unreadable_or_a_twentieth_scaled_values_pass() -> None:
    for cell, most, of in (("x", 10, 20), ("1.5", 1, 20), ("-2", 1, 20), ("-1", 1, 2)):
        allowed, counts = [cell] * most, ["2000"] * (of - most)
        assert problem_with([*allowed, *counts, "", ""], decimal_comma=False) is None
        assert problem_with([*allowed, *counts[1:], "", ""], decimal_comma=False) is not None


def test_joints_in_degrees_are_refused() -> None:
    degrees = {"FFJ1": ["1", "2", "3", "1"], "rh_FFJ3": ["45.8", "46.1", "46.0", "3"]}
    content = stream(TIMES, degrees)
    assert "FFJ3 = 45.8 rad is beyond every joint: degrees?" in refusal(content)


@pytest.mark.parametrize(
    "name",
    [
        *("FFJ1 [deg]", "FFJ1 (°)", "FFJ1 [°]", "FFJ1°", "FFJ1 (º)", "FFJ1 (˚)", "FFJ1 [Degrees]"),
        *("FFJ1_deg", "rh_ffj1_position_degrees", "/joint_states/rh_FFJ1/position (deg)"),
    ],
)
def test_joints_named_in_degrees_are_refused_in_streams_only(name: str) -> None:
    content = stream(TIMES, {name: ["1", "2", "3", "1"], "FFJ2": ["0"] * 4})
    assert f"column {name}: angles are in degrees: write radians" in refusal(content)
    in_radians = content.replace(b"FFJ2", b"FFJ1")
    assert rows_of(in_radians)[0].joint_names == ("FFJ1",)
    grasps = table(3, {row: {name: "1"} for row in range(3)}, [*TABLE_HEADER, name])
    assert len(rows_of(grasps)) == 3


@pytest.mark.parametrize(
    ("names", "joints", "unclear"),
    [
        (["ffj3", "Rh_ThJ5"], ("FFJ3", "THJ5"), ()),
        (["FFJ3 (rad)", "MFJ3_rad", "lfj5 [ rad ]"], ("FFJ3", "LFJ5", "MFJ3"), ()),
        (["FFJ3.position", "position.rh_FFJ2", "MFJ3Pos"], ("FFJ2", "FFJ3", "MFJ3"), ()),
        (["/joint_states/rh_FFJ3/position", "/joint_states/rh_FFJ3/velocity"], ("FFJ3",), ()),
        (["ff_j3", "joint_angle_TH-J2"], ("FFJ3", "THJ2"), ()),
        (["FFJ3 (proximal)", "FFJ3_deg", "FFJ3_position", "FFJ3.1"], ("FFJ3",), ()),
        (["FFJ3_velocity", "FFJ3_effort", "FFJ3 torque", "FFJ3_target", "ffj3_cmd"], (), ()),
        (["FFJ3 [rad/s]", "FFJ3 (Nm)", "FFJ3_deg/s"], (), ()),
        (["sh_rh_ffj3_position_controller.command", "FFJ5", "FFJ31"], (), ()),
        (["FFJ3_2", "MFJ3 smooth", "MFJ3"], ("MFJ3",), ("FFJ3_2",)),
        (["rh_FFJ3_current_position"], (), ("rh_FFJ3_current_position",)),
    ],
)
def test_column_names_tell_joint_angles_from_other_values(
    names: Sequence[str], joints: Sequence[str], unclear: Sequence[str]
) -> None:
    content = stream(TIMES, {name: ["0.1"] * 4 for name in names})
    columns = survey(PATH, io.BytesIO(content), FINGERS).columns
    assert (tuple(sorted(columns.joints)), columns.unclear) == (joints, unclear)


def test_up_to_a_tenth_of_angles_beyond_reach_become_nan() -> None:
    times, angles = [f"{n / 100}" for n in range(20)], ["0.5", "70", "70", *["0.5"] * 17]
    rows = rows_of(stream(times, {"FFJ3": angles}))
    assert [math.isnan(row.position_rad[0]) for row in rows] == [False, True, True, *[False] * 17]
    assert "70 rad is beyond" in refusal(stream(times, {"FFJ3": ["70", *angles[1:]]}))


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (["0.0", "1.0", "", "1.0"], [False, True, None, True]),
        (["False", "True", "nan", "TRUE"], [False, True, None, True]),
        (["0,0", "1,0", "NA", "1,0"], [False, True, None, True]),
        (["stable", "slip", "None", " Slip "], [False, True, None, True]),
    ],
)
def test_outcomes_are_read_as_tools_write_them(
    cells: Sequence[str], expected: Sequence[bool | None]
) -> None:
    content = table(4, {row: {"slipped": f'"{cell}"'} for row, cell in enumerate(cells)})
    rows = rows_of(content, outcomes=True)
    assert [row.annotation.slipped for row in rows] == expected
