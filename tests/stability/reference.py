"""The network of an ONNX file in float64: what it would answer if nothing were rounded.

It is evaluated by onnx's own reference implementation, which shares nothing with onnxruntime but
the file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper
from onnx.reference import ReferenceEvaluator

from graspd.models.contract import OUTPUT_NAME

CHUNK = 128
"""Readings at a time: the products of a convolution of these take 30 MB."""
NARROW = (onnx.TensorProto.FLOAT, onnx.TensorProto.FLOAT16, onnx.TensorProto.BFLOAT16)
STEPPED = frozenset({"TreeEnsembleClassifier", "TreeEnsembleRegressor"})
"""Operators that jump: the least change of an input may change the answer by a whole step."""


class Reference:
    """One model file, evaluated in float64: constants are widened, casts to less are left out."""

    def __init__(self, path: Path) -> None:
        model = onnx.load(path)
        operators = frozenset(node.op_type for node in model.graph.node)
        self.is_stepped = bool(operators & STEPPED)
        """True if the answer jumps, so that only the same input can give the same answer."""
        self._input_name = model.graph.input[0].name
        _widen(model)
        self._evaluator = ReferenceEvaluator(model)

    def probabilities(self, inputs: NDArray[np.floating]) -> NDArray[np.float64]:
        """Probabilities (N, 2), stable and slip, of inputs (N, *shape) of any float type."""
        wide = inputs.astype(np.float64)
        starts = range(0, len(wide), CHUNK)
        parts = [self._run(wide[start : start + CHUNK]) for start in starts]
        return np.concatenate([np.empty((0, 2)), *parts])

    def _run(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        (answer,) = self._evaluator.run([OUTPUT_NAME], {self._input_name: inputs})
        return np.asarray(answer, dtype=np.float64)


def _widen(model: onnx.ModelProto) -> None:
    """Turn all that is a narrower float into float64, in place."""
    tensors = list(model.graph.initializer)
    for node in model.graph.node:
        for attribute in node.attribute:
            if attribute.HasField("t"):
                tensors.append(attribute.t)
            elif node.op_type == "Cast" and attribute.i in NARROW:
                attribute.i = onnx.TensorProto.DOUBLE
    for tensor in tensors:
        if tensor.data_type in NARROW:
            values = numpy_helper.to_array(tensor).astype(np.float64)
            tensor.CopyFrom(numpy_helper.from_array(values, tensor.name))
