"""Make ONNX graphs of trained estimators: input (N, *shape), output margin or probability."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper
from onnx.compose import add_prefix_graph
from onnx.parser import parse_node
from skl2onnx import to_onnx
from sklearn.ensemble import RandomForestClassifier
from sklearn.neural_network import MLPClassifier
from sklearn.svm import SVC
from torch import nn

from graspd.models.contract import OUTPUT_NAME
from graspd.models.training.arrays import Floats, Floats32, Numbers
from graspd.models.training.estimators.classical import PROBABILITY_FLOOR, Boosting, ClassicalModel

OPSET = 18
"""Operator set of the exporters; all allowed versions of onnxruntime have it."""
ML_OPSET = 3
"""Operator set of the domain `ai.onnx.ml`, which has the trees."""
IR_VERSION = 10
"""Version of the file format; onnxruntime 1.18 reads it."""
MARGIN_NAME = "margin"
FLOAT, DOUBLE = onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE


def classical_margin(model: ClassicalModel, input_name: str) -> onnx.ModelProto:
    """Return the graph of a classifier's log-odds of slip, (N, 1)."""
    graph_of: dict[type[ClassicalModel], Callable[[Any, str], onnx.ModelProto]] = {
        SVC: _svm,
        Boosting: _boosting,
        RandomForestClassifier: _forest,
        MLPClassifier: _perceptron,
    }
    return graph_of[type(model)](model, input_name)


def weighted_sum(parts: Sequence[onnx.ModelProto], factors: Sequence[float]) -> onnx.ModelProto:
    """Join graphs of one input: the margin is the sum of their margins times `factors`."""
    given = parts[0].graph.input[0]
    nodes: list[onnx.NodeProto] = []
    constants: list[onnx.TensorProto] = []
    terms = []
    for index, (part, factor) in enumerate(zip(parts, factors, strict=True)):
        prefix = f"member{index}_"
        graph = add_prefix_graph(part.graph, prefix)
        _feed(graph, prefix + given.name, given.name)
        term, weight = f"{prefix}term", f"{prefix}factor"
        nodes += [*graph.node, *_nodes(f"{term} = Mul ({prefix}{MARGIN_NAME}, {weight})")]
        constants += [*graph.initializer, _constant(weight, np.array(factor, np.float32))]
        terms.append(term)
    nodes += _nodes(f"{MARGIN_NAME} = Sum ({', '.join(terms)})")
    return _model(nodes, constants, given, MARGIN_NAME, 1)


def with_probability(margin: onnx.ModelProto, temperature: float) -> onnx.ModelProto:
    """Return the graph with `probability` (N, 2) of stable and slip: sigmoid(margin / T)."""
    # softmax(-m / 2T, m / 2T) is 1 - sigmoid(m / T), sigmoid(m / T).
    share = np.array([[-0.5, 0.5]]) / temperature
    nodes = _nodes(
        f"tempered = MatMul ({MARGIN_NAME}, half_over_temperature)",
        f"{OUTPUT_NAME} = Softmax <axis: int = 1> (tempered)",
    )
    graph, constant = margin.graph, _constant("half_over_temperature", share.astype(np.float32))
    return _model(
        [*graph.node, *nodes], [*graph.initializer, constant], graph.input[0], OUTPUT_NAME, 2
    )


