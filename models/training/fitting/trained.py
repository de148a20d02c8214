"""Train a system of any kind on grasps; the result judges counts, and becomes a model file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import onnx
from scipy.ndimage import rotate
from torch import nn

from graspd.models.contract import OUTPUT_NAME, Input, SeenCounts, SessionInput, Sharpness
from graspd.models.inputs import builder, raw_features
from graspd.models.training.arrays import Bools, Floats, Floats32, Ints, Numbers
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.estimators import graphs
from graspd.models.training.estimators.classical import FittedClassical, fit_classical
from graspd.models.training.estimators.configs import (
    AnyRecipe,
    Augmentation,
    ClassicalConfig,
    NetworkConfig,
)
from graspd.models.training.estimators.graphs import Fitted
from graspd.models.training.estimators.networks import (
    for_inference,
    for_margin,
    logits,
    train_network,
)
from graspd.models.training.fitting.novelty import MARGIN_COUNTS, SESSION_MARGIN_COUNTS, seen_counts
from graspd.models.training.fitting.standards import (
    CALIBRATED_FROM,
    PRIOR_GRASPS,
    Standards,
    TrainingStandards,
)
from graspd.models.training.systems.registry import BlendConfig, SessionFeatures, System


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """A trained system: `fitted`, and the `grasps` that it was trained on."""

    system: System
    fitted: Fitted
    grasps: Grasps
    standards: TrainingStandards | None
    """Standards of a session system's features; None for other systems."""
    sensors: TrainingStandards | None
    """Standards of a session system's counts (fingers * 24,), by which `mapped` maps tables; None
    for other systems."""

    def margins(self, counts: Numbers, table_of: Ints) -> Floats:
        """Return uncalibrated log-odds of slip (N,) of counts (N, fingers, 24) and tables (N,).
        Raises `KeyError` if a session system was not trained on one of these tables."""
        return self.fitted.margins(_inputs(self.system, self.standards, counts, table_of))

    def mapped(self, counts: Numbers, table_of: Ints) -> Floats:
        """Return counts (N, fingers, 24) of tables (N,) as the training's sensors would read them.

        Each table is mapped by its own mean and spread, as the daemon maps a session. A model
        without a session takes the counts unchanged.
        """
        values = counts.astype(np.float64)
        if self.sensors is None:
            return values
        return _moved(values, self.sensors.each(table_of), self.sensors.prior)

    def unmapped(self, values: Floats, table_of: Ints) -> Floats:
        """Return the inverse of `mapped`."""
        if self.sensors is None:
            return values
        return _moved(values, self.sensors.prior, self.sensors.each(table_of))

    def takes(self, sharpness: Sequence[Sharpness] = (Sharpness(0.0, 1.0),)) -> Input:
        """Return the input for a contract. `sharpness`: temperatures by the age of a session; only
        a session system uses them."""
        if not isinstance(self.system.input, SessionFeatures):
            return self.system.input
        if self.standards is None:
            raise ValueError("a session system was trained without standards")
        return SessionInput(
            mean=tuple(self.standards.prior.mean.tolist()),
            spread=tuple(self.standards.prior.spread.tolist()),
            clip=self.system.input.clip,
            prior_grasps=PRIOR_GRASPS,
            calibrated_from=CALIBRATED_FROM,
            sharpness=tuple(sharpness),
        )

    def seen(self) -> SeenCounts:
        """Description of the training counts, to find readings unlike them."""
        margin = MARGIN_COUNTS if self.sensors is None else SESSION_MARGIN_COUNTS
        return seen_counts(self.mapped(self.grasps.counts, self.grasps.table_of), margin)


def train(system: System, grasps: Grasps, seed: int) -> Trained:
    """Train a system on grasps with only its fingers, on one thread.

    Raises `ValueError` if they are too few.
    """
    counts, table_of = grasps.counts, grasps.table_of
    session = isinstance(system.input, SessionFeatures)
    standards = TrainingStandards.of(raw_features(counts), table_of) if session else None
    inputs = _inputs(system, standards, counts, table_of)
    fitted = fit(system, inputs, grasps.slipped, seed=seed)
    sensors = _sensor_standards(counts, table_of) if session else None
    return Trained(system, fitted, grasps, standards, sensors)


def _sensor_standards(counts: Numbers, table_of: Ints) -> TrainingStandards:
    """Return the standards of counts (N, fingers, 24), by table.

    The mean of the prior is the mean of the tables' means.
    """
    tables = TrainingStandards.of(counts.reshape(len(counts), -1).astype(np.float64), table_of)
    centre = np.mean([table.mean for table in tables.tables.values()], axis=0)
    return replace(tables, prior=Standards(centre, tables.prior.spread))


def _inputs(
    system: System, standards: TrainingStandards | None, counts: Numbers, table_of: Ints
) -> Floats32:
    if isinstance(system.input, SessionFeatures):
        if standards is None:
            raise ValueError("a session system needs standards")
        return standards.each(table_of).apply(raw_features(counts), system.input.clip)
    return builder(system.input, len(system.fingers)).build_batch(counts)[0]


