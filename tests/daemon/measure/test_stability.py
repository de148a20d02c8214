"""Numerical stability: the report over the zoo, and its bounds over all counts of 12 bits."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

pytest.importorskip("onnx", reason="the report needs onnx, of the extra `train`")
pytest.importorskip("torch", reason="the report needs torch, of the extra `train`")

import onnx
import onnxruntime as ort
from onnx import helper, numpy_helper

from daemon.commands.report import add_arguments
from daemon.judge.decision import HELD, Limits, decide
from daemon.judge.network import Examined, Network
from daemon.judge.reasons import Decision
from daemon.measure.reference.reference import Reference
from daemon.measure.stability import report as stability
from daemon.measure.stability.cases import StabilityCase, recorded
from daemon.measure.stability.model import Bounds, ModelStability
from daemon.measure.stability.trust import trust_rows
from daemon.trust import learner
from daemon.trust.learner import Learner
from daemon.trust.risk import Risk
from models import zoo
from models.contract import ModelError, SessionInput
from models.inputs import builder
from models.layout import D1
from models.runtime import TactileModel

INPUT_BOUND, P_BOUND = 1e-5, 1e-4
"""As the report promises them."""

CASES = (
    "all electrodes equal",
    "sigma of 1 count",
    "sigma of 0.01 counts",
    "sigma of 1e-12 counts",
    "one electrode far off",
    "counts 4000 +- 0.5",
    "fingers' spreads 1e6 apart",
    "all 0",
    "all 4095",
    "alternating 0 and 4095",
    "one finger dead",
    "an electrode reads nan",
    "an electrode reads inf",
    "an electrode reads -inf",
    "an electrode reads denormal",
    "an electrode reads negative zero",
    "random 12-bit counts",
    "demo table",
    "demo stream",
    "next to the threshold",
)
STEPS = (
    "session statistics, 1e9 updates",
    "session statistics, an electrode that never moves",
    "session statistics, a spike of 1e6",
    "joint velocity, 0.5 rad within 0 ns",
    "device clock, a step of +1 s",
    "device clock, a step of -1 s",
    "calibration, 80 degrees within 1 counts",
    "calibration, steepest segment, 1e-6 counts wide",
    "gate, readings at 0.1 Hz",
    "gate, readings at 10 kHz",
    "CAN sweep number (16 bits) and tick (32 bits) at their wrap",
    "SPI bridge's sweep number (32 bits) at its wrap",
    "learner, 1e+04 outcomes, all of these in turns",
    "learner, 500 outcomes, constant features",
    "learner, 500 outcomes, features at the clip",
    "learner, 500 outcomes, features at the largest that is taken",
    "learner, 500 outcomes, contradicting labels",
    "learner, what is not finite or too large",
    "risk of 0.001 against adversaries, 20000 grasps each",
    "risk of 0.5 against adversaries, 20000 grasps each",
    "risk, threshold after 20000 lifts",
    "learner and risk, kept and restored",
    "learner and risk, time of a grasp judged and noted",
    "learner and risk, time of an outcome",
    "learner and risk, memory with all outcomes out, while it is kept",
    "batch norm, variances from 0 to 1e38, folded",
    "logits to +-1e4 and softmax underflow",
    "int8 saturation",
)
NEVER_JUDGED = (
    "all electrodes equal",
    "sigma of 1 count",
    "counts 4000 +- 0.5",
    "all 0",
    "all 4095",
    "alternating 0 and 4095",
    "one finger dead",
    "an electrode reads nan",
    "an electrode reads inf",
)


@dataclass(frozen=True)
class Run:
    code: int
    json: dict[str, Any]
    markdown: str


def run(*arguments: str) -> tuple[int, str]:
    """Exit code and standard output of the report."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    with contextlib.redirect_stdout(io.StringIO()) as output:
        code = stability.run(parser.parse_args(["stability", *arguments]))
    return code, output.getvalue()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The report over the whole zoo."""
    path = tmp_path_factory.mktemp("report") / "stability.md"
    code, text = run("--quick", "--json", "--markdown", str(path))
    return Run(code, json.loads(text), path.read_text("utf-8"))


@pytest.mark.timeout(240)  # the report takes a minute
def test_every_model_of_the_zoo_keeps_every_bound(whole: Run) -> None:
    broken = [row for row in whole.json["cases"] if row["problems"]]
    broken += [row for row in whole.json["steps"] if not row["held"]]
    assert broken == []
    assert (whole.code, whole.json["broken"]) == (0, 0)


@pytest.mark.parametrize("case", CASES)
def test_each_case_is_measured_on_each_model(whole: Run, case: str) -> None:
    rows = {row["model"]: row for row in whole.json["cases"] if row["case"] == case}
    assert sorted(rows) == zoo.names()
    for row in rows.values():
        assert sum(row["verdicts"].values()) == row["readings"] > 0
    assert f"| {case} |" in whole.markdown


@pytest.mark.parametrize("case", NEVER_JUDGED)
def test_what_cannot_be_judged_is_unknown_with_a_reason(whole: Run, case: str) -> None:
    for row in whole.json["cases"]:
        if row["case"] == case:
            assert row["verdicts"] == {"unknown": row["readings"]}
            assert sum(row["reasons"].values()) >= row["readings"]


@pytest.mark.parametrize("step", STEPS)
def test_each_step_stands_in_the_report(whole: Run, step: str) -> None:
    (row,) = [row for row in whole.json["steps"] if row["step"] == step]
    assert row["expected"]
    assert row["found"]
    assert f"| {step} |" in whole.markdown


def test_a_bound_that_nothing_keeps_makes_the_exit_code_1(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stability, "BOUNDS", Bounds(input_relative=1e-5, p_slip=1e-12))
    code, text = run("mlp", "--quick")
    assert code == 1
    assert "BROKEN: p_slip" in text
    assert max(map(len, text.splitlines())) < 400


@pytest.mark.parametrize(
    ("where", "name", "value", "broken"),
    [
        (Learner, "learn", lambda *_, **__: None, "learner, 500 outcomes, varied"),
        (learner, "MEAN_SPREADS_MAX", 60.0, "learner, 1e+04 outcomes, all of these in turns"),
        (learner, "INPUT_MAX", 1e4, "learner, what is not finite or too large"),
        (Risk, "bound", 3.0, "risk of 0.001 against adversaries, 20000 grasps each"),
        (Risk, "restore", lambda *_: None, "learner and risk, kept and restored"),
    ],
)
def test_a_learner_or_a_risk_that_is_wrong_breaks_its_bound(
    monkeypatch: pytest.MonkeyPatch, where: object, name: str, value: object, broken: str
) -> None:
    monkeypatch.setattr(where, name, value)
    assert not next(row for row in trust_rows(quick=True) if row.step == broken).held


def test_a_wrong_reference_breaks_the_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    right = Reference.probabilities
    monkeypatch.setattr(
        Reference, "probabilities", lambda self, inputs: right(self, inputs)[:, ::-1]
    )
    model = TactileModel(zoo.find("mlp"))
    measured = ModelStability(model, Reference(model.path), Bounds())
    for row in measured.measure(recorded(model.contract.fingers, None)):
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
    measured = ModelStability(model, Reference(model.path), Bounds())
    random = np.random.default_rng(0).integers(0, 4096, (5, 3, 24)).astype(np.uint16)
    (row,) = measured.measure([StabilityCase("random", random)])
    assert row.input_error > INPUT_BOUND
    assert any(problem.startswith("input") for problem in row.problems)


def test_a_model_or_a_table_that_is_not_there_is_said_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("no-such-model")[0] == 2
    assert run("mlp", "--data", str(tmp_path))[0] == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2
    assert "no-such-model" in said[0]
    assert "palm_down.csv" in said[1]


def test_without_onnx_the_report_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(sys.modules, "daemon.measure.reference.reference")
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert run("mlp")[0] == 2
    assert "needs the package 'onnx'" in capsys.readouterr().err


def test_no_real_grasp_gets_another_verdict_than_from_the_reference(bts3_dir: Path) -> None:
    model = TactileModel(zoo.find("small-session"))
    measured = ModelStability(model, Reference(model.path), Bounds())
    real = [row for row in recorded(model.contract.fingers, bts3_dir) if "real" in row.name]
    rows = list(measured.measure(real))
    assert sum(row.readings for row in rows) == 4682  # as published
    assert all(row.flips == 0 and not row.problems for row in rows)
    assert max(row.chain_error for row in rows) < P_BOUND


# Readings from the whole 12-bit space: anything at all, a few counts apart, at the rails, and one
# electrode far from all others.

COUNT = st.integers(0, 4095)


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


READINGS = st.lists(fingers(), min_size=3, max_size=3).map(
    lambda rows: np.array(rows, dtype=np.uint16)
)
Wide = NDArray[np.longdouble]
HANDS = {"cnn1": 3, "small-session": 3, "small-session-ff-th": 2, "small-session-mf": 1}
"""Number of fingers by model."""


@cache
def model_and_reference(name: str) -> tuple[TactileModel, Reference]:
    return TactileModel(zoo.find(name)), Reference(zoo.find(name))


@cache
def neighbours() -> list[list[tuple[tuple[int, int], list[tuple[int, int]]]]]:
    """By pass: each pixel that is filled in it, and the filled pixels around it (paper, II-A)."""
    passes, filled = [], set(zip(D1.rows, D1.columns, strict=True))
    while len(filled) < 12 * 11:
        empty = [(r, c) for r in range(12) for c in range(11) if (r, c) not in filled]
        around = [
            (pixel, [p for p in filled if max(abs(p[0] - pixel[0]), abs(p[1] - pixel[1])) == 1])
            for pixel in empty
        ]
        passes.append([(pixel, near) for pixel, near in around if near])
        filled |= {pixel for pixel, _ in passes[-1]}
    return passes


def by_hand(values: Wide) -> tuple[np.longdouble, np.longdouble]:
    """Mean and standard deviation."""
    mean = np.longdouble(values.sum()) / len(values)
    return mean, np.sqrt(((values - mean) ** 2).sum() / len(values))


def image_by_hand(counts: NDArray[np.uint16]) -> tuple[Wide, list[float]]:
    planes, spreads = [], []
    for finger in counts.astype(np.longdouble):
        image = np.zeros((12, 11), dtype=np.longdouble)
        image[list(D1.rows), list(D1.columns)] = finger
        for filled_now in neighbours():
            for pixel, near in filled_now:
                image[pixel] = image[tuple(np.transpose(near))].sum() / len(near)
        mean, spread = by_hand(image.ravel())
        planes.append((image - mean) / spread if spread >= 1.0 else 0.0 * image)
        spreads.append(float(spread))
    return np.stack(planes, axis=-1), spreads


def features_by_hand(counts: NDArray[np.uint16], wanted: SessionInput) -> tuple[Wide, list[float]]:
    moments = [by_hand(finger) for finger in counts.astype(np.longdouble)]
    z = [
        (finger.astype(np.longdouble) - mean) / spread if spread >= 1.0 else np.zeros(24)
        for finger, (mean, spread) in zip(counts, moments, strict=True)
    ]
    raw = np.concatenate([*z, [mean for mean, _ in moments], [spread for _, spread in moments]])
    standard = (raw - np.array(wanted.mean, np.longdouble)) / np.array(wanted.spread, np.longdouble)
    clipped: Wide = np.clip(standard, -wanted.clip, wanted.clip)
    return clipped, [float(spread) for _, spread in moments]


def inputs_by_hand(name: str, counts: NDArray[np.uint16]) -> tuple[Wide, list[float]]:
    wanted = model_and_reference(name)[0].contract.input
    if isinstance(wanted, SessionInput):
        return features_by_hand(counts, wanted)
    return image_by_hand(counts)


@pytest.mark.parametrize("name", HANDS)
@settings(max_examples=200)
@given(counts=READINGS)
def test_inputs_keep_their_bound_over_the_12_bit_space(
    name: str, counts: NDArray[np.uint16]
) -> None:
    contract = model_and_reference(name)[0].contract
    counts = counts[: HANDS[name]]
    inputs = builder(contract.input, HANDS[name])
    out = np.empty(inputs.shape, dtype=np.float32)
    spread = inputs.build(counts, out)
    exact, exact_spread = inputs_by_hand(name, counts)
    assert spread == pytest.approx(exact_spread, rel=1e-9, abs=1e-9)
    if min(abs(np.array(exact_spread) - 1.0)) > 1e-9:  # else either side may be right
        assert np.abs(out - exact).max() <= INPUT_BOUND * np.abs(exact).max()


@pytest.mark.parametrize("name", HANDS)
@settings(max_examples=200)
@given(counts=READINGS)
def test_probabilities_keep_their_bound_over_the_12_bit_space(
    name: str, counts: NDArray[np.uint16]
) -> None:
    model, reference = model_and_reference(name)
    counts = counts[: HANDS[name]]
    exact, exact_spread = inputs_by_hand(name, counts)
    said = Network(model, 0.5).judge(Examined((), counts))
    p_slip, reasons = said.p_slip, said.reasons
    if p_slip is None:
        assert reasons
        assert min(exact_spread) < 1.0 + 1e-9
        return
    wanted = reference.probabilities(exact[np.newaxis])[0, 1]
    assert abs(p_slip - wanted) < P_BOUND
    if abs(wanted - 0.5) > P_BOUND:
        assert (p_slip >= 0.5) == (wanted >= 0.5)


NOT_FINITE = st.sampled_from((np.nan, np.inf, -np.inf))


@pytest.mark.parametrize("name", zoo.names())
@settings(max_examples=40)
@given(counts=READINGS, wrong=st.dictionaries(st.integers(0, 71), NOT_FINITE, min_size=1))
def test_what_is_not_finite_never_gives_a_verdict(
    name: str, counts: NDArray[np.uint16], wrong: dict[int, float]
) -> None:
    model, _ = model_and_reference(name)
    floats = counts[: len(model.contract.fingers)].astype(np.float64)
    for place, value in wrong.items():
        floats.flat[place % floats.size] = value
    with np.errstate(invalid="ignore"):
        said = Network(model, 0.5).judge(Examined((), floats))
    assert said.p_slip is None
    assert said.reasons


@pytest.mark.parametrize("p_slip", [np.nan, np.inf, -np.inf, -1e-9, 1.0 + 1e-9, None])
def test_a_probability_that_is_none_is_unknown(p_slip: float | None) -> None:
    outcome, reasons = decide(p_slip, (), HELD, 0, Limits(max_age_ns=1))
    assert outcome is Decision.UNKNOWN
    assert reasons


# The reference itself, against onnxruntime, on what the zoo does not hold today.


def graph(tmp_path: Path, *nodes: onnx.NodeProto, **constants: NDArray[Any]) -> Path:
    """A model of images (N, 2, 4, 4) whose nodes end in `wide`, shape (N, 8)."""
    last = [
        helper.make_node("MatMul", ["wide", "last"], ["margins"]),
        helper.make_node("Softmax", ["margins"], ["probability"], axis=1),
    ]
    constants["last"] = np.random.default_rng(1).normal(size=(8, 2)).astype(np.float32)
    made = helper.make_graph(
        [*nodes, *last],
        "test",
        [helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, ["N", 2, 4, 4])],
        [helper.make_tensor_value_info("probability", onnx.TensorProto.FLOAT, ["N", 2])],
        [numpy_helper.from_array(values, name) for name, values in constants.items()],
    )
    path = tmp_path / "model.onnx"
    opsets = [helper.make_opsetid("", 18)]
    path.write_bytes(
        helper.make_model(made, opset_imports=opsets, ir_version=10).SerializeToString()
    )
    return path


def pooled(tmp_path: Path) -> Path:
    return graph(
        tmp_path,
        helper.make_node("MaxPool", ["x"], ["pool"], kernel_shape=[2, 2], strides=[2, 2]),
        helper.make_node("Flatten", ["pool"], ["wide"]),
    )


def saturated(tmp_path: Path) -> Path:
    """Of what is beyond +-12.8, eight bits hold the rail."""
    return graph(
        tmp_path,
        helper.make_node("QuantizeLinear", ["x", "scale", "zero"], ["levels"]),
        helper.make_node("DequantizeLinear", ["levels", "scale", "zero"], ["back"]),
        helper.make_node("MaxPool", ["back"], ["pool"], kernel_shape=[2, 2], strides=[2, 2]),
        helper.make_node("Flatten", ["pool"], ["wide"]),
        scale=np.array(0.1, dtype=np.float32),
        zero=np.array(0, dtype=np.int8),
    )


def whole_numbers(tmp_path: Path) -> Path:
    """Ranges that are taken per reading."""
    random = np.random.default_rng(2)
    return graph(
        tmp_path,
        helper.make_node("Flatten", ["x"], ["flat"]),
        helper.make_node("DynamicQuantizeLinear", ["flat"], ["levels", "scale", "zero"]),
        helper.make_node("MatMulInteger", ["levels", "weights", "zero"], ["sums"]),
        helper.make_node("Cast", ["sums"], ["floats"], to=onnx.TensorProto.FLOAT),
        helper.make_node("Mul", ["floats", "scale"], ["wide"]),
        weights=random.integers(-9, 10, (32, 8)).astype(np.int8),
    )


@pytest.mark.parametrize("make", [pooled, saturated, whole_numbers])
@pytest.mark.parametrize("size", [1.0, 1e3])
def test_the_reference_agrees_with_onnxruntime(tmp_path: Path, make: Any, size: float) -> None:  # noqa: ANN401
    path = make(tmp_path)
    images = np.random.default_rng(0).normal(size=(20, 2, 4, 4), scale=size).astype(np.float32)
    session = ort.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    wanted = [session.run(None, {"x": image[np.newaxis]})[0][0] for image in images]
    reference = Reference(path)
    assert np.abs(reference.probabilities(images) - wanted).max() < 1e-5
    assert reference.is_stepped == reference.is_quantised == (make is not pooled)


def test_an_operator_without_a_reference_is_refused(tmp_path: Path) -> None:
    path = graph(tmp_path, helper.make_node("NoSuch", ["x"], ["wide"]))
    with pytest.raises(ModelError, match="NoSuch"):
        Reference(path)
