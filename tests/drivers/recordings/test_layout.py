"""Other people's tables: dialects, names of columns, times, values."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from graspd.drivers.base import RecordingError
from graspd.drivers.recordings.csv_rows import Row, read_rows
from graspd.drivers.recordings.layout import layout_of, survey
from tests.drivers.recordings.tables import (
    ELECTRODES,
    FINGERS,
    PATH,
    refusal,
    rows_of,
    stream,
    table,
)

PLAIN = table(4)


def values(rows: Sequence[Row]) -> list[object]:
    """Counts, True if one is faulty, object and outcome of each row."""
    return [
        (row.counts.tolist(), row.faults.any(), row.annotation.object_name, row.annotation.slipped)
        for row in rows
    ]


def text(change: Callable[[str], str]) -> bytes:
    return change(PLAIN.decode()).encode()


DIALECTS = {
    "byte order mark": b"\xef\xbb\xbf" + PLAIN,
    "UTF-16 of Windows": PLAIN.decode().encode("utf-16"),
    "UTF-16 without a mark": PLAIN.decode().encode("utf-16-le"),
    "UTF-16 without a mark, big end": PLAIN.decode().encode("utf-16-be"),
    "UTF-32": PLAIN.decode().encode("utf-32"),
    "breaks in names": text(
        lambda it: (
            it.replace("slipped", '"Slipped\n(0/1)"', 1)
            .replace("object", '"object\r\n(name)"', 1)
            .replace("th_biotac_24", '"th\nbiotac\n24"', 1)
        )
    ),
    "a break in each name": text(lambda it: re.sub(r"(ff|mf|th)_biotac_(\d+)", '"\\1\ne\\2"', it)),
    "an inch in a title": b'Pad of 5" at 2026\n' + PLAIN,
    "an inch and names in quotes": b'5" pad\n' + text(lambda it: re.sub(r"(\w+_\d+)", r'"\1"', it)),
    "inches in a title and in cells": b'5" pad\n'
    + text(lambda it: it.replace("\n", ',5"\n').replace('5"', "size", 1)),
    "titles": b"Lab A; run 3\n\nDate:,2026-05-04\n" + PLAIN,
    "thirty titles": b"Lab A\n\n" * 30 + PLAIN,
    "units below": PLAIN.replace(b"24\n", b"24\n,-" + b",counts" * 72 + b"\n", 1),
    "units that end early": table(4, columns=[*ELECTRODES, "object", "slipped"]).replace(
        b"\n", b"\ncounts" + b",counts" * 71 + b"\n", 1
    ),
    "fingers above": text(
        lambda it: f",,ff{',' * 24}mf{',' * 24}th\n" + re.sub("(ff|mf|th)_biotac_", "e", it)
    ),
    "CRLF": PLAIN.replace(b"\n", b"\r\n"),
    "blank lines": b"\n\r\n" + PLAIN.replace(b"\n", b"\n \t\n\n"),
    "spaces around": PLAIN.replace(b",", b" , "),
    "semicolons": PLAIN.replace(b",", b";"),
    "spaces": PLAIN.replace(b",", b" "),
    "sep line": b"sep=;\r\n" + PLAIN.replace(b",", b";"),
    "sep line of another": b"sep=:\r\n" + PLAIN.replace(b",", b":"),
    "a comment within": text(lambda it: it.replace("thing", "# later\nthing")),
    "a header in a comment": b"# lab A\n# " + PLAIN,
    "many comments": b"# lab A\n" * 40_000 + PLAIN,
    "carriage returns": PLAIN.replace(b"\n", b"\r"),
    "labels in capitals": PLAIN.replace(b"slipped", b"Slipped").replace(b"object", b"OBJECT"),
    "trailing commas in rows": text(lambda it: it.replace("\n", ",\n").replace(",\n", "\n", 1)),
    "a trailing comma above": PLAIN.replace(b"_24\n", b"_24,\n"),
    "trailing commas everywhere": text(lambda it: it.replace("\n", ",,\n")),
    "blank rows of commas": PLAIN + b"," * 73 + b"\n",
    "decimal comma": PLAIN.replace(b",", b";").replace(b"\n", b",0\n").replace(b"_24,0", b"_24"),
}


@pytest.mark.parametrize("content", DIALECTS.values(), ids=DIALECTS)
def test_a_table_of_any_dialect_reads_the_same(content: bytes) -> None:
    assert values(rows_of(content)) == values(rows_of(PLAIN))


def test_a_name_in_quotes_may_have_line_breaks() -> None:
    content = PLAIN.replace(b"thing_1", b'"thing\r\none, # 1"')
    names = [row.annotation.object_name for row in rows_of(content)]
    assert names == ["thing_0", "thing\r\none, # 1", "thing_2", "thing_3"]
    assert rows_of(content)[2].annotation.line == 5


@pytest.mark.parametrize(
    ("change", "line"), [(("ff_biotac_1,", '"ff\nbiotac\n1",'), 4), (("", '5"\n'), 3)]
)
def test_line_numbers_are_true_below_a_quotation_mark(change: tuple[str, str], line: int) -> None:
    rows = rows_of(text(lambda it: it.replace(*change, 1)))
    assert [row.annotation.line for row in rows] == [line, line + 1, line + 2, line + 3]


@pytest.mark.parametrize("name", ["object (id)", "slipped (mm)"])
def test_a_further_column_like_a_label_is_ignored(name: str) -> None:
    content = text(lambda it: re.sub("^", "7.5,", it, flags=re.MULTILINE)).replace(
        b"7.5,", name.encode() + b",", 1
    )
    assert values(rows_of(content.removesuffix(b"7.5,"))) == values(rows_of(PLAIN))


def test_a_row_beginning_with_a_hash_is_refused_unless_quoted() -> None:
    content = PLAIN.replace(b"thing_2", b"#2 mug")
    assert "line 4: the line begins with #, as a comment does" in refusal(content)
    quoted = PLAIN.replace(b"thing_2", b'"#2 mug"')
    assert [row.annotation.object_name for row in rows_of(quoted)][2] == "#2 mug"
    assert values(rows_of(PLAIN + b"# " + PLAIN.split(b"\n")[0] + b"\n")) == values(rows_of(PLAIN))


def test_a_row_of_many_lines_beyond_the_limit_is_refused() -> None:
    content = PLAIN + b'"a' + b'\n","a' * 40_000
    assert "longer than 65536 characters" in refusal(content)


def test_parquet_reads_as_its_csv_unless_damaged(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas", reason="needs the extra pandas")
    frame = pandas.read_csv(io.BytesIO(PLAIN))
    frame = frame.astype(dict.fromkeys(ELECTRODES, float) | {"slipped": bool})
    path = tmp_path / "grasps"
    frame.to_parquet(path)
    rows = list(read_rows(path, FINGERS))
    assert values(rows) == values(rows_of(PLAIN))
    assert [row.annotation.line for row in rows] == [2, 3, 4, 5]
    path.write_bytes(path.read_bytes().replace(b"ff_biotac_1", b"\xe3f_biotac_1"))
    with pytest.raises(RecordingError, match="is damaged: 'utf-8' codec can't decode"):
        layout_of(path, FINGERS)


def renamed(name: Callable[[str, int], str], fingers: Sequence[str] = FINGERS) -> bytes:
    """The plain table, electrodes of `fingers` called `name(finger, number from 1)`."""
    header, rest = PLAIN.decode().split("\n", 1)
    names = {f"{f}_biotac_{n}": name(f, n) for f in fingers for n in range(1, 25)}
    return (",".join(names.get(each, each) for each in header.split(",")) + "\n" + rest).encode()


PLACES = {"ff": 0, "mf": 1, "rf": 2, "lf": 3, "th": 4}
SCHEMES: dict[str, Callable[[str, int], str]] = {
    "BioTacSP-DoS": lambda finger, number: f"{finger}_e{number}",
    "from 0": lambda finger, number: f"{finger}_biotac_{number - 1}",
    "a full stop": lambda finger, number: f"/hand/{finger}.e{number:02}",
    "a space": lambda finger, number: f"{finger.upper()} E{number}",
    "brackets": lambda finger, number: f"{finger}[{number - 1}]",
    "a word": lambda finger, number: f"{finger}_electrode_{number}",
    "a unit": lambda finger, number: f"{finger}_biotac_{number} (counts)",
    "messages of graspd": lambda finger, number: f"{finger}_{number}",
    "with the hand": lambda finger, number: f"rh_{finger}_biotac_{number}",
    "rostopic echo -p": lambda f, number: f"field.tactiles{PLACES[f]}.electrodes{number - 1}",
    "mcap cat --csv": lambda f, number: f"tactiles.{PLACES[f]}.electrodes.{number - 1}",
    "MATLAB": lambda finger, number: f"tactiles_{PLACES[finger]}_electrodes_{number - 1}_",
    "PlotJuggler": lambda f, number: f"/rh/tactile/tactiles[{PLACES[f]}]/electrodes[{number - 1}]",
}


@pytest.mark.parametrize("name", SCHEMES.values(), ids=SCHEMES)
def test_electrodes_are_recognised_by_each_naming_scheme(name: Callable[[str, int], str]) -> None:
    assert values(rows_of(renamed(name))) == values(rows_of(PLAIN))


def test_electrode_names_need_no_finger_if_one_is_read() -> None:
    content = renamed(lambda _, number: f"E{number}", ["mf"])
    content = content.replace(b"ff_biotac", b"x").replace(b"th_biotac", b"y")
    assert [row.counts.tolist() for row in rows_of(content, ["th"])] == [
        row.counts[1:2].tolist() for row in rows_of(PLAIN)
    ]
    assert "E1 and so on name no finger, and 3 are asked for" in refusal(content)


@pytest.mark.parametrize("name", ["finger", "Sensor_ID", "fingertip"])
@pytest.mark.parametrize("block", [1, 512])
@pytest.mark.parametrize("hand", [["ff", "th"], ["ff", "th", "mf", "rf", "lf"]])
def test_a_file_with_one_finger_per_row_is_refused(
    name: str, block: int, hand: Sequence[str]
) -> None:
    generator = np.random.default_rng(1)
    header = ",".join([name, *(f"E{number}" for number in range(1, 25))])
    rows = [
        ",".join([hand[place // block % len(hand)], *map(str, generator.integers(4096, size=24))])
        for place in range(len(hand) * block)
    ]
    content = "\n".join([header, *rows, ""])
    said = refusal(content.encode(), ["ff"])
    assert f"column {name}: has rows of ff and of {min(hand[1:])}: put all" in said
    said = refusal(content.encode())
    assert f"name no finger, but {name} may: put all fingers into one row" in said
    said = refusal(re.sub(r"E2\d", "x", content).encode(), ["ff"])
    assert "ff has 19 electrodes: a BioTac" in said
    of_one = re.sub("^(th|[mrl]f),", "ff,", content, flags=re.MULTILINE).encode()
    assert len(rows_of(of_one, ["ff"])) == len(rows)
    timed = "\n".join([f"t,{header}", *(f"{0.01 * n},{row}" for n, row in enumerate(rows)), ""])
    for given, rate_hz in ((content, 100.0), (timed, None)):
        with pytest.raises(RecordingError, match=f"column {name}: has rows of ff and of"):
            survey(PATH, io.BytesIO(given.encode()), ["ff"], "stream", rate_hz)


@pytest.mark.parametrize(
    ("header", "name", "words"),
    [
        ("E", "finger", ["FF", " ff ", "", "ff"]),
        ("ff_e", "sensor", ["SP12", "SP07", "SP12", "SP07"]),
        ("ff_e", "frame_id", ["1", "2", "3", "4"]),
    ],
)
def test_a_finger_column_without_a_second_finger_is_ignored(
    header: str, name: str, words: Sequence[str]
) -> None:
    plain = renamed(lambda f, n: f"{header}{n}" if f == "ff" else f"{f}x{n}").decode().splitlines()

    def beside(*cells: str) -> bytes:
        lines = zip((name, *cells), plain, strict=True)
        return "".join(f"{cell},{line}\n" for cell, line in lines).encode()

    assert values(rows_of(beside(*words), ["ff"])) == values(rows_of(PLAIN, ["ff"]))
    assert "has rows of ff and of th" in refusal(beside("ff", "th", "ff", "th"), ["ff"])


@pytest.mark.parametrize(
    "content",
    [
        b"object,slipped,electrode,count\nmug,0,ff_biotac_1,2795\nmug,0,ff_biotac_2,2796\n",
        b'object,slipped,ff,mf\nmug,0,"[3267, 3249, 9]","[3267, 3249, 8]"\n',
        b"@relation grasps\n@attribute ff_biotac_1 numeric\n@attribute ff_biotac_2 numeric\n",
    ],
    ids=["a row for each electrode", "lists", "ARFF"],
)
def test_a_row_with_an_electrode_is_not_a_header(content: bytes) -> None:
    assert "line 1: no column of electrodes is known" in refusal(content)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (lambda f, n: f"{f}_taxels_{n}", "is nearest to ff_"),
        (lambda f, n: f"{f}_e{n}" if n < 20 else f"x{f}{n}", "ff has 19 electrodes: a BioTac"),
        (lambda f, n: f"{f}_e{n - 1}" if n < 20 else f"x{f}{n}", "another sensor than the BioTac"),
        (lambda f, n: f"ele{n}" if f == "ff" and n < 20 else f"x{f}{n}", "19 electrodes: a BioTac"),
        (
            lambda f, n: f"bt_data{PLACES[f]}.electrode_data{n - 1}" if n < 20 else f"{f}x{n}",
            "bt_data0 has 19 electrodes: a BioTac",
        ),
        (
            lambda f, n: f"field.bt_data{PLACES[f]}.electrode_data{n - 1}",
            "so on name no finger, and 3 are asked for",
        ),
        (lambda f, n: f"{f}_e{n}" if (f, n) != ("mf", 7) else "x", "column mf_e7: this column is"),
        (lambda f, n: f"{f}_e{n - (f == 'ff')}", "column mf_e0: this column is missing"),
        (lambda f, n: f"{f}_e{n + 1}", "column ff_e1: this column is missing"),
        (lambda f, n: f"{f}_e{n}" if f != "th" else f"x{n}", "the file has the fingers ff, mf"),
    ],
)
def test_wrong_electrode_columns_are_refused_with_the_reason(
    name: Callable[[str, int], str], said: str
) -> None:
    assert said in refusal(renamed(name))


TIMES = ["100.00", "100.01", "100.02", "100.03"]


def timed(name: str, cells: Sequence[str], separator: str = ",") -> bytes:
    """A stream whose column of times is called `name`; several names have commas between."""
    return stream(cells).replace(b"t,", name.encode() + b",", 1).replace(b",", separator.encode())


@pytest.mark.parametrize(
    ("name", "cells"),
    [
        ("Timestamp", TIMES),
        ("Time (s)", TIMES),
        ("Rel. Time", TIMES),
        ("Czas (s)", TIMES),
        ("millis()", ["0", "10", "20", "30"]),
        ("Time (\u00b5s)", ["0", "10000", "20000", "30000"]),
        ("field.header.stamp", [f"{1.7e18 + n * 1e7:.0f}" for n in range(4)]),
        ("time_ms", ["5", "15", "25", "35"]),
        ("ms", ["5", "15", "25", "35"]),
        ("timestamp", [f"{1.7e12 + n * 10:.0f}" for n in range(4)]),
        ("timestamp", [f"{1.7e15 + n * 1e4:.0f}" for n in range(4)]),
        ("time", [f"2023-11-14T22:13:20.{n:02}Z" for n in range(4)]),
        ("time", [f"9:05:20.{n:02}" for n in range(4)]),
        ("time", [f"1 days 00:00:20.{n:02}" for n in range(4)]),
        ("datetime_utc", [f"2023-11-14 22:13:20.{n:02}0 UTC" for n in range(4)]),
        ("secs,nsecs", [f"1700000000,{n}0000000" for n in range(4)]),
        ("stamp.nanosec,stamp.sec", [f"{n}0000000,1700000000" for n in range(4)]),
        ("t_s,t_ns", [f"0.0{n},{n}0000000" for n in range(4)]),
        ("ts", [f"{1.7e18 + n * 1e7:.0f}" for n in range(4)]),
        ("timestamps", [f"{1.7e18 + n * 1e7:.0f}" for n in range(4)]),
        ("timestamps_ms", ["5", "15", "25", "35"]),
        ("ts", TIMES),
        ("times_s", TIMES),
    ],
)
def test_times_are_known_by_usual_names_and_units(name: str, cells: Sequence[str]) -> None:
    rows = rows_of(timed(name, cells))
    steps = np.diff([math.nan if row.t_s is None else row.t_s for row in rows])
    assert steps == pytest.approx([0.01, 0.01, 0.01], abs=1e-6)


def test_a_time_with_thousands_is_named_as_a_possible_cause() -> None:
    ms = [*(f"{n}" for n in range(500, 1000, 10)), "1,000"]
    message = refusal(timed("time_ms", ms, "\t").replace(b"1\t000", b"1,000"))
    assert "line 52, column time_ms: time goes backwards" in message
    assert "has '1,000' a separator of thousands? write times without one" in message


def test_times_may_have_a_decimal_comma() -> None:
    content = timed("t", ["0.00", "0.01", "1.120"], ";").replace(b".", b",")
    assert [row.t_s for row in rows_of(content)] == [0.0, 0.01, 1.12]
