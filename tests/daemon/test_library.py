"""The library says what the daemon's own commands say, and its page's example runs."""

from __future__ import annotations

import functools
import io
import json
import pickle
import re
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import graspd
from graspd.drivers.base import RecordingError
from graspd.drivers.recordings.csv_player import DEMO_DAY
from graspd.models import zoo
from graspd.models.contract import ModelError
from tests.conftest import ROOT
from tests.kit import inside

PAGE = (ROOT / "deploy" / "LIBRARY.md").read_text()


def messages(*words: object) -> list[dict[str, Any]]:
    """The verdicts that `graspd replay` with the arguments `words` prints as JSON."""
    done = inside.graspd("replay", *words, "--json")
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_importing_graspd_loads_neither_onnxruntime_nor_numpy() -> None:
    code = "import sys, graspd; sys.exit('numpy' in sys.modules or 'onnxruntime' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_each_name_of_the_library_exists_and_is_documented() -> None:
    assert dir(graspd) == sorted(graspd.__all__)
    for name in graspd.__all__:
        assert getattr(graspd, name) is not None
        assert name in PAGE
    with pytest.raises(AttributeError, match="no attribute 'loads'"):
        graspd.loads  # noqa: B018


def test_probabilities_are_those_of_a_replay(counts: NDArray[np.float64]) -> None:
    said = messages(DEMO_DAY, "--model", "mlp")
    expected = [np.nan if each["p_slip"] is None else each["p_slip"] for each in said]
    got = graspd.load("mlp").predict_proba(counts)
    assert np.isfinite(expected).sum() > 100
    np.testing.assert_array_equal(got[:, 1], expected)
    np.testing.assert_allclose(got.sum(axis=1)[np.isfinite(expected)], 1.0)


def test_a_session_from_earlier_grasps_judges_as_a_replay_does(counts: NDArray[np.float64]) -> None:
    said = messages(DEMO_DAY)
    model = graspd.load("small-session")
    pickled: graspd.GraspModel = pickle.loads(pickle.dumps(model))
    for each in (model, pickled):
        got = each.predict_proba(counts[40:41], session=counts[:40])
        assert got[0, 1] == said[40]["p_slip"]


def test_predict_proba_repairs_a_railed_electrode_as_judge_does(
    counts: NDArray[np.float64],
) -> None:
    railed = counts[:12].copy()
    for row in range(12):
        railed[row, 1, 2 * row] = 4095 * (row % 2)
    expected = [each.p_slip for each in graspd.judge(GIVEN["columns by name"](railed), model="mlp")]
    assert sum(p_slip is not None for p_slip in expected) > 5
    got = graspd.load("mlp").predict_proba(railed)
    assert [None if np.isnan(each) else each for each in got[:, 1]] == expected


def test_a_session_of_too_few_grasps_or_none_warns(counts: NDArray[np.float64]) -> None:
    model = graspd.load("small-session")
    with pytest.warns(UserWarning, match="Give session= 20 grasps or more"):
        model.predict_proba(counts[:1])
    with pytest.warns(UserWarning, match="does not know the sensors of this day"):
        model.predict_proba(counts[:1], session=counts[:19])


@pytest.mark.parametrize("name", ["small-session", "cnn1"])
def test_threads_that_share_a_model_get_the_same_results(
    name: str, counts: NDArray[np.float64]
) -> None:
    model = graspd.load(name)
    session = counts[:60] if name == "small-session" else None
    expected = model.predict_proba(counts, session=session)
    orders = [np.arange(len(counts))[:: 1 if k % 2 else -1] for k in range(12)]
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(4) as threads:
            judge = functools.partial(model.predict_proba, session=session)
            given = list(threads.map(judge, [counts[order] for order in orders]))
    finally:
        sys.setswitchinterval(before)
    assert np.isfinite(expected).sum() > 100
    for order, got in zip(orders, given, strict=True):
        np.testing.assert_array_equal(got, expected[order])


FORKS = """
import os, sys, threading, warnings
import numpy as np
import graspd

warnings.simplefilter("ignore")
model, counts = graspd.load("small-session"), np.full((1, 3, 24), 2000)
judges, ends = threading.Event(), threading.Event()


class Waits:
    def __array__(self, dtype=None, copy=None):
        judges.set()
        ends.wait()
        return counts


def is_refused_in_a_child():
    child = os.fork()
    if child == 0:
        try:
            model.predict(counts)
        except RuntimeError as error:
            os._exit("load it there again" in str(error))
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1


assert not is_refused_in_a_child()
other = threading.Thread(target=lambda: model.predict(counts, session=Waits()))
other.start()
judges.wait()
assert is_refused_in_a_child()
ends.set()
other.join()
assert not is_refused_in_a_child()
"""


def test_judging_in_a_process_forked_while_judging_is_refused() -> None:
    subprocess.run([sys.executable, "-c", FORKS], check=True, timeout=60)


