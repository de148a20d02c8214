"""Each row of `graspd report stability` keeps its bounds, and wrong figures break theirs.

It finds what process replay does not: weights of the image that are rounded to float32.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

pytest.importorskip("onnx", reason="needs the extra `train`")

from graspd.models import zoo
from graspd.models.inputs import builder
from graspd.models.judge.grasp_judge import Examined, GraspJudge
from graspd.models.runtime import TactileModel
from graspd.models.training.reports.stability import chain, trust
from graspd.models.training.reports.stability.chain import (
    INPUT_RELATIVE_MAX,
    P_SLIP_ERROR_MAX,
    Comparison,
)
from graspd.models.training.reports.stability.exact import Reference, exact_input
from graspd.models.training.reports.stability.readings import RANDOM, READINGS, Raw
from graspd.models.training.reports.stability.row import Row
from tests.kit.inside import graspd

DEFAULT = "small-session"


@pytest.fixture(scope="module", autouse=True)
def trust_once() -> Iterator[None]:
    """Measure the rows of learner and risk, which belong to no model, once per process."""
    measure = trust.rows
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trust, "rows", cache(lambda outcomes: list(measure(outcomes))))
        yield


@pytest.mark.parametrize("name", zoo.names())
def test_each_models_rounding_errors_keep_the_reports_bounds(name: str) -> None:
    rows = list(chain.rows(name))
    assert {row.case for row in rows} >= {*READINGS, "next to the threshold"}
    assert [row.case for row in rows if row.broken] == []
    assert all(sum(row.answers.values()) == row.figures["readings"] > 0 for row in rows)


def test_the_default_models_rounding_errors_on_real_grasps_keep_bounds(bts3_dir: Path) -> None:
    rows = list(chain.rows(DEFAULT, bts3_dir))[-3:]
    assert [row.figures["readings"] for row in rows] == [1276, 1273, 2133]  # as published
    assert [row.case for row in rows if row.broken] == []


# The comparison itself finds what is wrong.


def test_the_comparison_notices_a_reference_with_swapped_probabilities(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    right = Reference.probabilities
    monkeypatch.setattr(Reference, "probabilities", lambda *args: right(*args)[:, ::-1])
    assert {"network", "p_slip", "flips"} <= set(compared("mlp").broken)


def test_a_wrong_network_input_breaks_its_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    model = TactileModel(zoo.find("mlp"))
    build = model.inputs.build

    def wrong(counts: NDArray[np.generic], out: NDArray[np.float32]) -> NDArray[np.float64]:
        spread = build(counts, out)
        out[0] += 1e-3
        return spread

    monkeypatch.setattr(model.inputs, "build", wrong)
    random = np.random.default_rng(0).integers(1, 4095, (5, 3, 24)).astype(np.uint16)
    assert "input" in Comparison(model, None).row("made up", random).broken


def test_a_figure_that_is_nan_breaks_its_bound() -> None:
    row = Row(
        "mlp", "made up", {"p_slip": float("nan"), "flips": 0.0}, {"p_slip": 1.0, "flips": 0.0}
    )
    assert row.broken == ["p_slip"]
    assert row.cells()[-1] == "BROKEN p_slip: at most 1"
    assert row.to_builtins()["figures"] == {"p_slip": None, "flips": 0.0}


def compared(name: str) -> Row:
    """Return the row of a model for random counts."""
    (row,) = (row for row in chain.rows(name) if row.case == RANDOM)
    return row


# The command.


def test_the_report_names_processor_and_number_of_broken_rows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = graspd("report", "stability", "small-session-mf", "--quick")
    assert made.returncode == 0
    assert "| small-session-mf | all 0 | readings 1," in made.stdout
    assert "| learner | 3e+03 outcomes |" in made.stdout
    assert "0 of 40 rows break a bound, on processor " in made.stdout
    assert "BLAS" in made.stdout
    monkeypatch.setattr(chain, "INPUT_RELATIVE_MAX", -1.0)
    broken = graspd("report", "stability", "small-session-mf", "--quick", "--json")
    assert broken.returncode == 1
    assert json.loads(broken.stdout)["broken"] == 27


def test_a_missing_model_or_table_is_one_line_on_stderr(tmp_path: Path) -> None:
    for words, named in ((["no-such-model"], "no-such-model"), (["--data", tmp_path], "palm_down")):
        refused = graspd("report", "stability", *words)
        assert (refused.returncode, refused.stdout) == (2, "")
        (line,) = refused.stderr.splitlines()
        assert named in line


# Readings from the whole 12-bit space: anything at all, a few counts apart, at the rails, and one
# electrode far from all others.

COUNT = st.integers(0, 4095)
HANDS = ("cnn1", "small-session", "small-session-ff-th", "small-session-mf")
"""Models of three, three, two and one finger."""


@st.composite
def fingers(draw: st.DrawFn) -> list[int]:
    kind = draw(st.sampled_from(("any", "close", "rails", "alone")))
    if kind == "any":
        return draw(st.lists(COUNT, min_size=24, max_size=24))
    if kind == "rails":
        return draw(st.lists(st.sampled_from((0, 1, 4094, 4095)), min_size=24, max_size=24))
    low, width = draw(st.integers(0, 4000)), draw(st.integers(1, 95))
    close = draw(st.lists(st.integers(low, low + width), min_size=24, max_size=24))
    if kind == "alone":
        close[draw(st.integers(0, 23))] = draw(COUNT)
    return close


HAND = st.lists(fingers(), min_size=3, max_size=3).map(lambda rows: np.array(rows, dtype=np.uint16))


@cache
def loaded(name: str) -> tuple[TactileModel, Reference]:
    model = TactileModel(zoo.find(name))
    return model, Reference(model.path)


@pytest.mark.parametrize("name", HANDS)
@settings(max_examples=200)
@given(counts=HAND)
def test_for_any_12_bit_counts_inputs_and_probabilities_keep_bounds(name: str, counts: Raw) -> None:
    model, reference = loaded(name)
    counts = counts[: len(model.contract.fingers)]
    inputs = builder(model.contract.input, len(counts))
    out = np.empty(inputs.shape, dtype=np.float32)
    spread = inputs.build(counts, out)
    (exact,), (exact_spread,) = exact_input(model.contract, counts[np.newaxis])
    assert spread == pytest.approx(exact_spread.astype(float), rel=1e-9, abs=1e-9)
    if min(abs(exact_spread - 1.0)) > 1e-9:  # else either side may be right
        assert np.abs(out - exact).max() <= INPUT_RELATIVE_MAX * np.abs(exact).max()

    judge = GraspJudge.of(model)
    judge.session = None  # no softening
    said = judge.judge(Examined(counts))
    if said.p_slip is None:
        assert said.refusal
        assert min(exact_spread) < 1.0 + 1e-9
        return
    wanted = reference.probabilities(exact[np.newaxis])[0, 1]
    assert abs(said.p_slip - wanted) < P_SLIP_ERROR_MAX
    if abs(wanted - 0.5) > P_SLIP_ERROR_MAX:
        assert (said.p_slip >= 0.5) == (wanted >= 0.5)
