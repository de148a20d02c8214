"""The network of an ONNX file in float64: what it would answer if nothing were rounded.

An evaluator of its own, in numpy, of the operators that the zoo uses; it shares nothing with
onnxruntime but the file. Operators: https://onnx.ai/onnx/operators/.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from daemon.measure.reference.trees import Trees, UnknownOperatorError
from models.contract import OUTPUT_NAME

__all__ = ["Reference", "UnknownOperatorError"]

Array = NDArray[Any]
Attributes = Mapping[str, Any]

CHUNK = 128
"""Readings at a time: the products of a convolution of so many take 30 MB."""
FLOATS = (
    onnx.TensorProto.FLOAT,
    onnx.TensorProto.FLOAT16,
    onnx.TensorProto.BFLOAT16,
    onnx.TensorProto.DOUBLE,
)
STEPPED = frozenset(
    {
        "TreeEnsembleClassifier",
        "TreeEnsembleRegressor",
        "QuantizeLinear",
        "DynamicQuantizeLinear",
    }
)
"""Operators that jump: the least change of an input may change the answer by a whole step."""
QUANTISED = frozenset({"QuantizeLinear", "DynamicQuantizeLinear", "MatMulInteger", "ConvInteger"})


class Reference:
    """One model file, evaluated in float64: constants are widened, casts to less are left out."""

    def __init__(self, path: Path) -> None:
        """Raises `UnknownOperatorError` if the file holds an operator that is not known here."""
        model = onnx.load(path)
        graph = model.graph
        self.operators = frozenset(node.op_type for node in graph.node)
        """Names of the operators in the file."""
        self._given = graph.input[0].name
        self._constants = {
            tensor.name: _widened(numpy_helper.to_array(tensor)) for tensor in graph.initializer
        }
        self._steps = [_step(node) for node in graph.node]
        # A range that is taken per run is that of one reading in the daemon.
        self._chunk = 1 if "DynamicQuantizeLinear" in self.operators else CHUNK

    @property
    def is_stepped(self) -> bool:
        """Whether the answer jumps, so that only the same input can give the same answer."""
        return bool(self.operators & STEPPED)

    @property
    def is_quantised(self) -> bool:
        """Whether anything is computed in integers."""
        return bool(self.operators & QUANTISED)

    def probabilities(self, inputs: Array) -> NDArray[np.float64]:
        """Probabilities (N, 2), stable and slip, of inputs (N, *shape) of any float type."""
        wide = inputs.astype(np.float64)
        parts = [self._run(wide[at : at + self._chunk]) for at in range(0, len(wide), self._chunk)]
        return np.concatenate([np.empty((0, 2)), *parts])

    def _run(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        values: dict[str, Array | None] = {"": None, **self._constants, self._given: inputs}
        for operator, names, outputs, attributes in self._steps:
            results = operator([values[name] for name in names], attributes)
            several = results if isinstance(results, tuple) else (results,)
            values.update(zip(outputs, several, strict=False))
        answer = values[OUTPUT_NAME]
        if answer is None:
            raise UnknownOperatorError(f"the graph has no output '{OUTPUT_NAME}'")
        return answer.astype(np.float64)


Operator = Callable[[list[Any], Attributes], Array | tuple[Array, ...]]


def _step(node: onnx.NodeProto) -> tuple[Operator, list[str], list[str], Attributes]:
    attributes = {part.name: helper.get_attribute_value(part) for part in node.attribute}
    if node.op_type.startswith("TreeEnsemble"):
        operator: Operator | None = Trees(node.op_type, attributes)
    else:
        operator = OPERATORS.get(node.op_type)
    if operator is None:
        raise UnknownOperatorError(f"no float64 reference of the operator {node.op_type}")
    return operator, list(node.input), list(node.output), attributes


def _widened(values: Array) -> Array:
    if values.dtype.kind != "f" and values.dtype.name != "bfloat16":
        return values
    return values.astype(np.float64)


def _cast(given: list[Any], attributes: Attributes) -> Array:
    kind = attributes["to"]
    wanted = np.float64 if kind in FLOATS else helper.tensor_dtype_to_np_dtype(kind)
    cast: Array = given[0].astype(wanted)
    return cast


def _constant(given: list[Any], attributes: Attributes) -> Array:
    return _widened(numpy_helper.to_array(attributes["value"]))


def _gemm(given: list[Any], attributes: Attributes) -> Array:
    left, right, *rest = given
    left = left.T if attributes.get("transA") else left
    right = right.T if attributes.get("transB") else right
    product: Array = attributes.get("alpha", 1.0) * (left @ right)
    if rest and rest[0] is not None:
        product = product + attributes.get("beta", 1.0) * rest[0]
    return product


def _windows(images: Array, kernel: Sequence[int], attributes: Attributes, padding: float) -> Array:
    """Windows (N, channels, height, width, *kernel) of images (N, channels, h, w)."""
    if attributes.get("auto_pad", b"NOTSET") not in (b"NOTSET", b"VALID"):
        raise UnknownOperatorError("no float64 reference of automatic padding")
    if set(attributes.get("dilations", (1, 1))) != {1} or attributes.get("ceil_mode"):
        raise UnknownOperatorError("no float64 reference of dilated or rounded-up windows")
    top, left, bottom, right = attributes.get("pads", (0, 0, 0, 0))
    edges = ((0, 0), (0, 0), (top, bottom), (left, right))
    padded = np.pad(images, edges, constant_values=padding)
    down, across = attributes.get("strides", (1, 1))
    windows: Array = sliding_window_view(padded, tuple(kernel), axis=(2, 3))
    return windows[:, :, ::down, ::across]


def _conv(given: list[Any], attributes: Attributes) -> Array:
    images, weights, *bias = given
    if attributes.get("group", 1) != 1:
        raise UnknownOperatorError("no float64 reference of grouped convolutions")
    windows = _windows(images, weights.shape[2:], attributes, 0)
    sums: Array = np.tensordot(windows, weights, axes=((1, 4, 5), (1, 2, 3)))
    if bias and bias[0] is not None:
        sums = sums + bias[0]
    return sums.transpose(0, 3, 1, 2)


def _max_pool(given: list[Any], attributes: Attributes) -> Array:
    windows = _windows(given[0], attributes["kernel_shape"], attributes, -math.inf)
    largest: Array = windows.max(axis=(4, 5))
    return largest


def _softmax(given: list[Any], attributes: Attributes) -> Array:
    axis = attributes.get("axis", -1)
    powers = np.exp(given[0] - given[0].max(axis=axis, keepdims=True))
    shares: Array = powers / powers.sum(axis=axis, keepdims=True)
    return shares


def _sigmoid(given: list[Any], attributes: Attributes) -> Array:
    half: Array = 0.5 + 0.5 * np.tanh(0.5 * given[0])
    return half


def _reshape(given: list[Any], attributes: Attributes) -> Array:
    values, shape = given
    if not attributes.get("allowzero"):
        shape = [values.shape[at] if side == 0 else side for at, side in enumerate(shape)]
    reshaped: Array = values.reshape(tuple(int(side) for side in shape))
    return reshaped


def _flatten(given: list[Any], attributes: Attributes) -> Array:
    values = given[0]
    rows = math.prod(values.shape[: attributes.get("axis", 1)])
    flat: Array = values.reshape(rows, -1)
    return flat


def _slice(given: list[Any], attributes: Attributes) -> Array:
    values, starts, ends = given[:3]
    axes = range(len(starts)) if len(given) < 4 or given[3] is None else given[3]
    steps = [1] * len(starts) if len(given) < 5 or given[4] is None else given[4]
    places = [slice(None)] * values.ndim
    for axis, start, end, step in zip(axes, starts, ends, steps, strict=True):
        places[int(axis)] = slice(int(start), int(end), int(step))
    part: Array = values[tuple(places)]
    return part


def _clip(given: list[Any], attributes: Attributes) -> Array:
    low, high = (*given[1:], None, None)[:2]
    if low is None and high is None:
        raise UnknownOperatorError("no float64 reference of a clip without limits")
    clipped: Array = np.clip(given[0], low, high)
    return clipped


def _reduced(reduce: Callable[..., Array]) -> Operator:
    def operator(given: list[Any], attributes: Attributes) -> Array:
        axes = None if len(given) < 2 or given[1] is None else tuple(int(axis) for axis in given[1])
        return reduce(given[0], axis=axes, keepdims=bool(attributes.get("keepdims", 1)))

    return operator


def _sum_of_squares(values: Array, **more: Any) -> Array:  # noqa: ANN401 - what numpy.sum takes
    total: Array = np.square(values).sum(**more)
    return total


def _per_axis(values: Array, like: Array, axis: int) -> Array:
    """Scales or zero points (channels,) so that they go with the channels of `like`."""
    if values.ndim == 0 or values.size == 1:
        return values.reshape(())
    shape = [1] * like.ndim
    shape[axis] = values.size
    return values.reshape(shape)


def _quantize(given: list[Any], attributes: Attributes) -> Array:
    values, scale, zero = given
    axis = attributes.get("axis", 1)
    limits = np.iinfo(zero.dtype)
    levels = np.rint(values / _per_axis(scale, values, axis)) + _per_axis(zero, values, axis)
    quantised: Array = np.clip(levels, limits.min, limits.max).astype(zero.dtype)
    return quantised


def _dequantize(given: list[Any], attributes: Attributes) -> Array:
    values, scale, *zero = given
    axis = attributes.get("axis", 1)
    wide: Array = values.astype(np.float64)
    if zero and zero[0] is not None:
        wide = wide - _per_axis(zero[0], values, axis)
    return wide * _per_axis(scale, values, axis)


def _dynamic_quantize(given: list[Any], attributes: Attributes) -> tuple[Array, Array, Array]:
    values = given[0]
    low, high = min(float(values.min()), 0.0), max(float(values.max()), 0.0)
    scale = np.array((high - low) / 255.0 if high > low else 1.0)
    zero = np.clip(np.rint(-low / scale), 0, 255).astype(np.uint8)
    return _quantize([values, scale, zero], {}), scale, zero


def _integers(given: list[Any]) -> tuple[Array, Array]:
    """Both factors less their zero points, as float64, in which such sums are exact."""
    left, right, *zeros = given
    left_zero, right_zero = (*zeros, None, None)[:2]
    wide = left.astype(np.float64) - (0 if left_zero is None else left_zero.astype(np.float64))
    weights = right.astype(np.float64)
    if right_zero is not None:
        axis = 0 if right.ndim > 2 else right.ndim - 1
        weights = weights - _per_axis(right_zero.astype(np.float64), right, axis)
    return wide, weights


def _matmul_integer(given: list[Any], attributes: Attributes) -> Array:
    left, right = _integers(given)
    product: Array = left @ right
    return product


def _conv_integer(given: list[Any], attributes: Attributes) -> Array:
    return _conv(list(_integers(given)), attributes)


OPERATORS: dict[str, Operator] = {
    "Add": lambda given, _: given[0] + given[1],
    "Cast": _cast,
    "Clip": _clip,
    "Concat": lambda given, how: np.concatenate(given, axis=how["axis"]),
    "Constant": _constant,
    "Conv": _conv,
    "ConvInteger": _conv_integer,
    "DequantizeLinear": _dequantize,
    "Div": lambda given, _: given[0] / given[1],
    "DynamicQuantizeLinear": _dynamic_quantize,
    "Exp": lambda given, _: np.exp(given[0]),
    "Flatten": _flatten,
    "Gather": lambda given, how: np.take(given[0], given[1], axis=how.get("axis", 0)),
    "Gemm": _gemm,
    "Identity": lambda given, _: given[0],
    "Log": lambda given, _: np.log(given[0]),
    "MatMul": lambda given, _: given[0] @ given[1],
    "MatMulInteger": _matmul_integer,
    "MaxPool": _max_pool,
    "Mul": lambda given, _: given[0] * given[1],
    "Neg": lambda given, _: -given[0],
    "QuantizeLinear": _quantize,
    "ReduceSum": _reduced(np.sum),
    "ReduceSumSquare": _reduced(_sum_of_squares),
    "Relu": lambda given, _: np.maximum(given[0], 0),
    "Reshape": _reshape,
    "Sigmoid": _sigmoid,
    "Slice": _slice,
    "Softmax": _softmax,
    "Sub": lambda given, _: given[0] - given[1],
    "Sum": lambda given, _: functools.reduce(np.add, given),
    "Tanh": lambda given, _: np.tanh(given[0]),
    "Transpose": lambda given, how: np.transpose(given[0], how.get("perm")),
}
