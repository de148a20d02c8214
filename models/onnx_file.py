"""Check an ONNX file before onnxruntime reads it.

A file is refused if it needs other files, which its digest would not cover, or if it could run for
ever. Files are Protocol Buffers; the numbers of the fields are those of onnx.proto.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from graspd.models.contract import ModelError

FIELDS_MAX = 4_000_000
"""Most fields of a file; a forest of 34,000 nodes has 350,000."""
VARINT_BYTES_MAX = 10
"""Longest variable-length integer, bytes: 64 bits, seven in each byte."""

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
"""Wire types of fields; the other two, groups, are out of use."""

_OF_ONNX = """
    Abs Add And ArgMax ArgMin AveragePool BatchNormalization Cast CastLike Ceil Celu Clip Concat
    Constant ConstantOfShape Conv ConvInteger ConvTranspose Cos Cosh CumSum DepthToSpace
    DequantizeLinear Div Dropout DynamicQuantizeLinear Einsum Elu Equal Erf Exp Expand EyeLike
    Flatten Floor GRU Gather GatherElements GatherND Gelu Gemm GlobalAveragePool GlobalLpPool
    GlobalMaxPool Greater GreaterOrEqual GroupNormalization HardSigmoid HardSwish Hardmax Identity
    InstanceNormalization IsInf IsNaN LRN LSTM LayerNormalization LeakyRelu Less LessOrEqual Log
    LogSoftmax LpNormalization LpPool MatMul MatMulInteger Max MaxPool Mean
    MeanVarianceNormalization Min Mish Mod Mul Neg Not Or PRelu Pad Pow QLinearConv QLinearMatMul
    QuantizeLinear RMSNormalization RNN Range Reciprocal ReduceL1 ReduceL2 ReduceLogSum
    ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare Relu Reshape
    Resize Round ScatterElements ScatterND Selu Shape Shrink Sigmoid Sign Sin Sinh Size Slice
    Softmax Softplus Softsign SpaceToDepth Split Sqrt Squeeze Sub Sum Swish Tan Tanh ThresholdedRelu
    Tile TopK Transpose Trilu Unsqueeze Upsample Where Xor
    """
_OF_ML = """
    ArrayFeatureExtractor Binarizer Imputer LinearClassifier LinearRegressor Normalizer
    SVMClassifier SVMRegressor Scaler TreeEnsemble TreeEnsembleClassifier TreeEnsembleRegressor
    """
OPERATORS = {
    "": frozenset(_OF_ONNX.split()),
    "ai.onnx": frozenset(_OF_ONNX.split()),
    "ai.onnx.ml": frozenset(_OF_ML.split()),
}
"""Operators that a model may use, by domain; the first two domains are one.

They exclude loops, branches, chance, sequences and texts. They also exclude operators whose result
has a size that depends on its values.
"""
_SHAPED = """
    ConstantOfShape Expand Pad Range Reshape Resize Slice Split Squeeze Tile TopK Unsqueeze Upsample
    ReduceL1 ReduceL2 ReduceLogSum ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd
    ReduceSum ReduceSumSquare
    """
SHAPED = frozenset(_SHAPED.split())
"""Operators whose further inputs give the size of the result.

