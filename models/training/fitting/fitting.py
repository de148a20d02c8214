"""From a system and its training rows to something that judges: one function for every kind."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import onnx
from numpy.typing import NDArray
from sklearn.model_selection import StratifiedKFold
from torch import nn

from models.training.data.augmentation import augment
from models.training.estimators import compression, graphs
from models.training.estimators.classical import (
    ClassicalConfig,
    ClassicalModel,
    classical_margins,
    classical_size,
    fit_classical,
)
from models.training.estimators.networks import (
    AnyNetwork,
    DenseConfig,
    NetworkConfig,
    parameter_count,
)
from models.training.estimators.recipe import AnyRecipe, Progress, logits, train
from models.training.fitting.calibration import fit_temperature
from models.training.systems.system import BlendConfig, DistilConfig, System, digest


class Fitted(Protocol):
    """A trained system."""

    @property
    def parameters(self) -> int:
        """How many numbers it consists of."""

    def margins(self, inputs: NDArray[np.float32]) -> NDArray[np.float64]:
        """Log-odds of slip (N,), up to a temperature, of inputs (N, *shape)."""

    def to_onnx(self, temperature: float, input_name: str) -> onnx.ModelProto:
        """A graph from inputs (N, *shape) to `probability` (N, 2): sigmoid(margin / T)."""

    def margin_graph(self, input_name: str) -> onnx.ModelProto:
        """A graph from inputs (N, *shape) to `margin` (N, 1)."""


@dataclass(frozen=True, slots=True, eq=False)
class FittedNetwork:
    """A trained network; see `Fitted`."""

    network: nn.Sequential
    shape: tuple[int, ...]
    threads: int

    @property
    def parameters(self) -> int:
        """Trained weights and biases."""
        return parameter_count(self.network)

    def margins(self, inputs: NDArray[np.float32]) -> NDArray[np.float64]:
        """See `Fitted`."""
        if not len(inputs):
            return np.empty(0)
        values = logits(self.network, inputs, self.threads)
        margins: NDArray[np.float64] = values[:, 1] - values[:, 0]
        return margins

    def to_onnx(self, temperature: float, input_name: str) -> onnx.ModelProto:
        """See `Fitted`."""
        return graphs.network_probability(self.network, self.shape, temperature, input_name)

    def margin_graph(self, input_name: str) -> onnx.ModelProto:
        """See `Fitted`."""
        return graphs.network_margin(self.network, self.shape, input_name)


@dataclass(frozen=True, slots=True, eq=False)
class FittedClassical:
    """A fitted classifier of scikit-learn; see `Fitted`."""

    model: ClassicalModel

    @property
    def parameters(self) -> int:
        """Weights, support vectors' values or tree nodes."""
        return classical_size(self.model)

    def margins(self, inputs: NDArray[np.float32]) -> NDArray[np.float64]:
        """See `Fitted`."""
        return classical_margins(self.model, inputs)

    def to_onnx(self, temperature: float, input_name: str) -> onnx.ModelProto:
        """See `Fitted`."""
        return graphs.with_probability(self.margin_graph(input_name), temperature)

    def margin_graph(self, input_name: str) -> onnx.ModelProto:
        """See `Fitted`."""
        return graphs.classical_margin(self.model, input_name)


@dataclass(frozen=True, slots=True, eq=False)
class FittedBlend:
    """Weighted sum of trained members; see `Fitted`."""

    members: tuple[FittedNetwork | FittedClassical, ...]
    factors: tuple[float, ...]
    """What each member's margin is multiplied by."""

    @property
    def parameters(self) -> int:
        """Of all members."""
        return sum(member.parameters for member in self.members)

    def margins(self, inputs: NDArray[np.float32]) -> NDArray[np.float64]:
        """See `Fitted`."""
        total = np.zeros(len(inputs))
        for member, factor in zip(self.members, self.factors, strict=True):
            total += factor * member.margins(inputs)
        return total

    def to_onnx(self, temperature: float, input_name: str) -> onnx.ModelProto:
        """See `Fitted`."""
        return graphs.with_probability(self.margin_graph(input_name), temperature)

    def margin_graph(self, input_name: str) -> onnx.ModelProto:
        """See `Fitted`."""
        parts = [member.margin_graph(input_name) for member in self.members]
        return graphs.weighted_sum(parts, self.factors)