def standardised(model: onnx.ModelProto, mean: Floats32, scale: Floats32) -> onnx.ModelProto:
    """Put `(input - mean) * scale`, both in the shape of one input, before a graph, in place."""
    graph = model.graph
    given = graph.input[0].name
    _feed(graph, given, "standardised")
    steps = _nodes(
        f"centred = Sub ({given}, input_mean)", "standardised = Mul (centred, input_scale)"
    )
    nodes = [*steps, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    graph.initializer.extend((_constant("input_mean", mean), _constant("input_scale", scale)))
    return model


def _feed(graph: onnx.GraphProto, former: str, name: str) -> None:
    """Let every node that takes `former` take `name` instead."""
    for node in graph.node:
        node.input[:] = [name if given == former else given for given in node.input]


def _svm(model: SVC, input_name: str) -> onnx.ModelProto:
    """Return the graph of a support vector machine in double precision.

    ONNX's own SVMClassifier sums in float32; with large C its margins are wrong by over 0.01.
    """
    vectors = model.support_vectors_
    features = vectors.shape[1]
    gamma = 1.0 / features if model.gamma == "auto" else float(model.gamma)
    # -gamma * |x - v|**2 = 2 gamma x.v - gamma |v|**2 - gamma |x|**2
    constants = [
        # The support vectors are readings, float32 as the input is: nothing is lost here.
        _constant("vectors", vectors.T.astype(np.float32)),
        _constant("two_gamma", np.array(2.0 * gamma)),
        _constant("minus_gamma", np.array(-gamma)),
        _constant("vector_part", -gamma * np.square(vectors).sum(axis=1)),
        _constant("weights", model.dual_coef_.reshape(-1, 1).astype(np.float64)),
        _constant("bias", model.intercept_.astype(np.float64)),
        _constant("axis", np.array([1])),
    ]
    nodes = _nodes(
        f"x_64 = Cast <to: int = {DOUBLE}> ({input_name})",
        f"vectors_64 = Cast <to: int = {DOUBLE}> (vectors)",
        "products = MatMul (x_64, vectors_64)",
        "both_part = Mul (products, two_gamma)",
        "squares = ReduceSumSquare <keepdims: int = 1> (x_64, axis)",
        "x_part = Mul (squares, minus_gamma)",
        "without_x = Add (both_part, vector_part)",
        "exponent = Add (without_x, x_part)",
        "kernel = Exp (exponent)",
        "weighted = MatMul (kernel, weights)",
        "decision = Add (weighted, bias)",
        f"{MARGIN_NAME} = Cast <to: int = {FLOAT}> (decision)",
    )
    return _vector_model(nodes, constants, input_name, features)


def _boosting(model: Boosting, input_name: str) -> onnx.ModelProto:
    """Return one TreeEnsembleRegressor; skl2onnx 1.20 cannot write it with onnx 1.23."""
    trees = model.trees
    of_tree = np.repeat(np.arange(len(trees)), [len(tree) for tree in trees])
    of_node = np.concatenate([np.arange(len(tree)) for tree in trees])
    nodes = np.concatenate(trees)
    leaf = nodes["is_leaf"].astype(np.bool_)
    node = helper.make_node(
        "TreeEnsembleRegressor",
        [input_name],
        [MARGIN_NAME],
        domain="ai.onnx.ml",
        n_targets=1,
        aggregate_function="SUM",
        base_values=[model.base],
        nodes_treeids=of_tree.tolist(),
        nodes_nodeids=of_node.tolist(),
        nodes_modes=np.where(leaf, "LEAF", "BRANCH_LEQ").tolist(),
        nodes_featureids=np.where(leaf, 0, nodes["feature_idx"]).tolist(),
        nodes_values=np.where(leaf, 0.0, _float32_below(nodes["num_threshold"])).tolist(),
        nodes_truenodeids=np.where(leaf, 0, nodes["left"]).tolist(),
        nodes_falsenodeids=np.where(leaf, 0, nodes["right"]).tolist(),
        target_treeids=of_tree[leaf].tolist(),
        target_nodeids=of_node[leaf].tolist(),
        target_ids=[0] * int(leaf.sum()),
        target_weights=nodes["value"][leaf].tolist(),
    )
    return _vector_model([node], [], input_name, model.n_features_in_)


def _float32_below(thresholds: Floats) -> Floats32:
    """Return the largest float32 not above each threshold, so that comparisons agree."""
    nearest = thresholds.astype(np.float32)
    return np.where(nearest > thresholds, np.nextafter(nearest, np.float32(-np.inf)), nearest)


def _forest(model: RandomForestClassifier, input_name: str) -> onnx.ModelProto:
    """Return a graph whose trees add votes; shares of 1/199 would round differently."""
    (trees,) = _from_sklearn(model, input_name).graph.node
    number = len(model.estimators_)
    (weights,) = (part for part in trees.attribute if part.name == "class_weights")
    weights.floats[:] = np.array(weights.floats) * number
    nodes = _nodes(
        "votes = Gather <axis: int = 1> (probabilities, slip_column)",
        f"votes_64 = Cast <to: int = {DOUBLE}> (votes)",
        "p = Div (votes_64, trees)",
        "p_slip = Clip (p, floor, ceiling)",
        "p_stable = Sub (one, p_slip)",
        "odds = Div (p_slip, p_stable)",
        "log_odds = Log (odds)",
        f"{MARGIN_NAME} = Cast <to: int = {FLOAT}> (log_odds)",
    )
    constants = [
        _constant("slip_column", np.array([1])),
        _constant("trees", np.array(float(number))),
        _constant("floor", np.array(PROBABILITY_FLOOR)),
        _constant("ceiling", np.array(1.0 - PROBABILITY_FLOOR)),
        _constant("one", np.array(1.0)),
    ]
    return _vector_model([trees, *nodes], constants, input_name, model.n_features_in_)


def _perceptron(model: MLPClassifier, input_name: str) -> onnx.ModelProto:
    """Return the graph up to the last logistic function, which loses large margins."""
    graph = _from_sklearn(model, input_name).graph
    kinds = [node.op_type for node in graph.node]
    nodes = list(graph.node[: kinds.index("Sigmoid")])
    nodes[-1].output[0] = MARGIN_NAME
    used = {name for node in nodes for name in node.input}
    constants = [tensor for tensor in graph.initializer if tensor.name in used]
    return _vector_model(nodes, constants, input_name, model.n_features_in_)


def _from_sklearn(model: ClassicalModel, input_name: str) -> onnx.ModelProto:
    """Return a classifier as ONNX, with the outputs `label` and `probabilities` (N, 2)."""
    converted: onnx.ModelProto = to_onnx(
        model,
        np.zeros((1, model.n_features_in_), dtype=np.float32),
        target_opset={"": OPSET, "ai.onnx.ml": ML_OPSET},
        options={id(model): {"zipmap": False}},
    )
    _feed(converted.graph, converted.graph.input[0].name, input_name)
    return converted


def from_torch(
    network: nn.Module, shape: Sequence[int], input_name: str, output_name: str
) -> onnx.ModelProto:
    """Return the graph of a network of inputs (N, *shape)."""
    # Two inputs, because one would let the exporter take the batch for a constant.
    example = torch.zeros(2, *shape)
    # On the exporter's warnings and deprecations no user can act.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        warnings.simplefilter("ignore", DeprecationWarning)
        program = torch.onnx.export(
            network,
            (example,),
            input_names=[input_name],
            output_names=[output_name],
            dynamic_shapes=({0: torch.export.Dim("N")},),
            opset_version=OPSET,
            external_data=False,
            dynamo=True,
            verbose=False,
        )
    if program is None:
        raise RuntimeError("the exporter returned nothing")
    model: onnx.ModelProto = program.model_proto
    _strip(model)
    return model


def _strip(model: onnx.ModelProto) -> None:
    """Remove stack traces with paths of this machine from all metadata."""
    graph = model.graph
    parts = (graph, *graph.node, *graph.initializer, *graph.value_info, *graph.input, *graph.output)
    for part in (model, *parts):
        del part.metadata_props[:]
        part.doc_string = ""
    del graph.value_info[:]


def _model(
    nodes: Sequence[onnx.NodeProto],
    constants: Sequence[onnx.TensorProto],
    given: onnx.ValueInfoProto,
    output_name: str,
    columns: int,
) -> onnx.ModelProto:
    output = helper.make_tensor_value_info(output_name, FLOAT, ["N", columns])
    opsets = [helper.make_opsetid("", OPSET)]
    if any(node.domain == "ai.onnx.ml" for node in nodes):
        opsets.append(helper.make_opsetid("ai.onnx.ml", ML_OPSET))
    graph = helper.make_graph(nodes, "graspd", [given], [output], constants)
    return helper.make_model(graph, opset_imports=opsets, ir_version=IR_VERSION)


def _vector_model(
    nodes: Sequence[onnx.NodeProto],
    constants: Sequence[onnx.TensorProto],
    input_name: str,
    width: int,
) -> onnx.ModelProto:
    """Return the graph from vectors (N, width) to their margin."""
    given = helper.make_tensor_value_info(input_name, FLOAT, ["N", width])
    return _model(nodes, constants, given, MARGIN_NAME, 1)


def _nodes(*texts: str) -> list[onnx.NodeProto]:
    nodes = [parse_node(text) for text in texts]
    for node in nodes:
        node.ClearField("domain")  # the parser writes "", which stands for itself
    return nodes


def _constant(name: str, values: Numbers) -> onnx.TensorProto:
    return numpy_helper.from_array(np.ascontiguousarray(values), name)