def _moved(values: Floats, source: Standards, to: Standards) -> Floats:
    flat = (values.reshape(len(values), -1) - source.mean) / source.spread
    moved: Floats = flat * to.spread + to.mean
    return moved.reshape(values.shape)


def fit(system: System, inputs: Floats32, slipped: Bools, *, seed: int) -> Fitted:
    """Train a system on inputs (N, *shape), as its input's builder makes them, and labels (N,).

    The same arguments give the same result on the same machine. Raises `ValueError` if the inputs
    do not fit the estimator, or are too few.
    """
    if system.standardise:
        spread = inputs.std(axis=0, dtype=np.float64)
        # A constant value has no information: it becomes zero.
        scale = np.divide(1.0, spread, where=spread > 0.0, out=np.zeros_like(spread))
        mean = inputs.mean(axis=0, dtype=np.float64).astype(np.float32)
        scale = scale.astype(np.float32)
        plain = replace(system, standardise=False)
        inner = fit(plain, (inputs - mean) * scale, slipped, seed=seed)
        return FittedStandardised(inner, mean, scale)
    if system.augmentation is not None:
        inputs, slipped = augment(inputs, slipped, system.augmentation, seed)
    if isinstance(system.estimator, BlendConfig):
        return _fit_blend(system.estimator, inputs, slipped, seed)
    return _fit_single(system.estimator, system.recipe, inputs, slipped, seed)


@dataclass(frozen=True, slots=True, eq=False)
class FittedNetwork(Fitted):
    """A trained network; `parameters` are its weights and biases."""

    network: nn.Sequential
    shape: tuple[int, ...]

    @property
    def parameters(self) -> int:
        return sum(parameter.numel() for parameter in self.network.parameters())

    def margins(self, inputs: Floats32) -> Floats:
        if not len(inputs):
            return np.empty(0)
        values = logits(self.network, inputs)
        margins: Floats = values[:, 1] - values[:, 0]
        return margins

    def margin_graph(self, input_name: str) -> onnx.ModelProto:
        network = for_margin(self.network)
        return graphs.from_torch(network, self.shape, input_name, graphs.MARGIN_NAME)

    def to_onnx(self, temperature: float, input_name: str) -> onnx.ModelProto:
        network = for_inference(self.network, temperature)
        return graphs.from_torch(network, self.shape, input_name, OUTPUT_NAME)


@dataclass(frozen=True, slots=True, eq=False)
class FittedBlend(Fitted):
    """Weighted sum of the margins of trained members."""

    members: tuple[FittedNetwork | FittedClassical, ...]
    factors: tuple[float, ...]
    """Factor of each member's margin."""

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
    """Training mean, in the shape of an input."""
    scale: Floats32
    """One over the training spread, in the shape of an input; 0 for a constant value."""

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


def _fit_single(
    estimator: NetworkConfig | ClassicalConfig,
    recipe: AnyRecipe | None,
    inputs: Floats32,
    slipped: Bools,
    seed: int,
) -> FittedNetwork | FittedClassical:
    if not isinstance(estimator, NetworkConfig):
        return fit_classical(estimator, inputs, slipped, seed)
    if recipe is None:
        raise ValueError("a network needs a recipe")
    network = train_network(estimator, inputs, slipped, recipe, seed=seed)
    return FittedNetwork(network, inputs.shape[1:])


def _fit_blend(blend: BlendConfig, inputs: Floats32, slipped: Bools, seed: int) -> FittedBlend:
    copies = [member for member in blend.members for _ in range(member.copies)]
    seeds: Sequence[int] = np.random.SeedSequence(seed).generate_state(len(copies)).tolist()
    total = sum(member.weight for member in blend.members)
    members, factors = [], []
    for member, member_seed in zip(copies, seeds, strict=True):
        fitted = _fit_single(member.estimator, member.recipe, inputs, slipped, member_seed)
        spread = float(fitted.margins(inputs).std())
        members.append(fitted)
        # A member with the same margin for all grasps has learnt nothing, and gets no weight.
        share = member.weight / (member.copies * total)
        factors.append(share / spread if spread > 0.0 else 0.0)
    return FittedBlend(tuple(members), tuple(factors))


def augment(
    images: Floats32, slipped: Bools, augmentation: Augmentation, seed: int
) -> tuple[Floats32, Bools]:
    """Return four times the images (N, height, width, fingers) and labels (N,).

    The order is: unchanged, flipped left-right, flipped up-down, rotated. A rotated image keeps its
    size, and pixels from outside repeat the nearest edge. Raises `ValueError` if `images` has
    another shape.
    """
    if images.ndim != 4:
        raise ValueError(f"only images can be flipped and rotated, not inputs {images.shape[1:]}")
    left = np.random.default_rng(seed).integers(2, size=len(images)).astype(np.bool_)
    rotated, angle = np.empty_like(images), augmentation.rotation_deg
    for chosen, turn in ((left, angle), (~left, -angle)):
        rotated[chosen] = rotate(images[chosen], turn, axes=(2, 1), reshape=False, mode="nearest")
    return (
        np.concatenate((images, images[:, :, ::-1], images[:, ::-1], rotated)),
        np.tile(slipped, 4),
    )
