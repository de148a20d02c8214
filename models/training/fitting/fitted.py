"""Trained systems: what judges inputs, and the ONNX graph that judges alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import onnx
from torch import nn

from models.training.arrays import Floats, Floats32
from models.training.estimators import compression, graphs
from models.training.estimators.classical import ClassicalModel, classical_margins, classical_size
from models.training.estimators.networks import parameter_count
from models.training.estimators.recipe import logits


class Fitted(Protocol):
    """A trained system of any kind."""

    @property
    def parameters(self) -> int:
        """How many numbers it consists of."""

    def margins(self, inputs: Floats32) -> Floats:
        """Log-odds of slip (N,), not yet divided by a temperature, of inputs (N, *shape)."""

    def margin_graph(self, input_name: str) -> onnx.ModelProto:
        """A graph from inputs (N, *shape) to `margin` (N, 1)."""

    def to_onnx(self, temperature: float, input_name: str) -> onnx.ModelProto:
        """A graph from inputs (N, *shape) to `probability` (N, 2): sigmoid(margin / T)."""
        return graphs.with_probability(self.margin_graph(input_name), temperature)


@dataclass(frozen=True, slots=True, eq=False)
class FittedNetwork(Fitted):
    """A trained network; `parameters` are its weights and biases."""

    network: nn.Sequential
    shape: tuple[int, ...]
    threads: int

    @property
    def parameters(self) -> int:
        return parameter_count(self.network)

    def margins(self, inputs: Floats32) -> Floats:
        if not len(inputs):
            return np.empty(0)
        values = logits(self.network, inputs, self.threads)
        margins: Floats = values[:, 1] - values[:, 0]
        return margins

    def margin_graph(self, input_name: str) -> onnx.ModelProto:
        return graphs.network_margin(self.network, self.shape, input_name)

    def to_onnx(self, temperature: float, input_name: str) -> onnx.ModelProto:
        return graphs.network_probability(self.network, self.shape, temperature, input_name)


@dataclass(frozen=True, slots=True, eq=False)
class FittedClassical(Fitted):
    """A fitted classifier; `parameters` are weights, support vectors' values or tree nodes."""

    model: ClassicalModel

    @property
    def parameters(self) -> int:
        return classical_size(self.model)

    def margins(self, inputs: Floats32) -> Floats:
        return classical_margins(self.model, inputs)

    def margin_graph(self, input_name: str) -> onnx.ModelProto:
        return graphs.classical_margin(self.model, input_name)


@dataclass(frozen=True, slots=True, eq=False)
class FittedBlend(Fitted):
    """Weighted sum of the margins of trained members."""

    members: tuple[FittedNetwork | FittedClassical, ...]
    factors: tuple[float, ...]
    """What each member's margin is multiplied by."""

    @property
    def parameters(self) -> int:
        return sum(member.parameters for member in self.members)

    def margins(self, inputs: Floats32) -> Floats:
        total = np.zeros(len(inputs))
        for member, factor in zip(self.members, self.factors, strict=True):
            total += factor * member.margins(inputs)
        return total

    def margin_graph(self, input_name: str) -> onnx.ModelProto:
        parts = [member.margin_graph(input_name) for member in self.members]
        return graphs.weighted_sum(parts, self.factors)


@dataclass(frozen=True, slots=True, eq=False)
class FittedStandardised(Fitted):
    """A trained system whose inputs are standardised first."""

    inner: Fitted
    mean: Floats32
    """Of the training, in the shape of an input."""
    scale: Floats32
    """One over the spread in the training, in the shape of an input; 0 where nothing varied."""

    @property
    def parameters(self) -> int:
        return self.inner.parameters + self.mean.size + self.scale.size

    def margins(self, inputs: Floats32) -> Floats:
        return self.inner.margins((inputs - self.mean) * self.scale)

    def margin_graph(self, input_name: str) -> onnx.ModelProto:
        return graphs.standardised(self.inner.margin_graph(input_name), self.mean, self.scale)

    def to_onnx(self, temperature: float, input_name: str) -> onnx.ModelProto:
        graph = self.inner.to_onnx(temperature, input_name)
        return graphs.standardised(graph, self.mean, self.scale)


@dataclass(frozen=True, slots=True, eq=False)
class FittedCompressed(Fitted):
    """A trained system in a smaller form; it judges by running its graph."""

    graph: onnx.ModelProto
    """From inputs to `margin`."""

    @property
    def parameters(self) -> int:
        return compression.size(self.graph)

    def margins(self, inputs: Floats32) -> Floats:
        return compression.graph_margins(self.graph, inputs)

    def margin_graph(self, input_name: str) -> onnx.ModelProto:
        return graphs.renamed(self.graph, input_name)