@dataclass(frozen=True, slots=True, eq=False)
class FittedStandardised:
    """A trained system whose inputs are standardised first; see `Fitted`."""

    inner: Fitted
    mean: NDArray[np.float32]
    scale: NDArray[np.float32]
    """Of each value of an input: one over its spread in the training."""

    @property
    def parameters(self) -> int:
        """Of the system and of the standardisation."""
        return self.inner.parameters + self.mean.size + self.scale.size

    def margins(self, inputs: NDArray[np.float32]) -> NDArray[np.float64]:
        """See `Fitted`."""
        return self.inner.margins((inputs - self.mean) * self.scale)

    def to_onnx(self, temperature: float, input_name: str) -> onnx.ModelProto:
        """See `Fitted`."""
        return graphs.standardised(
            self.inner.to_onnx(temperature, input_name), self.mean, self.scale
        )

    def margin_graph(self, input_name: str) -> onnx.ModelProto:
        """See `Fitted`."""
        return graphs.standardised(self.inner.margin_graph(input_name), self.mean, self.scale)


@dataclass(frozen=True, slots=True, eq=False)
class FittedCompressed:
    """A trained system in a smaller form, which judges as its graph does; see `Fitted`."""

    graph: onnx.ModelProto
    """From inputs to `margin`."""

    @property
    def parameters(self) -> int:
        """Of the graph."""
        return compression.size(self.graph)

    def margins(self, inputs: NDArray[np.float32]) -> NDArray[np.float64]:
        """See `Fitted`."""
        return compression.GraphMargins(self.graph)(inputs)

    def to_onnx(self, temperature: float, input_name: str) -> onnx.ModelProto:
        """See `Fitted`."""
        return graphs.with_probability(self.margin_graph(input_name), temperature)

    def margin_graph(self, input_name: str) -> onnx.ModelProto:
        """See `Fitted`."""
        return graphs.renamed(self.graph, input_name)


def fit(
    system: System,
    inputs: NDArray[np.float32],
    slipped: NDArray[np.bool_],
    *,
    seed: int,
    on_epoch: Progress | None = None,
) -> Fitted:
    """Train a system on inputs (N, *shape), as its input's builder makes them, and labels (N,).

    The same arguments give the same result on the same machine. Raises `ValueError` if the inputs
    do not fit the estimator, or are too few.
    """
    if system.compression is not None:
        plain = replace(system, compression=None)
        whole = _fit_before(plain, inputs, slipped, seed, on_epoch)
        return FittedCompressed(
            compression.compressed(whole.margin_graph("given"), system.compression, inputs)
        )
    if system.standardise:
        mean, spread = inputs.mean(axis=0, dtype=np.float64), inputs.std(axis=0, dtype=np.float64)
        # A value that never changes tells nothing: it becomes zero.
        scale = np.divide(1.0, spread, where=spread > 0.0, out=np.zeros_like(spread))
        mean, scale = mean.astype(np.float32), scale.astype(np.float32)
        plain = replace(system, standardise=False)
        inner = fit(plain, (inputs - mean) * scale, slipped, seed=seed, on_epoch=on_epoch)
        return FittedStandardised(inner, mean, scale)
    if system.augmentation is not None:
        inputs, slipped = augment(inputs, slipped, system.augmentation, seed)
    match system.estimator:
        case BlendConfig() as blend:
            return _fit_blend(blend, inputs, slipped, seed, on_epoch)
        case DistilConfig() as distil:
            targets = _targets(distil, inputs, slipped, seed, on_epoch)
            return _fit_network(distil.student, system.recipe, inputs, targets, seed, on_epoch)
        case single:
            return _fit_single(single, system.recipe, inputs, slipped, seed, on_epoch)


