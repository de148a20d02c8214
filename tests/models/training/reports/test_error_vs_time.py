"""`graspd report error-vs-time`: every model is in its figures, and the page is updated."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")
pytest.importorskip("matplotlib", reason="needs the extra `report`")

from matplotlib.figure import Figure

from graspd.models import zoo
from graspd.models.tactile_image import TactileImager
from graspd.models.training.reports import error_vs_time
from graspd.models.training.reports.candidates import errors, loop_image, measure
from tests.kit.inside import graspd

WHOLE_S = 300.0
"""Timeout of a test, s. A quick report takes 15 s, and minutes on a busy machine."""
pytestmark = [
    pytest.mark.timeout(WHOLE_S),
    pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning"),  # of Keras
]


@pytest.fixture(autouse=True, scope="module")
def fonts() -> None:
    """Let matplotlib open its fonts, which it keeps open, before any test."""
    figure = Figure()
    figure.subplots().set_xscale("log")
    for style, weight in (("normal", "bold"), ("italic", "normal")):
        figure.text(0.0, 0.0, "a", fontstyle=style, fontweight=weight)
    figure.draw_without_rendering()


@pytest.fixture(scope="module")
def folder(bts3_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("report")
    (out / "page.md").write_text("Above.\n\n| model, F1 in % | old |\n|---|---|\n| x |\n\nBelow.\n")
    options = "--data", bts3_dir, "--out", out, "--page", out / "page.md", "--quick"
    made = graspd("report", "error-vs-time", *options)
    assert made.returncode == 0
    assert made.stdout == (out / "error-vs-time.md").read_text()
    return out


@pytest.fixture(scope="module")
def found(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "error-vs-time.json").read_text())
    return content


def test_the_report_has_error_and_time_of_every_model(
    found: dict[str, Any],
) -> None:
    rows = {row["name"]: row for row in found["rows"]}
    assert set(zoo.names()) <= set(rows)
    for name in zoo.names():
        row = rows[name]
        cv = next(m for m in zoo.card(name)["contract"]["measured"] if m["protocol"] == "cv")
        assert row["error"]["cv"]["f1"] == cv["f1_mean"]
        assert row["error"]["cv"]["low"] < cv["f1_mean"] < row["error"]["cv"]["high"]
        assert 0 < row["time"]["hot_p50_us"] <= row["time"]["hot_p99_us"]
        low, high = row["time_of_runs"]["paced_p50_us"]
        assert 0 < low <= row["time"]["paced_p50_us"] <= high
    assert {row["kind"] for row in found["rows"]} == {"model", "peer"}


def test_a_page_lists_whole_hand_models_the_fastest_first(
    folder: Path, found: dict[str, Any]
) -> None:
    page = (folder / "page.md").read_text()
    assert page.startswith("Above.\n\n**made with --quick")
    assert error_vs_time.PAGE_TABLE.sub("", page) == "Above.\n\n\nBelow.\n", "with its mark"
    assert page.endswith("`graspd report error-vs-time`\n\nBelow.\n")
    told = [line.split("`")[1] for line in page.splitlines() if line.startswith("| `")]
    models = [row for row in found["rows"] if len(row["fingers"]) == 3 and row["kind"] == "model"]
    fastest = sorted(models, key=lambda row: row["time"]["paced_p50_us"])
    assert told == [row["name"] for row in fastest]


def test_a_quick_report_says_so_and_on_which_machine(folder: Path, found: dict[str, Any]) -> None:
    for suffix in ("svg", "md"):
        text = (folder / f"error-vs-time.{suffix}").read_text()
        assert "-quick" in text  # an XML comment has no "--"
        assert found["machine"]["processor"].split("(")[0] in text
    drawn = error_vs_time.draw({**found, "quick": False}, ["figures of all models"])
    assert "-quick" not in drawn
    assert "<desc>\nfigures of all models\n </desc>" in drawn
    assert "Error and run time" in drawn


def test_the_f1_interval_equals_nadeau_and_bengio_by_hand() -> None:
    figures = {
        "folds": 10,
        "train_grasps": 900.0,
        "test_grasps": 100.0,
        "spreads": {
            "f1": {"mean": 0.9, "std": 0.01},
            **{name: {"mean": 0.5} for name in ("accuracy", "brier", "ece")},
        },
    }
    found = errors(figures)
    # By hand: 2.262 (t, 9 degrees of freedom, 95 %) * 0.01 * sqrt(1/10 + 1/9) = 0.010394
    assert found["high"] - found["f1"] == pytest.approx(0.010394, abs=2e-6)
    assert found["f1"] - found["low"] == pytest.approx(0.010394, abs=2e-6)


def test_the_published_loops_make_the_same_image_as_graspd() -> None:
    counts = np.random.default_rng(0).integers(500, 3500, (3, 24), dtype=np.uint16)
    expected, _ = TactileImager(3).build_batch(counts[np.newaxis])
    np.testing.assert_allclose(loop_image(counts), expected[0], atol=1e-5)


def test_candidates_take_turns_and_each_reading_is_timed() -> None:
    order: list[str] = []
    steps = {name: lambda _index, name=name: order.append(name) for name in ("a", "b")}
    times = measure(steps, readings=20, paced=3)
    assert 0.0 < times["a"]["hot_p50_us"] <= times["a"]["hot_p99.9_us"]
    assert times["b"]["paced_p50_us"] > 0.0
    assert order[-6:] == ["a", "b"] * 3
    assert order[40:44] == ["a", "a", "b", "b"], "after the warm-up: two of each per round"
