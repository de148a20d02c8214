"""ONNX graphs of trained systems: input (N, *shape), output margin or probability."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper
from onnx.compose import add_prefix_graph
from onnx.parser import parse_node
from torch import nn

from graspd.models.contract import OUTPUT_NAME
from graspd.models.training.arrays import Floats, Floats32, Numbers

OPSET = 18
"""Operator set of the exporters; all allowed versions of onnxruntime have it."""
ML_OPSET = 3
"""Operator set of the domain `ai.onnx.ml`, which has the trees."""
IR_VERSION = 10
"""Version of the file format; onnxruntime 1.18 reads it."""
MARGIN_NAME = "margin"
FLOAT, DOUBLE = onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE


class Fitted(Protocol):
    """A trained system, which gives margins and is exported to ONNX."""

    @property
    def parameters(self) -> int:
        """Number of parameters."""

    def margins(self, inputs: Floats32) -> Floats:
        """Return the log-odds of slip (N,), uncalibrated, of inputs (N, *shape)."""

    def margin_graph(self, input_name: str) -> onnx.ModelProto:
        """Return the graph from inputs (N, *shape) to `margin` (N, 1)."""

    def to_onnx(self, temperature: float, input_name: str) -> onnx.ModelProto:
        """Return the graph from inputs to `probability` (N, 2) of stable and slip; that of slip is
        sigmoid(margin / temperature)."""
        return with_probability(self.margin_graph(input_name), temperature)


def weighted_sum(parts: Sequence[onnx.ModelProto], factors: Sequence[float]) -> onnx.ModelProto:
    """Join graphs of one input: the margin is the sum of their margins times `factors`."""
    given = parts[0].graph.input[0]
    nodes: list[onnx.NodeProto] = []
    constants: list[onnx.TensorProto] = []
    terms = []
    for index, (part, factor) in enumerate(zip(parts, factors, strict=True)):
        prefix = f"member{index}_"
        graph = add_prefix_graph(part.graph, prefix)
        feed(graph, prefix + given.name, given.name)
        term, weight = f"{prefix}term", f"{prefix}factor"
        nodes += [*graph.node, *nodes_of(f"{term} = Mul ({prefix}{MARGIN_NAME}, {weight})")]
        constants += [*graph.initializer, constant(weight, np.array(factor, np.float32))]
        terms.append(term)
    nodes += nodes_of(f"{MARGIN_NAME} = Sum ({', '.join(terms)})")
    return _model(nodes, constants, given, MARGIN_NAME, 1)


def with_probability(margin: onnx.ModelProto, temperature: float) -> onnx.ModelProto:
    """Return a margin's graph with output `probability` (N, 2): (1 - p, p) for
    p = sigmoid(margin / temperature)."""
    # softmax(-m / 2T, m / 2T) is 1 - sigmoid(m / T), sigmoid(m / T).
    share = np.array([[-0.5, 0.5]]) / temperature
    nodes = nodes_of(
        f"tempered = MatMul ({MARGIN_NAME}, half_over_temperature)",
        f"{OUTPUT_NAME} = Softmax <axis: int = 1> (tempered)",
    )
    graph, half = margin.graph, constant("half_over_temperature", share.astype(np.float32))
    return _model([*graph.node, *nodes], [*graph.initializer, half], graph.input[0], OUTPUT_NAME, 2)


def standardised(model: onnx.ModelProto, mean: Floats32, scale: Floats32) -> onnx.ModelProto:
    """Put `(input - mean) * scale`, both in the shape of one input, before a graph, in place."""
    graph = model.graph
    given = graph.input[0].name
    feed(graph, given, "standardised")
    steps = nodes_of(
        f"centred = Sub ({given}, input_mean)", "standardised = Mul (centred, input_scale)"
    )
    nodes = [*steps, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    graph.initializer.extend((constant("input_mean", mean), constant("input_scale", scale)))
    return model


def feed(graph: onnx.GraphProto, former: str, name: str) -> None:
    """Replace the input `former` of every node by `name`."""
    for node in graph.node:
        node.input[:] = [name if given == former else given for given in node.input]


def from_torch(
    network: nn.Module, shape: Sequence[int], input_name: str, output_name: str
) -> onnx.ModelProto:
    """Return the graph of a network of inputs (N, *shape)."""
    # Two inputs: with one the exporter would treat the batch size as a constant.
    example = torch.zeros(2, *shape)
    # Users cannot act on the exporter's warnings and deprecations.
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


def vector_model(
    nodes: Sequence[onnx.NodeProto],
    constants: Sequence[onnx.TensorProto],
    input_name: str,
    width: int,
) -> onnx.ModelProto:
    """Return the graph of nodes that compute `margin` (N, 1) from vectors (N, width)."""
    given = helper.make_tensor_value_info(input_name, FLOAT, ["N", width])
    return _model(nodes, constants, given, MARGIN_NAME, 1)


def nodes_of(*texts: str) -> list[onnx.NodeProto]:
    """Return a node for each of `texts`, such as `y = Mul (x, factor)`."""
    nodes = [parse_node(text) for text in texts]
    for node in nodes:
        node.ClearField("domain")  # the parser writes "", the default
    return nodes


def constant(name: str, values: Numbers) -> onnx.TensorProto:
    """Return `values` as a constant of a graph."""
    return numpy_helper.from_array(np.ascontiguousarray(values), name)