def _fit_network(
    config: AnyNetwork,
    recipe: AnyRecipe | None,
    inputs: NDArray[np.float32],
    slipped: NDArray[np.bool_] | NDArray[np.float64],
    seed: int,
    on_epoch: Progress | None,
) -> FittedNetwork:
    if recipe is None:
        raise ValueError("a network needs a recipe")
    network = train(config, inputs, slipped, recipe, seed=seed, on_epoch=on_epoch)
    return FittedNetwork(network, inputs.shape[1:], recipe.threads)


def _fit_blend(
    blend: BlendConfig,
    inputs: NDArray[np.float32],
    slipped: NDArray[np.bool_],
    seed: int,
    on_epoch: Progress | None,
) -> FittedBlend:
    copies = [member for member in blend.members for _ in range(member.copies)]
    total = sum(member.weight for member in blend.members)
    fitted, factors = [], []
    for member, own in zip(copies, _seeds(seed, len(copies)), strict=True):
        judge = _fit_single(member.estimator, member.recipe, inputs, slipped, own, on_epoch)
        spread = float(judge.margins(inputs).std())
        fitted.append(judge)
        # A member that judges all grasps alike has learnt nothing and has no say.
        share = member.weight / (member.copies * total)
        factors.append(share / spread if spread > 0.0 else 0.0)
    return FittedBlend(tuple(fitted), tuple(factors))


_former: list[tuple[str, Fitted]] = []
"""The last system that was fitted to be compressed, and what it came from: its other forms come
next, and differ in nothing else."""


def _fit_before(
    system: System,
    inputs: NDArray[np.float32],
    slipped: NDArray[np.bool_],
    seed: int,
    on_epoch: Progress | None,
) -> Fitted:
    parts = hashlib.sha256(f"{digest(system)} {seed}".encode())
    parts.update(np.ascontiguousarray(inputs).data)
    parts.update(np.ascontiguousarray(slipped).data)
    key = parts.hexdigest()
    if not _former or _former[0][0] != key:
        _former[:] = [(key, fit(system, inputs, slipped, seed=seed, on_epoch=on_epoch))]
    return _former[0][1]


def _fit_single(
    estimator: AnyNetwork | ClassicalConfig,
    recipe: AnyRecipe | None,
    inputs: NDArray[np.float32],
    slipped: NDArray[np.bool_],
    seed: int,
    on_epoch: Progress | None,
) -> FittedNetwork | FittedClassical:
    match estimator:
        case NetworkConfig() | DenseConfig() as network:
            return _fit_network(network, recipe, inputs, slipped, seed, on_epoch)
        case classical:
            return FittedClassical(fit_classical(classical, inputs, slipped, seed))


def _targets(
    distil: DistilConfig,
    inputs: NDArray[np.float32],
    slipped: NDArray[np.bool_],
    seed: int,
    on_epoch: Progress | None,
) -> NDArray[np.float64]:
    """Probabilities of slip (N,): the labels mixed with what the teacher says out of fold."""
    margins = np.empty(len(inputs))
    split = StratifiedKFold(distil.inner_folds, shuffle=True, random_state=seed)
    seeds = _seeds(seed, distil.inner_folds)
    for own, (rest, fold) in zip(seeds, split.split(inputs, slipped), strict=True):
        teacher = _fit_blend(distil.teacher, inputs[rest], slipped[rest], own, on_epoch)
        margins[fold] = teacher.margins(inputs[fold])
    temperature = fit_temperature(margins, slipped)
    soft = 1.0 / (1.0 + np.exp(-margins / temperature))
    targets: NDArray[np.float64] = distil.hard * slipped + (1.0 - distil.hard) * soft
    return targets


def _seeds(seed: int, number: int) -> Sequence[int]:
    return [int(value) for value in np.random.SeedSequence(seed).generate_state(number)]
