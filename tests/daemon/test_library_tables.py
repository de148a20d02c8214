"""Tables of any kind are judged by the library as their files are, or are refused."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

import graspd
from graspd.daemon.record.mcap import McapWriter
from graspd.daemon.session.file import SessionFileError
from graspd.drivers.base import RecordingError
from graspd.drivers.recordings.csv_player import DEMO_RECORDING
from graspd.models import zoo
from graspd.models.contract import ModelError
from tests.daemon.record.recorded import HEADER
from tests.daemon.test_library import GIVEN, columns, messages
from tests.kit.inside import graspd as run


def held_streams(folder: Path) -> list[Path]:
    """Write two streams: the demo recording to 20 rows after a `stable` verdict, and the next 100,
    which begin with the object held; return their paths."""
    head, *rows = DEMO_RECORDING.read_text().splitlines(keepends=True)
    verdicts = [each.verdict.value for each in graspd.judge(DEMO_RECORDING)]
    cut = verdicts.index("stable") + 20
    paths = [folder / "before.csv", folder / "after.csv"]
    for path, part in zip(paths, (rows[:cut], rows[cut : cut + 100]), strict=True):
        path.write_text("".join([head, *part]))
    return paths


@pytest.mark.parametrize("streams", [lambda _: [DEMO_RECORDING], held_streams], ids=["one", "two"])
def test_a_stream_is_judged_as_replay_judges_it(
    streams: Callable[[Path], list[Path]], tmp_path: Path
) -> None:
    paths = streams(tmp_path)
    names = "grasp", "judged", "gate", "verdict", "p_slip", "reasons", "motion"
    expected = [{name: each[name] for name in names} for each in messages(*paths)]
    judged = map(msgspec.to_builtins, graspd.judge(paths))
    got = [{name: each[name] for name in names} for each in judged]
    assert {each["verdict"] for each in got} >= {"stable", "unknown"}
    assert any("sequence-gap" in each["reasons"] for each in got) is (len(paths) > 1)
    assert got == expected


@pytest.mark.parametrize("model", ["small-session", "mine.onnx"])
def test_a_recording_is_judged_by_the_model_that_replay_takes(
    model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("run").mkdir()
    McapWriter(Path("run/run.mcap"), replace(HEADER, fingers=("ff", "th"))).close()
    shutil.copy(zoo.find("small-session-ff-th"), "mine.onnx")
    assert "nothing was judged:" in run("replay", "run/run.mcap", "--model", model).stderr
    with pytest.warns(UserWarning, match="nothing was judged:"):
        assert not list(graspd.judge("run/run.mcap", model=model))


@pytest.mark.parametrize(
    "given", ["columns by name", "Arrow", "polars", "pandas of its own integers"]
)
def test_a_table_is_judged_as_its_file(
    counts: NDArray[np.float64], tmp_path: Path, given: str
) -> None:
    values = counts[:12].copy()
    values[3, 1, 7] = np.nan
    held = columns(values)
    rows = [
        ["" if each is None else each for each in row] for row in zip(*held.values(), strict=True)
    ]
    with (path := tmp_path / "grasps.csv").open("w", newline="") as file:
        csv.writer(file).writerows([list(held), *rows])
    told = [
        [(each.verdict, each.p_slip, each.reasons) for each in graspd.judge(recording, model="mlp")]
        for recording in (path, GIVEN[given](values))
    ]
    assert {each[0] for each in told[0]} >= {"stable", "slip"}
    assert told[0] == told[1]


TIMES: dict[str, Callable[[NDArray[np.float64]], Any]] = {
    "float32": lambda t_s: t_s.astype(np.float32),
    "seconds since 1970": lambda t_s: t_s + 1.7e9,
    "whole milliseconds": lambda t_s: (1e3 * t_s).round().astype(int),
    "dates": lambda t_s: (1e9 * t_s).round().astype("datetime64[ns]"),
    "dates below a microsecond": lambda t_s: (
        (1e9 * t_s).round().astype(np.int64) - 10 * (np.arange(len(t_s)) % 2)
    ).astype("datetime64[ns]"),
    "spans": lambda t_s: (1e3 * t_s).round().astype("timedelta64[ms]"),
}


@pytest.mark.parametrize("times", TIMES.values(), ids=TIMES)
def test_times_of_any_kind_give_the_same_verdicts(
    times: Callable[[NDArray[np.float64]], Any],
) -> None:
    pytest.importorskip("pandas", reason="needs the extra `pandas`")
    stream = graspd.read_recording(DEMO_RECORDING)[:400]
    name = "time_us" if times(np.zeros(1)).dtype.kind in "mM" else "t"  # their own unit counts
    other = stream.drop(columns="t").assign(**{name: times(stream.t.to_numpy())})
    told = [
        [(each.verdict, each.p_slip, each.motion) for each in graspd.judge(given)]
        for given in (stream, other)
    ]
    assert {each[0] for each in told[0]} >= {"slip", "unknown"}
    assert told[0] == told[1]


@pytest.mark.parametrize(
    ("times", "words"),
    [
        (
            lambda t_s: np.where(t_s == 0.5, np.nan, t_s),
            r"^the table, row 50 \(from 0\), column t:",
        ),
        (lambda t_s: (t_s + 1e5).astype(np.float32), r"float32 rounds these times to 0\.0078"),
        (lambda t_s: t_s.astype(int), "^the table, column t: .*read_as=table.*rate_hz="),
    ],
)
def test_missing_or_too_coarse_times_are_refused(
    times: Callable[[NDArray[np.float64]], Any], words: str
) -> None:
    pytest.importorskip("pandas", reason="needs the extra `pandas`")
    stream = graspd.read_recording(DEMO_RECORDING)[:100]
    with pytest.raises(ValueError, match=words):
        list(graspd.judge(stream.assign(t=times(stream.t.to_numpy()))))


@pytest.mark.parametrize("text", ["a\udcff", "a\0b"])
def test_text_that_no_csv_can_hold_does_not_hinder_judging(text: str) -> None:
    pandas = pytest.importorskip("pandas", reason="needs the extra `pandas`")
    stream = graspd.read_recording(DEMO_RECORDING)[:400]
    noted = stream.assign(note=pandas.Series([text] * len(stream), dtype=object))
    told = [[each.reasons for each in graspd.judge(given)] for given in (stream, noted)]
    assert told[0] == told[1]


def test_sweeps_without_times_are_refused_as_grasps(tmp_path: Path) -> None:
    pytest.importorskip("pandas", reason="needs the extra `pandas`")
    sweeps = graspd.read_recording(DEMO_RECORDING)[:260].drop(columns="t")
    model = graspd.load("mlp")
    for judge in (graspd.judge, model.predict, model.predict_proba):
        with pytest.raises(ValueError, match=r"nearly repeat another: sweeps .*read_as=stream"):
            list(judge(sweeps))
        with pytest.raises(ValueError, match="they change as sweeps of a stream do"):
            list(judge(sweeps, read_as="table"))
    sweeps.to_csv(tmp_path / "sweeps.csv", index=False)
    with pytest.raises(RecordingError, match=r"\(read_as=stream, and rate_hz= if it has no times"):
        list(graspd.judge(tmp_path / "sweeps.csv"))
    as_stream: Any = "stream"
    with pytest.raises(ValueError, match="'stream': a GraspModel judges grasps"):
        model.predict(sweeps[:9], read_as=as_stream)
    again = sweeps[:1].loc[[0, 0]]
    assert len(model.predict(again, read_as="table")) == 2


def test_grasps_of_a_finger_that_stands_still_are_unknown(counts: NDArray[np.float64]) -> None:
    model, half = graspd.load("mlp"), len(counts) // 2
    told = model.predict(counts)
    assert model.predict(np.concatenate((counts, counts)))[len(counts) :].tolist() == told.tolist()
    counts[half:, 2] = counts[0, 2]
    still = model.predict(counts)
    assert {still[0], *still[half:]} == {"unknown"}
    assert still[1:half].tolist() == told[1:half].tolist()
    assert set(told) == {"stable", "slip", "unknown"}


def test_a_table_with_rows_of_different_fingers_is_refused(counts: NDArray[np.float64]) -> None:
    names = [f"ff_biotac_{place}" for place in range(1, 25)]
    table = dict(zip(names, counts[:2, 0].T, strict=True))
    of_one: Any = {**table, "finger": ["ff", "FF "]}
    of_two: Any = {**table, "finger": ["ff", "th"]}
    model = graspd.load("small-session", fingers=["ff"])
    with pytest.warns(UserWarning, match="does not know the sensors"):
        assert len(model.predict(of_one, read_as="table")) == 2
    with pytest.raises(ValueError, match="column finger: has rows of ff and of th: put all"):
        model.predict(of_two, read_as="table")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (np.zeros((1, 3, 24)), "files and tables, not ndarray: GraspModel.predict takes counts"),
        ([[2000]], "files and tables, not list"),
        (memoryview(bytes(6)).cast("B", (2, 3)), "files and tables, not memoryview"),
        ([], "no recording was given"),
    ],
)
def test_judge_takes_only_files_and_tables(given: Any, words: str) -> None:  # noqa: ANN401
    with pytest.raises(ValueError, match=words):
        list(graspd.judge(given))


def test_a_session_not_needed_or_not_found_is_refused(
    counts: NDArray[np.float64], tmp_path: Path
) -> None:
    with pytest.raises(ModelError, match="mlp keeps no session"):
        graspd.load("mlp").predict_proba(counts[:1], session=counts)
    with pytest.raises(SessionFileError, match="No such file"):
        graspd.load("small-session").predict_proba(counts[:1], session=tmp_path / "none")


def test_a_warning_about_a_table_names_its_row(caplog: pytest.LogCaptureFixture) -> None:
    pytest.importorskip("pandas", reason="needs the extra `pandas`")
    stream = graspd.read_recording(DEMO_RECORDING)[:400]
    list(graspd.judge(stream.assign(slipped="perhaps 100 %")))
    [said] = [each for each in caplog.messages if "slipped" in each]
    assert "known: the table, row 0 (from 0), column slipped: 'perhaps 100 %'" in said
