"""Check an ONNX file before onnxruntime reads it.

A file is refused if it needs other files, which its digest would not cover, or if it could run for
ever. Files are Protocol Buffers; the numbers of the fields are those of onnx.proto.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from graspd.models.contract import ModelError

FIELDS_MAX = 4_000_000
"""Most fields of a file; a forest of 34,000 nodes has 350,000."""
VARINT_BYTES_MAX = 10
"""Longest variable-length integer, bytes: 64 bits, seven in each byte."""

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
"""Wire types of fields; the other two, groups, are out of use."""

_OF_ONNX = """
    Add AveragePool BatchNormalization Cast Clip Concat Constant Conv Div Elu Erf Exp Flatten Gather
    Gelu Gemm GlobalAveragePool Identity LayerNormalization LeakyRelu Log LogSoftmax MatMul MaxPool
    Mul Neg Pow ReduceMean ReduceSumSquare Relu Reshape Sigmoid Slice Softmax Sqrt Squeeze Sub Sum
    Tanh Transpose Unsqueeze
    """
TREES = frozenset({"TreeEnsembleClassifier", "TreeEnsembleRegressor"})
OPERATORS = {
    "": frozenset(_OF_ONNX.split()),
    "ai.onnx": frozenset(_OF_ONNX.split()),
    "ai.onnx.ml": TREES,
}
"""Operators that a model may use, by domain; the first two domains are one.

They are those of `graspd train` and of plain networks made elsewhere. Each ends, whatever the
counts, and the size of its result does not depend on values. For `SHAPED` and `TREES` this is
checked.
"""
SHAPED = frozenset({"ReduceMean", "ReduceSumSquare", "Reshape", "Slice", "Squeeze", "Unsqueeze"})
"""Operators whose inputs after the first give the size of the result. These inputs must be
constants of the model, so that each run takes as long as the first."""
ELEMENTWISE = frozenset({"Mul", "Sub"})
"""Operators whose result is as wide as their widest input. Trees may read their results."""
TEXTS = {"LEAF": 0, "BRANCH_LEQ": 1}
"""Numbers that stand for an attribute's texts, kinds of a tree's nodes; 2: any other text."""
LEAF, BRANCH = TEXTS.values()
VALUES = frozenset(range(2, 12))
"""Field numbers of an attribute's values, one for each type of value."""
NODE_LISTS = ("treeids", "nodeids", "modes", "featureids", "truenodeids", "falsenodeids")


@dataclass(slots=True)
class _Node:
    operator: str = ""
    domain: str = ""
    inputs: list[str] = field(default_factory=list)
    outputs: list[str] = field(default_factory=list)
    attributes: dict[str, list[int]] = field(default_factory=dict)
    """Values by name: integers, numbers of `TEXTS`, and 0 for each float."""


def check(content: bytes) -> None:
    """Raise `ModelError` unless a model is self-contained and its operators surely end."""
    _Reader(memoryview(content)).check()