@pytest.mark.parametrize("name", ["small-session", "cnn1", "svm"])
@pytest.mark.filterwarnings("ignore:small-session does not know the sensors")
def test_what_the_daemon_would_refuse_has_no_probability(
    counts: NDArray[np.float64], name: str
) -> None:
    model, session = graspd.load(name), None
    given = np.repeat(counts[:1], 5, axis=0)
    given[1, 1] = 2000.0  # flat
    given[2, 0, :9] = np.nan
    given[3], given[4] = 0.0, 4095.0
    if name == "small-session":
        session = np.full((30, 3, 24), np.nan)
    assert np.isnan(model.predict_proba(given, session=session)[1:]).all()


def with_none(values: NDArray[np.float64]) -> list[Any]:
    return np.where(np.isnan(values), None, values.astype(object)).tolist()  # type: ignore[call-overload,no-any-return]


def masked(values: NDArray[np.float64]) -> Any:  # noqa: ANN401
    """A masked array of the counts: NaN is masked, with a plausible count below the mask."""
    return np.ma.array(np.nan_to_num(values, nan=3250).astype(np.uint16), mask=np.isnan(values))


def columns(values: NDArray[np.float64]) -> dict[str, list[int | None]]:
    """Columns of counts by name, in the reverse order of the model's; NaN becomes None."""
    names = [f"{finger}_biotac_{place}" for finger in ("ff", "mf", "th") for place in range(1, 25)]
    rows = values.reshape(len(values), 72).T
    whole = [[None if np.isnan(each) else int(each) for each in row] for row in rows]
    return dict(reversed(list(zip(names, whole, strict=True))))


def pandas(values: NDArray[np.float64], kind: str) -> Any:  # noqa: ANN401
    pd = pytest.importorskip("pandas", reason="needs the extra `pandas`")
    return pd.DataFrame(columns(values)).astype(kind)


def arrow(values: NDArray[np.float64]) -> Any:  # noqa: ANN401
    pa = pytest.importorskip("pyarrow", reason="needs the extra `pandas`")
    return pa.table(columns(values))


def polars(values: NDArray[np.float64]) -> Any:  # noqa: ANN401
    pl = pytest.importorskip("polars", reason="no extra brings polars, of 180 MB")
    return pl.DataFrame(columns(values))


GIVEN: dict[str, Callable[[NDArray[np.float64]], Any]] = {
    "lists": with_none,
    "a masked array": masked,
    "a list of masked arrays": lambda values: list(masked(values)),
    "columns by name": columns,
    "pandas": lambda values: pandas(values, "float64"),
    "pandas of its own integers": lambda values: pandas(values, "Int64"),
    "Arrow": arrow,
    "polars": polars,
}


@pytest.mark.parametrize("given", GIVEN.values(), ids=GIVEN)
def test_counts_in_any_container_get_the_same_probabilities(
    counts: NDArray[np.float64], given: Callable[[NDArray[np.float64]], Any]
) -> None:
    values = counts[:20].copy()
    values[:5, 0, :], values[5:10, 1, 7] = np.nan, np.nan
    model = graspd.load("mlp")
    expected = model.predict_proba(values)
    assert np.isnan(expected[:5]).all()
    assert np.isfinite(expected[5:, 0]).sum() > 10
    np.testing.assert_array_equal(model.predict_proba(given(values)), expected)


REFUSED: dict[str, tuple[Callable[[NDArray[np.float64]], Any], str]] = {
    "below 0": (lambda values: values - 4000, r"whole numbers in 0..4095.*grasp 0 .*ff_1 has -"),
    "above 12 bits": (lambda values: values + 4096, "whole numbers in 0..4095.*ff_1 has [4-8]"),
    "a half": (lambda values: values + 0.5, r"whole numbers in 0..4095.*ff_1 has \d+\.5"),
    "rounded": (lambda values: values.astype(np.float16), "float16 rounds counts above 2048"),
    "infinite": (lambda values: values * np.inf, "whole numbers in 0..4095.*ff_1 has inf"),
    "a time": (lambda values: values.astype("datetime64[s]"), "are not numbers"),
    "a path": (lambda values: str(DEMO_DAY), "synthetic_day.csv' and the like are not numbers"),
    "True": (lambda values: values > 2000, "are not numbers"),
    "one grasp": (lambda values: values[0], r"shape \(3, 24\); it takes \(n, 3, 24\): ff, mf, th"),
    "uneven lists": (lambda values: [[1, 2], [3]], "lists of different lengths"),
    "no column": (lambda values: {"a": [], "b": []}, "no column ff_biotac_1.* begin with a, b"),
    "text in a column": (
        lambda values: columns(values) | {"th_biotac_2": ["x"] * len(values)},
        "the column th_biotac_2: 'x' and the like are not numbers",
    ),
    "a column twice": (
        lambda values: (table := arrow(values)).append_column("mf_biotac_3", table["mf_biotac_3"]),
        "the column mf_biotac_3 more than once",
    ),
    "uneven columns": (
        lambda values: columns(values) | {"mf_biotac_3": [2000]},
        r"the column mf_biotac_3 has shape \(1,\), and others \(\d+,\)",
    ),
    "an index of times": (
        lambda values: pandas(values, "int").set_index(np.arange(len(values)) / 100),
        "the index of the table is a time",
    ),
    "not collected": (lambda values: polars(values).lazy(), "LazyFrame has no values yet"),
}


