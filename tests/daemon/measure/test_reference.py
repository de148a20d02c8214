"""The float64 reference against onnxruntime, on operators that the zoo does not hold today."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("onnx", reason="the reference needs onnx, of the extra `train`")

import onnx
import onnxruntime as ort
from onnx import helper, numpy_helper

from daemon.measure.reference.reference import Reference
from models.contract import ModelError


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