class _Reader:
    """Reader of one file."""

    def __init__(self, content: memoryview) -> None:
        self._content = content
        self._left = FIELDS_MAX
        self._nodes: list[_Node] = []
        self._fixed: set[str] = set()
        """Names of values that are constants of the model."""
        self._widths: dict[str, int] = {}
        """Last dimension of the model's inputs, by name."""

    def check(self) -> None:
        # A message may be split into several fields of one number, so each of them is checked.
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
            elif field_number == 11:
                names, sizes = self._at(value, 1), self._at(value, 2, 1, 2, 1, 1)
                if names and sizes and isinstance(sizes[-1], int):
                    self._widths[_text(names[-1])] = sizes[-1]
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
                name, values = self._read_attribute(value)
                if name in result.attributes:
                    raise _broken(f"{name} twice")
                result.attributes[name] = values
            elif field_number == 7:
                result.domain = _text(value)
        return result

    def _read_attribute(self, attribute: memoryview | int) -> tuple[str, list[int]]:
        name, values, kinds = "", list[int](), set[int]()
        for field_number, value in self._fields(attribute):
            kinds |= {field_number} & VALUES
            if field_number == 1:
                name = _text(value)
            elif field_number in (3, 8):
                values += [value] if isinstance(value, int) else []  # no exporter packs values
            elif field_number in (5, 10):
                self._read_tensor(value)
            elif field_number in (6, 11):
                raise ModelError("has a loop or branch: a graph within its graph")
            elif field_number == 7 and not isinstance(value, int):
                values += bytes(len(value) // 4)
            elif field_number == 9:
                values.append(TEXTS.get(_text(value), len(TEXTS)))
            elif field_number in (22, 23):
                raise ModelError("has sparse weights")
        if len(kinds) > 1:
            raise _broken(f"{name} of two kinds")
        return name, values

    def _read_tensor(self, tensor: memoryview | int) -> str:
        """Return a tensor's name. Raises `ModelError` if its weights are in another file."""
        name = ""
        for field_number, value in self._fields(tensor):
            if field_number == 8:
                name = _text(value)
            elif field_number == 13 or (field_number == 14 and value != 0):
                raise ModelError(
                    "has weights in another file, which its digest leaves out: export it with "
                    "external_data=False"
                )
        return name

    def _check_node(self, node: _Node) -> None:
        operator, fixed = node.operator, [not name or name in self._fixed for name in node.inputs]
        if node.domain not in OPERATORS:
            raise ModelError(f"has an operator {operator!r} of another domain, {node.domain!r}")
        if operator not in OPERATORS[node.domain]:
            raise ModelError(f"has an operator that no model may use: {operator!r}")
        if operator in SHAPED and not all(fixed[1:]):
            raise ModelError(f"has a {operator} whose size depends on the counts")
        if operator in TREES:
            width = self._widths.get(node.inputs[0], 0) if node.inputs else 0
            _check_trees(defaultdict(list, node.attributes), width)
        if operator in ELEMENTWISE and node.outputs:
            width = max((self._widths.get(name, 0) for name in node.inputs), default=0)
            self._widths[node.outputs[0]] = width
        if all(fixed):
            self._fixed.update(node.outputs)

    def _at(self, message: memoryview | int, *path: int) -> list[Any]:
        """Return the values of the fields at `path`, field numbers from the message inwards."""
        found = [value for number, value in self._fields(message) if number == path[0]]
        if len(path) == 1:
            return found
        return [value for inner in found for value in self._at(inner, *path[1:])]

    def _fields(self, message: memoryview | int) -> Iterator[tuple[int, memoryview | int]]:
        """Yield number and value of each field: an integer, or bytes.

        Raises `ModelError` if the bytes are not a message.
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


def _check_trees(lists: Mapping[str, list[int]], width: int) -> None:
    """Raise `ModelError` unless each node is reached once, from the first of its tree, and each
    result is one of a leaf.

    `lists`: attributes of the operator. `width`: number of values that the trees read.
    """
    kind = "target" if lists["target_ids"] else "class"
    for prefix, names in (("nodes", NODE_LISTS), (kind, ("treeids", "nodeids", "ids"))):
        lengths = {len(lists[f"{prefix}_{name}"]) for name in names}
        lengths |= {len(each) for name, each in lists.items() if name.startswith(f"{prefix}_")}
        if len(lengths) != 1:
            raise ModelError(f"has trees whose lists {prefix}_* differ in length")
    trees, ids, modes = (lists[f"nodes_{name}"] for name in NODE_LISTS[:3])
    places = {each: place for place, each in enumerate(zip(trees, ids, strict=True))}
    roots = [place for place, tree in enumerate(trees) if not place or trees[place - 1] != tree]
    if len(places) != len(trees) or len(roots) != len(set(trees)):
        raise ModelError("has trees that list a node twice")
    if len(_reached(lists, places, roots, range(width))) != len(trees):
        raise ModelError("has a tree with nodes that its root does not reach")
    numbers = range(len(lists["classlabels_int64s"]) or (lists["n_targets"] or [1])[-1])
    leaves = zip(lists[f"{kind}_treeids"], lists[f"{kind}_nodeids"], strict=True)
    kinds = {modes[places[leaf]] if leaf in places else BRANCH for leaf in leaves}
    if kinds - {LEAF} or any(each not in numbers for each in lists[f"{kind}_ids"]):
        raise ModelError("has trees with a result that is not one of a leaf")


def _reached(
    lists: Mapping[str, list[int]],
    places: Mapping[tuple[int, int], int],
    roots: list[int],
    width: range,
) -> set[int]:
    """Return the indices of the nodes that are reached from the roots; empties `roots`.

    `places`: index of a node by tree and number. `width`: indices of the inputs. Raises
    `ModelError` if a node is reached twice, is missing, or compares no input."""
    trees, _, modes, features, *children = (lists[f"nodes_{name}"] for name in NODE_LISTS)
    reached = set[int]()
    while roots:
        place = roots.pop()
        if place in reached:
            raise ModelError("has a tree with a cycle: a node is reached twice")
        reached.add(place)
        if modes[place] == LEAF:
            continue
        if modes[place] != BRANCH or features[place] not in width:
            raise ModelError("has a tree with a node that does not compare an input")
        for child in children:
            if (trees[place], child[place]) not in places:
                raise ModelError("has a tree that leads to a node which it lacks")
            roots.append(places[trees[place], child[place]])
    return reached


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """Return the variable-length integer at `at`, and the place after it. Raises `ModelError`."""
    value = 0
    for place in range(VARINT_BYTES_MAX):
        if at + place >= len(message):
            raise _broken("cut off")
        byte = message[at + place]
        value |= (byte & 0x7F) << 7 * place
        if byte < 0x80:
            if value >> 64:
                break  # other readers would cut it to 64 bits
            return value, at + place + 1
    raise _broken("a number without an end")


def _text(value: memoryview | int) -> str:
    if isinstance(value, int):
        raise _broken("a number for a text")
    return bytes(value).decode(errors="backslashreplace")


def _broken(how: str) -> ModelError:
    return ModelError(f"not a usable ONNX model: {how}")
