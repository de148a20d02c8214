"""ONNX files with forbidden or endless parts are refused; compared with the package `onnx`."""

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
DAMAGED = 10_000
SEED = 7


def small() -> Any:  # noqa: ANN401 - onnx has no types
    """Return a small model of several kinds of nodes, so that random damage often matters."""
    helper = onnx.helper
    nodes = [
        helper.make_node("Reshape", ["x", "shape"], ["y"]),
        helper.make_node("Gemm", ["y", "w"], ["z"], alpha=1.0),
        trees(),
        helper.make_node("Sum", ["z", "margin"], ["s"]),
        helper.make_node("Softmax", ["s"], ["probability"], axis=1),
    ]
    weights = onnx.numpy_helper.from_array(np.ones((3, 2), np.float32), "w")
    shape = onnx.numpy_helper.from_array(np.array([-1, 3]), "shape")
    graph = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, ["N", 3])],
        [helper.make_tensor_value_info("probability", onnx.TensorProto.FLOAT, ["N", 2])],
        [weights, shape],
    )
    imports = [helper.make_opsetid("", 18), helper.make_opsetid("ai.onnx.ml", 3)]
    return helper.make_model(graph, opset_imports=imports)


TREES: dict[str, list[Any]] = {
    "nodes_treeids": [0, 0, 0, 0, 0, 1, 1, 1],
    "nodes_nodeids": [0, 1, 2, 3, 4, 0, 1, 2],
    "nodes_modes": [*["BRANCH_LEQ", "LEAF"] * 2, "LEAF", "BRANCH_LEQ", "LEAF", "LEAF"],
    "nodes_featureids": [0, 0, 2, 0, 0, 1, 0, 0],
    "nodes_values": [1.0, 0.0, 2.0, 0.0, 0.0, 1.0, 0.0, 0.0],
    "nodes_truenodeids": [1, 0, 3, 0, 0, 1, 0, 0],
    "nodes_falsenodeids": [2, 0, 4, 0, 0, 2, 0, 0],
    "target_treeids": [0, 0, 0, 1, 1],
    "target_nodeids": [1, 3, 4, 1, 2],
    "target_ids": [0, 0, 0, 0, 0],
    "target_weights": [1.0, 2.0, 3.0, 4.0, 5.0],
}
"""Attributes of two trees: tree 0 has two branches, tree 1 has one."""


def trees(**changed: list[Any]) -> Any:  # noqa: ANN401
    return onnx.helper.make_node(
        "TreeEnsembleRegressor",
        ["x"],
        ["margin"],
        domain="ai.onnx.ml",
        n_targets=1,
        **(TREES | changed),
    )


def tensors(graph: Any) -> Iterator[Any]:  # noqa: ANN401
    yield from graph.initializer
    for node in graph.node:
        for attribute in node.attribute:
            yield attribute.t
            yield from attribute.tensors


def is_sound(model: Any) -> bool:  # noqa: ANN401
    """True if a model, as read by `onnx`, has no part for which it must be refused."""
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


