"""What an ONNX file computes with is read as `onnx` reads it, and nothing gets by."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from graspd.models import onnx_file, zoo
from graspd.models.contract import ModelError

onnx = pytest.importorskip("onnx", reason="needs the extra `train`")
DecodeError = pytest.importorskip("google.protobuf.message").DecodeError
text_format = pytest.importorskip("google.protobuf.text_format")
DAMAGED = 20_000
SEED = 7


def small() -> Any:  # noqa: ANN401 - onnx has no types
    """A model of some kinds of nodes, small enough that damage hits what matters."""
    helper = onnx.helper
    nodes = [
        helper.make_node("Shape", ["x"], ["shape"]),
        helper.make_node("Reshape", ["x", "shape"], ["y"]),
        helper.make_node("Gemm", ["y", "w"], ["z"], alpha=1.0),
        helper.make_node(
            "Constant", [], ["c"], value=onnx.numpy_helper.from_array(np.ones(2), "v")
        ),
        helper.make_node("Scaler", ["z"], ["s"], domain="ai.onnx.ml", offset=[0.0], scale=[1.0]),
        helper.make_node("Softmax", ["s"], ["probability"], axis=1),
    ]
    weights = onnx.numpy_helper.from_array(np.ones((3, 2), np.float32), "w")
    graph = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, ["N", 3])],
        [helper.make_tensor_value_info("probability", onnx.TensorProto.FLOAT, ["N", 2])],
        [weights],
    )
    imports = [helper.make_opsetid("", 18), helper.make_opsetid("ai.onnx.ml", 3)]
    return helper.make_model(graph, opset_imports=imports)


def tensors(graph: Any) -> Iterator[Any]:  # noqa: ANN401
    yield from graph.initializer
    for node in graph.node:
        for attribute in node.attribute:
            yield attribute.t
            yield from attribute.tensors


def is_sound(model: Any) -> bool:  # noqa: ANN401
    """What must hold of a model that is not refused, by another reader."""
    graph = model.graph
    inner = [
        attribute
        for node in graph.node
        for attribute in node.attribute
        if attribute.HasField("g")
        or attribute.graphs
        or attribute.HasField("sparse_tensor")
        or attribute.sparse_tensors
    ]
    return (
        all(node.op_type in onnx_file.OPERATORS.get(node.domain, ()) for node in graph.node)
        and not any(each.external_data or each.data_location for each in tensors(graph))
        and not (inner or graph.sparse_initializer or model.functions or model.training_info)
    )


@pytest.mark.parametrize("name", zoo.names())
def test_the_zoo_may_be_used(name: str) -> None:
    content = zoo.find(name).read_bytes()
    onnx_file.check(content)
    assert is_sound(onnx.load_model_from_string(content))


def test_a_small_model_may_be_used() -> None:
    onnx_file.check(small().SerializeToString())


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ("initializer { external_data { key: 'location' } }", "weights in another file"),
        ("initializer { data_location: EXTERNAL }", "weights in another file"),
        ("node { attribute { t { data_location: EXTERNAL } } }", "weights in another file"),
        ("node { attribute { tensors { data_location: EXTERNAL } } }", "weights in another file"),
        ("node { op_type: 'Loop' }", "no model may use: 'Loop'"),
        ("node { op_type: 'RandomNormalLike' }", "no model may use: 'RandomNormalLike'"),
        ("node { op_type: 'Scaler' }", "no model may use: 'Scaler'"),
        ("node { op_type: 'Gemm' domain: 'com.example' }", "another domain, 'com.example'"),
        ("node { attribute { g { name: 'inner' } } }", "a graph within its graph"),
        ("node { attribute { graphs { name: 'inner' } } }", "a graph within its graph"),
        ("sparse_initializer { values { name: 'w' } }", "sparse weights"),
        ("node { attribute { sparse_tensor { values { name: 'w' } } } }", "sparse weights"),
        ("node { attribute { sparse_tensors { values { name: 'w' } } } }", "sparse weights"),
        ("} functions { name: 'Gemm'", "functions or training"),
        ("} training_info { algorithm { name: 'a' }", "functions or training"),
        ("node { op_type: 'Reshape' input: 'x' input: 'z' }", "size depends on the counts"),
    ],
)
def test_what_may_not_be_is_named(more: str, says: str) -> None:
    model = small()
    text_format.Merge(f"graph {{ {more} }}", model)
    with pytest.raises(ModelError, match=says):
        onnx_file.check(model.SerializeToString())


def test_a_second_piece_of_the_graph_is_looked_at_too() -> None:
    """Readers of this format put the pieces of a message together."""
    model, more = small(), onnx.ModelProto()
    more.graph.node.add().op_type = "Scan"
    content = model.SerializeToString() + more.SerializeToString()
    assert len(onnx.load_model_from_string(content).graph.node) == 7
    with pytest.raises(ModelError, match="'Scan'"):
        onnx_file.check(content)


def test_a_location_of_more_bits_than_there_are_is_one() -> None:
    """The readers of others keep the lowest 32 bits."""
    location = bytes([14 << 3]) + b"\x81\x80\x80\x80\x10"  # 2**32 + 1
    tensor = b"\x42\x01w" + location
    graph = b"\x2a" + bytes([len(tensor)]) + tensor
    with pytest.raises(ModelError, match="in another file"):
        onnx_file.check(b"\x3a" + bytes([len(graph)]) + graph)


@pytest.mark.parametrize(
    "content",
    [b"\x3a\x05\x0a", b"\x3a", b"\x3b", b"\x00\x00", b"\xff" * 20, b"\x38\xff", b"\x3d\x01"],
)
def test_what_is_no_message_is_said(content: bytes) -> None:
    with pytest.raises(ModelError, match="not a usable ONNX model"):
        onnx_file.check(content)


def test_damage_raises_nothing_else_and_gets_nothing_by() -> None:
    whole = small().SerializeToString()
    seeds = random.Random(SEED)
    passed = 0
    for number in range(DAMAGED):
        damaged = bytearray(whole)
        for _ in range(seeds.randint(1, 3)):
            at = seeds.randrange(len(damaged))
            match seeds.randrange(4):
                case 0:
                    damaged[at] = seeds.randrange(256)
                case 1:
                    damaged[at] ^= 1 << seeds.randrange(8)
                case 2:
                    del damaged[at : at + seeds.randint(1, 8)]
                case 3:
                    start = seeds.randrange(len(whole))
                    damaged[at:at] = whole[start : start + seeds.randint(1, 40)]
        try:
            onnx_file.check(bytes(damaged))
        except ModelError:
            continue
        try:
            model = onnx.load_model_from_string(bytes(damaged))
        except DecodeError:
            continue
        passed += 1
        assert is_sound(model), f"round {number} of seed {SEED}"
    assert passed > DAMAGED // 20


def test_nothing_is_read_after_too_many_fields(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnx_file, "FIELDS_MAX", 1000)
    damage = b"\x0f"  # a field of a kind that there is not
    with pytest.raises(ModelError, match="more than 1000 fields"):
        onnx_file.check(b"\x08\x01" * 1000 + damage)
    with pytest.raises(ModelError, match="a field of kind 7"):
        onnx_file.check(b"\x08\x01" * 999 + damage)
