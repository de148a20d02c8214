"""Each reader reads the tables of each writer; sweeps of a stream are not read as grasps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from graspd import load, read_grasps, read_recording
from graspd.drivers.recordings.csv_player import DEMO_RECORDING, DEMO_TABLE
from graspd.drivers.recordings.layout import layout_of
from graspd.models.training.data.datasets import read_table
from tests.kit.inside import refused

pd = pytest.importorskip("pandas", reason="needs the extra pandas")
WRITERS: dict[str, Callable[[Path], object]] = {
    "pandas": lambda path: read_grasps(DEMO_TABLE).to_csv(path, index=False),
    "pandas with its index": lambda path: read_grasps(DEMO_TABLE).to_csv(path),
    "gzip": lambda path: read_grasps(DEMO_TABLE).to_csv(path, index=False, compression="gzip"),
    "Parquet": lambda path: read_grasps(DEMO_TABLE).to_parquet(path),
    "Excel in Germany": lambda path: read_grasps(DEMO_TABLE).to_csv(path, sep=";", index=False),
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_every_reader_reads_the_table_of_each_writer(
    tmp_path: Path, write: Callable[[Path], object]
) -> None:
    plain, path = read_grasps(DEMO_TABLE), tmp_path / "written"
    write(path)
    again = read_grasps(path)
    pd.testing.assert_frame_equal(again[plain.columns], plain, check_dtype=False)
    trained = read_table(path)
    assert trained.slipped.tolist() == plain["slipped"].tolist()
    assert trained.counts.reshape(len(plain), -1).tolist() == plain.iloc[:, 2:].to_numpy().tolist()
    assert not layout_of(path, ("ff", "mf", "th")).is_stream


def test_a_stream_written_by_pandas_is_read_back(tmp_path: Path) -> None:
    frame = read_recording(DEMO_RECORDING)
    frame.iloc[:300].to_csv(tmp_path / "stream", index=False)
    frame.iloc[:300].to_parquet(tmp_path / "parquet")
    for name in ("stream", "parquet"):
        pd.testing.assert_frame_equal(read_recording(tmp_path / name), frame.iloc[:300])


def test_grasps_without_an_outcome_are_left_out_with_a_warning(tmp_path: Path) -> None:
    frame = read_grasps(DEMO_TABLE)
    frame["slipped"] = frame["slipped"].astype(object)
    frame.loc[[3, 5], "slipped"] = None
    frame.to_csv(tmp_path / "grasps.csv", index=False)
    with pytest.warns(UserWarning, match="2 of 200 grasps have no outcome, and are left out"):
        assert len(read_grasps(tmp_path / "grasps.csv")) == 198
    assert read_table(tmp_path / "grasps.csv").without_outcome == 2


def test_a_stream_is_not_judged_as_grasps_by_the_library() -> None:
    stream = read_recording(DEMO_RECORDING).iloc[:50]
    model = load("mlp")
    for given in (stream, stream.rename(columns={"t": "%time"})):
        with pytest.raises(ValueError, match="the table is a stream, by its column"):
            model.predict_proba(given)
        with pytest.raises(ValueError, match="the table is a stream, by its column"):
            load("small-session").predict(stream, session=stream)


@pytest.mark.parametrize(
    "words", [["replay"], ["session", "seed", "scene.toml"], ["train", "svm", "--own"]]
)
def test_no_command_reads_sweeps_without_times_as_grasps(
    tmp_path: Path, words: Sequence[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if words[0] == "train":
        pytest.importorskip("onnx", reason="needs the extra `train`")
    monkeypatch.chdir(tmp_path)
    sweeps = pd.read_csv(DEMO_RECORDING, nrows=1200).drop(columns="t")
    sweeps.to_csv(tmp_path / "sweeps.csv", index=False)
    (tmp_path / "scene.toml").write_text(
        '[tactile]\ndriver = "replay"\nrecordings = ["sweeps.csv"]\n'
        '[session]\nkeep = true\nfolder = "session"\n'
    )
    says = "rows nearly repeat another: sweeps of a stream (--as stream"
    assert says in refused(*words, "sweeps.csv")
    assert not list(tmp_path.glob("session/*.session"))
    refused("replay", DEMO_RECORDING, "--gate", "every")
