"""Smaller forms of a trained network: half-precision weights, 8-bit integers, a factored layer."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from onnx import helper, numpy_helper
from onnxruntime.quantization import (
    CalibrationDataReader,
    QuantFormat,
    QuantType,
    quantize_dynamic,
    quantize_static,
)

from models.runtime import single_threaded
from models.training.arrays import Floats, Floats32
from models.training.estimators.graphs import MARGIN_NAME, copied, quiet, set_nodes

CALIBRATION_GRASPS = 256
"""Training grasps by which static quantisation learns the ranges of what flows between layers."""


@dataclass(frozen=True, slots=True)
class HalfWeights:
    """Weights stored with 16 bits (IEEE half); the arithmetic stays float32."""


@dataclass(frozen=True, slots=True)
class Integers:
    """Weights of 8 bits, per output channel; inputs of a layer of 8 bits too."""

    static: bool
    """Whether the ranges of a layer's inputs are those of the training, or taken per reading."""


@dataclass(frozen=True, slots=True)
class LowRank:
    """The largest dense layer as a product of two: its truncated singular value decomposition."""

    rank: int


Compression = HalfWeights | Integers | LowRank


def compressed(margin: onnx.ModelProto, how: Compression, inputs: Floats32) -> onnx.ModelProto:
    """The graph to `margin` in a smaller form; `inputs` (N, *shape) are those of the training.

    Raises `ValueError` if the graph has no dense layer to factor.
    """
    match how:
        case HalfWeights():
            return _half(margin)
        case LowRank(rank):
            return _low_rank(margin, rank)
        case Integers(static):
            return _integers(margin, inputs, static=static)


def size(model: onnx.ModelProto) -> int:
    """How many numbers the graph's constants consist of."""
    return sum(int(np.prod(constant.dims)) for constant in model.graph.initializer)


def graph_margins(model: onnx.ModelProto, inputs: Floats32) -> Floats:
    """Log-odds of slip (N,) that a graph to `margin` gives for inputs (N, *shape).

    One by one, as the daemon asks: dynamic ranges are those of a whole batch.
    """
    session = single_threaded(model.SerializeToString())
    name = model.graph.input[0].name
    margins = np.empty(len(inputs))
    for index in range(len(inputs)):
        given = {name: inputs[index : index + 1]}
        margins[index] = session.run([MARGIN_NAME], given)[0][0, 0]
    return margins


def _half(margin: onnx.ModelProto) -> onnx.ModelProto:
    model = copied(margin)
    casts = []
    for constant in list(model.graph.initializer):
        if constant.data_type != onnx.TensorProto.FLOAT or len(constant.dims) < 2:
            continue
        name = constant.name
        small = numpy_helper.from_array(
            numpy_helper.to_array(constant).astype(np.float16), name + "_half"
        )
        model.graph.initializer.remove(constant)
        model.graph.initializer.append(small)
        casts.append(
            helper.make_node("Cast", [small.name], [name], to=onnx.TensorProto.FLOAT, name=name)
        )
    set_nodes(model.graph, [*casts, *model.graph.node])
    return model


def _low_rank(margin: onnx.ModelProto, rank: int) -> onnx.ModelProto:
    model = copied(margin)
    constants = {constant.name: constant for constant in model.graph.initializer}
    dense = [node for node in model.graph.node if node.op_type == "Gemm"]
    if not dense:
        raise ValueError("the graph has no dense layer to factor")
    layer = max(dense, key=lambda node: int(np.prod(constants[node.input[1]].dims)))
    attributes = {a.name: helper.get_attribute_value(a) for a in layer.attribute}
    if attributes.get("transB", 0) != 1:
        raise ValueError("the dense layer is written in a way that is not known")
    weights = constants[layer.input[1]]
    # In float64: the rounding to float32 comes once, at the end.
    left, scale, right = np.linalg.svd(
        numpy_helper.to_array(weights).astype(np.float64), full_matrices=False
    )
    root = np.sqrt(scale[:rank])
    inner, outer = f"{weights.name}_inner", f"{weights.name}_outer"
    model.graph.initializer.remove(weights)
    model.graph.initializer.extend(
        [
            numpy_helper.from_array((root[:, np.newaxis] * right[:rank]).astype(np.float32), inner),
            numpy_helper.from_array((left[:, :rank] * root).astype(np.float32), outer),
        ]
    )
    place = list(model.graph.node).index(layer)
    first = helper.make_node("Gemm", [layer.input[0], inner], [inner + "_out"], transB=1)
    second = helper.make_node(
        "Gemm", [inner + "_out", outer, *layer.input[2:]], list(layer.output), transB=1
    )
    nodes = list(model.graph.node)
    set_nodes(model.graph, [*nodes[:place], first, second, *nodes[place + 1 :]])
    return model


def _integers(margin: onnx.ModelProto, inputs: Floats32, *, static: bool) -> onnx.ModelProto:
    with tempfile.TemporaryDirectory() as folder, quiet(None):
        path = Path(folder) / "small.onnx"
        if static:
            # Every so manieth grasp, so that the calibration sees all objects.
            some = inputs[:: max(len(inputs) // CALIBRATION_GRASPS, 1)]
            quantize_static(
                copied(margin),
                path,
                _Readings(margin.graph.input[0].name, some),
                # The margin itself must not saturate at what the calibration has seen.
                nodes_to_exclude=[margin.graph.node[-1].name],
                quant_format=QuantFormat.QDQ,
                per_channel=True,
                weight_type=QuantType.QInt8,
            )
        else:
            quantize_dynamic(copied(margin), path, per_channel=True, weight_type=QuantType.QInt8)
        return onnx.load(path)


class _Readings(CalibrationDataReader):  # type: ignore[misc]
    """Hands the inputs of a calibration over, one by one."""

    def __init__(self, name: str, inputs: Floats32) -> None:
        self._readings = iter([{name: inputs[i : i + 1]} for i in range(len(inputs))])

    def get_next(self) -> dict[str, Floats32] | None:
        return next(self._readings, None)