These inputs must be constants of the model, so that each run takes as long as the first.
"""
ALL_INPUTS = frozenset({"ConstantOfShape", "Range"})
"""Operators of `SHAPED` whose first input also gives the size."""


@dataclass(slots=True)
class _Node:
    operator: str = ""
    domain: str = ""
    inputs: list[str] = field(default_factory=list)
    outputs: list[str] = field(default_factory=list)


def check(content: bytes) -> None:
    """Raise `ModelError` unless a model is complete and each of its operators surely ends."""
    _Reader(memoryview(content)).check()


class _Reader:
    """Reader of one file."""

    def __init__(self, content: memoryview) -> None:
        self._content = content
        self._left = FIELDS_MAX
        self._nodes: list[_Node] = []
        self._fixed: set[str] = set()
        """Names of values that are constants of the model."""

    def check(self) -> None:
        # A message may come in several pieces, so each field with that number is checked.
        for field_number, value in self._fields(self._content):
            if field_number == 7:
                self._read_graph(value)
            elif field_number in (20, 25):
                raise ModelError("has functions or training steps of its own")
        for node in self._nodes:
            self._check_node(node)

    def _read_graph(self, graph: memoryview | int) -> None:
        for field_number, value in self._fields(graph):
            if field_number == 1:
                self._nodes.append(self._read_node(value))
            elif field_number == 5:
                self._fixed.add(self._read_tensor(value))
            elif field_number == 15:
                raise ModelError("has sparse weights")

    def _read_node(self, node: memoryview | int) -> _Node:
        result = _Node()
        for field_number, value in self._fields(node):
            if field_number == 1:
                result.inputs.append(_text(value))
            elif field_number == 2:
                result.outputs.append(_text(value))
            elif field_number == 4:
                result.operator = _text(value)
            elif field_number == 5:
                self._read_attribute(value)
            elif field_number == 7:
                result.domain = _text(value)
        return result

    def _read_attribute(self, attribute: memoryview | int) -> None:
        for field_number, value in self._fields(attribute):
            if field_number in (5, 10):
                self._read_tensor(value)
            elif field_number in (6, 11):
                raise ModelError("has a loop or branch: a graph within its graph")
            elif field_number in (22, 23):
                raise ModelError("has sparse weights")

    def _read_tensor(self, tensor: memoryview | int) -> str:
        """Check a tensor; return its name."""
        name = ""
        for field_number, value in self._fields(tensor):
            if field_number == 8:
                name = _text(value)
            elif field_number == 13 or (field_number == 14 and value != 0):
                raise ModelError("has weights in another file: its digest would not be theirs")
        return name

    def _check_node(self, node: _Node) -> None:
        operator, fixed = node.operator, [not name or name in self._fixed for name in node.inputs]
        if node.domain not in OPERATORS:
            raise ModelError(f"has an operator {operator!r} of another domain, {node.domain!r}")
        if operator not in OPERATORS[node.domain]:
            raise ModelError(f"has an operator that no model may use: {operator!r}")
        if operator in SHAPED and not all(fixed if operator in ALL_INPUTS else fixed[1:]):
            raise ModelError(f"has a {operator} whose size depends on the counts")
        if operator in ("Shape", "Size") or all(fixed):
            self._fixed.update(node.outputs)

    def _fields(self, message: memoryview | int) -> Iterator[tuple[int, memoryview | int]]:
        """Yield number and value of each field: an integer, or bytes.

        Raises `ModelError` if the bytes are no message.
        """
        if isinstance(message, int):
            raise _broken("a number for a message")
        at, end = 0, len(message)
        while at < end:
            self._left -= 1
            if self._left < 0:
                raise ModelError(f"has more than {FIELDS_MAX} fields")
            tag, at = _varint(message, at)
            field_number, kind = tag >> 3, tag & 7
            if not 0 < field_number < 1 << 29:
                raise _broken(f"a field of number {field_number}")
            if kind == VARINT:
                value, at = _varint(message, at)
                yield field_number, value
                continue
            if kind == BYTES:
                size, at = _varint(message, at)
            elif kind in (FIXED32, FIXED64):
                size = 4 if kind == FIXED32 else 8
            else:
                raise _broken(f"a field of kind {kind}")
            if size > end - at:
                raise _broken("cut off")
            yield field_number, message[at : at + size]
            at += size


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """Return the variable-length integer at `at`, and the place after it."""
    value = 0
    for place in range(VARINT_BYTES_MAX):
        if at + place >= len(message):
            raise _broken("cut off")
        byte = message[at + place]
        value |= (byte & 0x7F) << 7 * place
        if byte < 0x80:
            return value, at + place + 1
    raise _broken("a number without an end")


def _text(value: memoryview | int) -> str:
    if isinstance(value, int):
        raise _broken("a number for a text")
    return bytes(value).decode(errors="backslashreplace")


def _broken(how: str) -> ModelError:
    return ModelError(f"not a usable ONNX model: {how}")
