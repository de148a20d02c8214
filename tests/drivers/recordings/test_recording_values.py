"""Which texts are counts: every cell is one, exactly, or makes its electrode faulty."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from drivers.base import ElectrodeFault, RecordingError
from drivers.recordings.csv_rows import (
    count_of,
    number_of,
)
from tests.drivers.recordings.tables import (
    ELECTRODES,
    count,
    rows_of,
    rows_or_message,
    table,
)

NOT_COUNTS = [
    "nan", "-1", "4096", "1e9", "2602.5", "text", "", " ", "inf", "-inf", "0x10", "1_000", "+5",
    "-0", "1,", "\u0661\u0662", "\uff11", "\u00b2", "9" * 5000, "0" * 5000 + "1", "1e-400", "1e400",
    "0.0000000001", "4095.0000001", "2 602", "2602 counts", "\xa02602", "2602\x0c", "2602\x1f", ".",
    "1e", "e3", "true", "None", "2602e0.5", ".5e1",
]  # fmt: skip
COUNTS = {
    "0": 0, "4095": 4095, "007": 7, " 12 ": 12, "\t12\t": 12, "2602.0": 2602, "2602.": 2602,
    "2.602e3": 2602, "2.602000000000000000e+03": 2602, "4095.000": 4095, "0e0": 0, "50E-1": 5,
}  # fmt: skip


@pytest.mark.parametrize("cell", NOT_COUNTS, ids=lambda cell: repr(cell)[:24])
def test_a_value_that_is_no_count_makes_its_electrode_faulty(cell: str) -> None:
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
    with pytest.raises(RecordingError, match=r"is not a count, an integer in 0..4095") as caught:
        rows_of(content, strict=True)
    assert (caught.value.line, caught.value.column) == (3, "mf_biotac_2")


@pytest.mark.parametrize(("cell", "expected"), COUNTS.items())
def test_an_integer_may_be_written_in_several_ways(cell: str, expected: int) -> None:
    (row,) = rows_of(table(1, {0: {"th_biotac_24": cell}}), strict=True)
    assert row.counts[2, 23] == expected
    assert not row.faults.any()


@pytest.mark.parametrize(("cell", "told"), [("x" * 40, "x" * 40), ("x" * 41, "x" * 40 + "...")])
def test_a_message_shows_forty_characters_of_a_cell(cell: str, told: str) -> None:
    with pytest.raises(RecordingError, match=rf"column th_biotac_24: '{re.escape(told)}' is not"):
        rows_of(table(1, {0: {"th_biotac_24": cell}}), strict=True)


@pytest.mark.parametrize(("length", "read"), [(32, 5), (33, None)])
def test_a_number_has_at_most_32_characters(length: int, read: int | None) -> None:
    """A double in full takes 24."""
    cell = "5." + "0" * (length - 2)
    assert (count_of(cell), number_of(cell)) == (read, read)


@given(st.text(max_size=12) | st.from_regex(r"[0-9.eE+_ -]{1,8}", fullmatch=True))
@example("1_0")
def test_a_count_is_never_read_from_what_python_would_not_call_that_number(cell: str) -> None:
    value = count_of(cell)
    if value is not None:
        assert set(cell.strip(" \t")) <= set("0123456789.eE+-")
        assert float(cell) == value
        assert 0 <= value <= 4095


@given(st.integers(-10_000, 10_000))
def test_an_integer_is_a_count_exactly_if_it_has_12_bits(value: int) -> None:
    expected = value if 0 <= value < 4096 else None
    assert count_of(str(value)) == expected
    if value >= 0:
        assert count_of(f"{value}.0") == count_of(f"{value:e}".replace("e+0", "e+")) == expected


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_a_number_is_read_as_python_writes_it(value: float) -> None:
    assert number_of(repr(value)) == (value if math.isfinite(value) else None)


@given(st.binary(max_size=400) | st.binary(max_size=200).map(lambda tail: table(2) + tail))
def test_bytes_of_any_kind_give_rows_or_a_recording_error(content: bytes) -> None:
    outcome = rows_or_message(content)
    if isinstance(outcome, str):
        assert outcome.startswith("grasps.csv")
    else:
        assert outcome
        assert all(row.counts.max() <= 4095 for row in outcome)


@given(st.lists(st.integers(0, 4095), min_size=72, max_size=72), st.booleans())
def test_every_count_survives_writing_and_reading(counts: list[int], as_floats: bool) -> None:
    written = [f"{value}.0" if as_floats else str(value) for value in counts]
    content = ",".join(ELECTRODES) + "\n" + ",".join(written) + "\n"
    (row,) = rows_of(content.encode(), strict=True)
    assert row.counts.ravel().tolist() == counts