def test_models_of_the_zoo_and_a_small_one_are_accepted() -> None:
    for name in zoo.names():
        onnx_file.check(zoo.find(name).read_bytes())
    onnx_file.check(small().SerializeToString())


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ("initializer { external_data { key: 'location' } }", "weights in another file"),
        ("initializer { data_location: EXTERNAL }", "weights in another file"),
        ("node { attribute { tensors { data_location: EXTERNAL } } }", "weights in another file"),
        ("node { op_type: 'Loop' }", "no model may use: 'Loop'"),
        ("node { op_type: 'Gemm' domain: 'com.example' }", "another domain, 'com.example'"),
        ("node { attribute { g { name: 'inner' } } }", "a graph within its graph"),
        ("node { attribute { graphs { name: 'inner' } } }", "a graph within its graph"),
        ("sparse_initializer { values { name: 'w' } }", "sparse weights"),
        ("node { attribute { sparse_tensor { values { name: 'w' } } } }", "sparse weights"),
        ("node { attribute { sparse_tensors { values { name: 'w' } } } }", "sparse weights"),
        ("} functions { name: 'Gemm'", "functions or training"),
        ("} training_info { algorithm { name: 'a' }", "functions or training"),
        ("node { op_type: 'Reshape' input: 'x' input: 'z' }", "size depends on the counts"),
        ("node { attribute { name: 'a' i: 1 f: 1 } }", "a of two kinds"),
        ("node { attribute { name: 'a' i: 1 } attribute { name: 'a' i: 2 } }", "a twice"),
    ],
)
def test_the_refusal_of_a_forbidden_part_names_it(more: str, says: str) -> None:
    model = small()
    text_format.Merge(f"graph {{ {more} }}", model)
    with pytest.raises(ModelError, match=says):
        onnx_file.check(model.SerializeToString())


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"nodes_truenodeids": [1, 0, 0, 0, 0, 1, 0, 0]}, "with a cycle"),
        ({"nodes_falsenodeids": [2, 0, 1, 0, 0, 2, 0, 0]}, "with a cycle"),
        ({"nodes_falsenodeids": [2, 0, 5, 0, 0, 2, 0, 0]}, "a node which it lacks"),
        ({"nodes_falsenodeids": [-1, 0, 4, 0, 0, 2, 0, 0]}, "a node which it lacks"),
        ({"nodes_featureids": [0, 0, 3, 0, 0, 1, 0, 0]}, "does not compare an input"),
        ({"nodes_featureids": [0, 0, -1, 0, 0, 1, 0, 0]}, "does not compare an input"),
        ({"nodes_modes": ["BRANCH_EQ", *TREES["nodes_modes"][1:]]}, "does not compare an input"),
        ({"nodes_modes": ["LEAF", *TREES["nodes_modes"][1:]]}, "does not reach"),
        ({"nodes_nodeids": [0, 1, 2, 3, 3, 0, 1, 2]}, "list a node twice"),
        ({"nodes_treeids": [0, 0, 0, 1, 0, 1, 1, 1]}, "list a node twice"),
        ({"nodes_treeids": [0, 0, 0, 0, 0, 1, 1]}, "differ in length"),
        ({"target_weights": [1.0]}, "differ in length"),
        ({"target_nodeids": [0, 3, 4, 1, 2]}, "not one of a leaf"),
        ({"target_nodeids": [9, 3, 4, 1, 2]}, "not one of a leaf"),
        ({"target_ids": [0, 0, 0, 0, 1]}, "not one of a leaf"),
    ],
)
def test_trees_with_cycles_gaps_or_wrong_lists_are_refused(
    changed: dict[str, list[Any]], says: str
) -> None:
    model = small()
    model.graph.node[2].CopyFrom(trees(**changed))
    with pytest.raises(ModelError, match=says):
        onnx_file.check(model.SerializeToString())


def test_trees_that_read_a_reshaped_value_are_refused() -> None:
    """A value that was reshaped may be narrower than the features that trees compare."""
    model = small()
    model.graph.node[2].input[0] = "y"
    with pytest.raises(ModelError, match="does not compare an input"):
        onnx_file.check(model.SerializeToString())


def test_every_piece_of_a_split_graph_is_checked() -> None:
    """Readers of this format put the pieces of a message together."""
    model, more = small(), onnx.ModelProto()
    more.graph.node.add().op_type = "Scan"
    content = model.SerializeToString() + more.SerializeToString()
    assert len(onnx.load_model_from_string(content).graph.node) == 6
    with pytest.raises(ModelError, match="'Scan'"):
        onnx_file.check(content)


def test_a_data_location_beyond_32_bits_is_refused() -> None:
    """`data_location` is 2**32 + 1. Other readers keep its low 32 bits, 1: data in another file."""
    location = bytes([14 << 3]) + b"\x81\x80\x80\x80\x10"  # 2**32 + 1
    tensor = b"\x42\x01w" + location
    graph = b"\x2a" + bytes([len(tensor)]) + tensor
    with pytest.raises(ModelError, match="in another file"):
        onnx_file.check(b"\x3a" + bytes([len(graph)]) + graph)


def test_bytes_that_are_not_a_protobuf_message_are_refused() -> None:
    cut_off = (b"\x3a\x05\x0a", b"\x3a", b"\x38\xff", b"\x3d\x01")
    for content in (*cut_off, b"\x3b", b"\x00\x00", b"\xff" * 20, b"\x08" + b"\xff" * 9 + b"\x02"):
        with pytest.raises(ModelError, match="not a usable ONNX model"):
            onnx_file.check(content)


def test_a_damaged_file_is_refused_or_still_a_sound_model() -> None:
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
    damage = b"\x0f"  # a field of an unknown kind
    with pytest.raises(ModelError, match="more than 1000 fields"):
        onnx_file.check(b"\x08\x01" * 1000 + damage)
    with pytest.raises(ModelError, match="a field of kind 7"):
        onnx_file.check(b"\x08\x01" * 999 + damage)