@pytest.mark.parametrize(("given", "words"), REFUSED.values(), ids=REFUSED)
def test_invalid_counts_are_refused_with_the_reason(
    counts: NDArray[np.float64], given: Callable[[NDArray[np.float64]], Any], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        graspd.load("mlp").predict_proba(given(counts))


def test_predict_names_the_most_probable_class_or_unknown(counts: NDArray[np.float64]) -> None:
    model = graspd.load("mlp")
    counts = np.concatenate([counts, np.full((1, 3, 24), np.nan)])
    best = model.classes_[model.predict_proba(counts).argmax(axis=1)]
    said = model.predict(counts)
    assert list(model.classes_) == ["stable", "slip"]
    assert said[-1] == "unknown"
    np.testing.assert_array_equal(said[said != "unknown"], best[said != "unknown"])
    assert repr(model) == "<GraspModel mlp of ff, mf, th>"


def test_a_pickled_recording_error_keeps_text_and_fields(tmp_path: Path) -> None:
    with pytest.raises(RecordingError) as raised:
        graspd.read_recording(tmp_path / "none.csv")
    again = pickle.loads(pickle.dumps(raised.value))
    assert (str(again), vars(again)) == (str(raised.value), vars(raised.value))


def test_a_model_whose_file_changed_is_refused_at_unpickling(tmp_path: Path) -> None:
    path = tmp_path / "own.onnx"
    path.write_bytes(zoo.find("mlp").read_bytes())
    kept = pickle.dumps(graspd.load(path))
    assert pickle.loads(kept).fingers == ("ff", "mf", "th")
    path.write_bytes(zoo.find("svm").read_bytes())
    with pytest.raises(ModelError, match="was changed since"):
        pickle.loads(kept)


@pytest.mark.parametrize(
    ("fingers", "words"),
    [
        (["ff", "index"], "no finger is called 'index'"),
        (["ff", "rf"], "small-session of ff, mf, th> does not judge a hand of ff, rf"),
        (["th", "ff", "mf"], "ff, mf, th> takes counts in this order, not of th, ff, mf"),
    ],
)
def test_fingers_that_do_not_fit_are_refused(fingers: Any, words: str) -> None:  # noqa: ANN401
    with pytest.raises((ValueError, ModelError), match=words):
        graspd.load("small-session", fingers=fingers)


def examples() -> list[str]:
    return re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def test_the_first_example_of_library_md_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    exec(compile(examples()[0], "LIBRARY.md", "exec"), {})
    said = capsys.readouterr().out
    assert "slipped" in said
    assert "Name: ff_biotac_1" in said
    assert re.search(r"^0 +1 +(stable|slip|unknown) ", said, re.MULTILINE)


@pytest.fixture(scope="module")
def fonts() -> None:
    """Let matplotlib open its fonts, which it keeps open, before the test."""
    pytest.importorskip("matplotlib", reason="needs the extra `report`")
    graspd.plot_grasp(np.full((3, 24), 2000)).savefig(io.BytesIO())


def test_the_plot_example_of_library_md_makes_an_image(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    fonts: None,
) -> None:
    monkeypatch.chdir(tmp_path)
    today = graspd.read_grasps(DEMO_DAY)[:50]
    exec(compile(examples()[1], "LIBRARY.md", "exec"), {"graspd": graspd, "today": today})
    assert capsys.readouterr().out == "(9, 12, 11, 3)\n"
    assert (tmp_path / "grasp.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("function", "package", "extra"),
    [
        ("read_grasps", "pandas", "pandas"),
        ("read_recording", "pandas", "pandas"),
        ("read_grasps", "mcap", "record"),
        ("read_recording", "mcap", "record"),
    ],
)
def test_a_missing_extra_raises_an_error_with_install_command(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, function: str, package: str, extra: str
) -> None:
    path = tmp_path / "run"
    path.write_bytes(b"\x89MCAP0\r\n")
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, "graspd.daemon.record.frames", raising=False)
    assert hasattr(graspd, function), "`from graspd import *` needs no extra"
    advice = re.escape(f"run {sys.executable} -m pip install '.[{extra}]'")
    with pytest.raises(ModuleNotFoundError, match=rf"{function}.* '{package}': {advice}"):
        getattr(graspd, function)(path)
