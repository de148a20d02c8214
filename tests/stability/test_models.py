"""Each model of the zoo keeps its bounds on stiff, extreme, impossible and real readings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

pytest.importorskip("onnx", reason="needs the extra `train`")

from graspd.drivers.recordings.csv_player import DEMO_RECORDING, DEMO_TABLE
from graspd.drivers.recordings.csv_rows import read_rows
from graspd.models import zoo
from graspd.models.inputs import builder
from graspd.models.judge.grasp_judge import Examined, GraspJudge
from graspd.models.runtime import TactileModel
from tests.stability.comparison import (
    INPUT_RELATIVE_MAX,
    P_SLIP_ERROR_MAX,
    CaseRow,
    Comparison,
    comparison,
)
from tests.stability.exact import Reference, exact_input
from tests.stability.readings import (
    LIKELY,
    NEVER_JUDGED,
    ONE_HAND,
    RANDOM,
    READINGS,
    Raw,
    likely_grasps,
)

Note = Callable[..., None]
STREAM_STEP = 20
"""Every 20th row of the demo stream is taken: its neighbours differ by noise alone."""
SEASONED = ", session of 1e9 grasps"


def check(note: Note, model: str, case: str, row: CaseRow) -> None:
    """Put the row into the report, then see that it breaks no bound."""
    note(model=model, case=case, **asdict(row))
    assert row.readings == sum(row.verdicts.values()) > 0
    assert not row.problems


def recorded(path: Path, model: str) -> Raw:
    fingers = comparison(model).model.contract.fingers
    return np.array([row.counts for row in read_rows(path, fingers)])


@pytest.mark.parametrize("case", READINGS)
def test_each_model_keeps_its_bounds(note: Note, model: str, case: str) -> None:
    compared = comparison(model)
    counts = READINGS[case](likely_grasps(compared.model.contract.seen))
    row = compared.row(counts, never_judged=case in NEVER_JUDGED, one_hand=case in ONE_HAND)
    check(note, model, case, row)
    if case in NEVER_JUDGED:
        assert row.verdicts == {"unknown": row.readings}
        assert sum(row.reasons.values()) >= row.readings


@pytest.mark.parametrize(
    ("case", "path", "step"),
    [("demo table", DEMO_TABLE, 1), ("demo stream", DEMO_RECORDING, STREAM_STEP)],
)
def test_each_model_keeps_its_bounds_on_the_demo(
    note: Note, model: str, case: str, path: Path, step: int
) -> None:
    counts = recorded(path, model)[::step]
    check(note, model, case, comparison(model).row(counts, one_hand=True))


def test_each_model_keeps_its_bounds_next_to_the_threshold(note: Note, model: str) -> None:
    compared = comparison(model)
    counts = compared.near_threshold(likely_grasps(compared.model.contract.seen))
    check(note, model, "next to the threshold", compared.row(counts))


@pytest.mark.parametrize("case", [LIKELY, RANDOM])
def test_a_session_of_1e9_grasps_keeps_its_bounds(
    note: Note, session_model: str, case: str
) -> None:
    compared = comparison(session_model, seasoned=True)
    counts = READINGS[case](likely_grasps(compared.model.contract.seen))
    check(note, session_model, case + SEASONED, compared.row(counts, one_hand=True))


@pytest.mark.parametrize(
    ("table", "rows"), [("palm_down", 1276), ("palm_side", 1273), ("palm_45", 2133)]
)  # as published
def test_real_grasps_keep_the_bounds(
    note: Note, recorded_model: str, table: str, rows: int, bts3_dir: Path
) -> None:
    counts = recorded(bts3_dir / f"{table}.csv", recorded_model)
    row = comparison(recorded_model).row(counts, one_hand=True)
    assert len(counts) == rows
    check(note, recorded_model, f"real grasps, {table}", row)


# The comparison itself finds what is wrong.


def test_a_wrong_reference_breaks_the_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    right = Reference.probabilities
    monkeypatch.setattr(Reference, "probabilities", lambda *args: right(*args)[:, ::-1])
    row = comparison("mlp").row(recorded(DEMO_TABLE, "mlp"))
    assert any("flipped" in problem for problem in row.problems)
    assert any(problem.startswith("p_slip") for problem in row.problems)


def test_a_wrong_input_breaks_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    model = TactileModel(zoo.find("mlp"))
    build = model.inputs.build

    def wrong(counts: NDArray[np.generic], out: NDArray[np.float32]) -> NDArray[np.float64]:
        spread = build(counts, out)
        out[0] += 1e-3
        return spread

    monkeypatch.setattr(model.inputs, "build", wrong)
    random = np.random.default_rng(0).integers(0, 4096, (5, 3, 24)).astype(np.uint16)
    row = Comparison(model, Reference(model.path)).row(random)
    assert any(problem.startswith("input") for problem in row.problems)


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


@pytest.mark.parametrize("name", HANDS)
@settings(max_examples=200)
@given(counts=HAND)
def test_inputs_and_probabilities_keep_their_bounds_over_the_12_bit_space(
    name: str, counts: Raw
) -> None:
    model, reference = comparison(name).model, comparison(name).reference
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
