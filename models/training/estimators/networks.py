"""PyTorch networks: built from a configuration, trained, and folded for a model file."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.utils.fusion import fuse_conv_bn_eval, fuse_linear_bn_eval

from graspd.biotac import ELECTRODES
from graspd.models.contract import FEATURES_PER_FINGER
from graspd.models.layout import D1
from graspd.models.tactile_image import Fill, fill_matrix
from graspd.models.training.arrays import Bools, Floats, Floats32
from graspd.models.training.estimators.configs import (
    THREADS,
    AnyRecipe,
    DayShift,
    NetworkConfig,
    PublishedRecipe,
    Recipe,
    SessionRecipe,
)

IMAGE_SHAPE = (12, 11, 3)
"""Height, width, fingers of the D1 image."""
KERNEL = 3
"""Side of the first convolution, pixels."""
POOL = 2
"""Side and stride of a maximum pooling, pixels."""
NORM_EPSILON = 1e-3
"""Keras' default: the published networks were trained with it."""
INFERENCE_BATCH = 512
"""Most inputs of a forward pass; it only limits memory."""
KERAS_ADAM_EPSILON = 1e-8
"""Epsilon of Adam in Keras 2.0.8, which trained the published networks."""


class ChannelsFirst(nn.Module):
    """Layer from images (N, height, width, fingers), as in the daemon, to (N, fingers, ...)."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return images.permute(0, 3, 1, 2)


class FeatureImages(nn.Module):
    """Layer from electrodes (N, fingers * 24) to D1 images (N, fingers, 12, 11)."""

    fill: torch.Tensor

    def __init__(self, fingers: int) -> None:
        super().__init__()
        matrix = fill_matrix(D1, Fill.NEIGHBOUR_MEAN)[:, :ELECTRODES]
        self.register_buffer("fill", torch.tensor(matrix.T, dtype=torch.float32))
        self._fingers = fingers

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        pixels = values.reshape(-1, self._fingers, ELECTRODES) @ self.fill
        return pixels.reshape(-1, self._fingers, *D1.shape)


class Beside(nn.Module):
    """Module that passes the first features through layers and appends the rest."""

    def __init__(self, look: nn.Sequential, first: int) -> None:
        super().__init__()
        self.look = look
        self.first = first

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return features (N, M) as (N, seen + M - first); `seen`: outputs of the layers."""
        seen = self.look(features[:, : self.first])
        return torch.cat((seen, features[:, self.first :]), dim=1)


def build(config: NetworkConfig, shape: Sequence[int] = IMAGE_SHAPE) -> nn.Sequential:
    """Return a network with new weights from torch's global random state.

    It takes float32 inputs (N, *shape), images or features, and returns logits (N, 2) in the order
    (stable, slip). Weights are Glorot-uniform and biases zero, as Keras starts them. Raises
    `ValueError` if the network does not fit the shape.
    """
    look = _look(config, tuple(shape))
    try:
        width = nn.Sequential(*look).eval()(torch.zeros(1, *shape)).shape[1]
    except RuntimeError as error:
        raise ValueError(f"inputs {tuple(shape)} are too small for the network") from error
    dense = [nn.Linear(width, config.hidden), nn.ReLU()]
    if config.batch_norm:
        dense.insert(1, nn.BatchNorm1d(config.hidden, eps=NORM_EPSILON))
    drop = [nn.Dropout(config.dropout)] if config.dropout > 0.0 else []
    network = nn.Sequential(*look, *drop, *dense, *drop, nn.Linear(config.hidden, 2)).train()
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    return network


@contextmanager
def reproducible(seed: int, threads: int = THREADS) -> Iterator[None]:
    """Seed torch, fix its threads, and allow only deterministic algorithms within the block."""
    threads_before = torch.get_num_threads()
    deterministic_before = torch.are_deterministic_algorithms_enabled()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        torch.use_deterministic_algorithms(True)
        torch.set_num_threads(threads)
        try:
            yield
        finally:
            torch.set_num_threads(threads_before)
            torch.use_deterministic_algorithms(deterministic_before)


def train_network(
    config: NetworkConfig,
    inputs: Floats32,
    slipped: Bools,
    recipe: AnyRecipe,
    *,
    seed: int,
) -> nn.Sequential:
    """Train a network on inputs (N, *shape) and labels (N,), True for a slip; return it in
    evaluation mode.

    The same arguments give the same weights on the same machine. Each epoch sees each
    grasp at most once, shuffled; a short last batch may be left out. Raises `ValueError` for fewer
    than two grasps.
    """
    if len(inputs) < 2:
        raise ValueError(f"cannot train on {len(inputs)} grasps")
    slip = torch.from_numpy(slipped.astype(np.float32))
    with reproducible(seed, recipe.threads):
        network = build(config, inputs.shape[1:]).train()
        for layer in network.modules():
            if isinstance(layer, _BatchNorm):
                layer.momentum = recipe.norm_momentum
        targets = torch.stack((1.0 - slip, slip), dim=1)
        _fit(network, torch.from_numpy(inputs), targets, recipe)
        return network.eval()


def logits(network: nn.Module, inputs: Floats32) -> Floats:
    """Return the logits (N, 2), in the order (stable, slip), of inputs (N, *shape)."""
    batches = torch.split(torch.from_numpy(inputs), INFERENCE_BATCH)
    with reproducible(0), torch.no_grad():
        return torch.cat([network(batch) for batch in batches]).double().numpy()


def on_another_day(features: torch.Tensor, shift: DayShift) -> torch.Tensor:
    """Shift standardised session features (N, fingers * 26) as they may be on another day.

    Each grasp is shifted by a draw of its own, from torch's global random state; `features` do
    not change. Raises `ValueError` if these are not session features.
    """
    if features.ndim != 2 or features.shape[1] % FEATURES_PER_FINGER:
        raise ValueError(f"inputs {tuple(features.shape[1:])} are not session features")
    grasps, width = features.shape
    fingers = width // FEATURES_PER_FINGER
    electrodes = fingers * ELECTRODES
    exponent = shift.gain * torch.randn(grasps, width)
    of_finger = shift.finger_gain * torch.randn(grasps, fingers)
    exponent[:, :electrodes] += of_finger.repeat_interleave(ELECTRODES, dim=1)
    shifted = features * exponent.exp()
    shifted[:, electrodes:] += shift.offset * torch.randn(grasps, width - electrodes)
    return shifted


def optimization(
    network: nn.Sequential, recipe: AnyRecipe, steps: int
) -> tuple[torch.optim.Optimizer, torch.optim.lr_scheduler.LRScheduler]:
    """Return optimizer and schedule of a recipe. `steps`: batches of an epoch."""
    weights = [parameter for parameter in network.parameters() if parameter.ndim > 1]
    others = [parameter for parameter in network.parameters() if parameter.ndim <= 1]
    optimizer: torch.optim.Optimizer
    match recipe:
        case Recipe():
            optimizer = torch.optim.AdamW(
                [
                    {"params": weights, "weight_decay": recipe.weight_decay},
                    {"params": others, "weight_decay": 0.0},
                ],
                lr=recipe.peak_learning_rate,
                fused=True,
            )
            return optimizer, torch.optim.lr_scheduler.OneCycleLR(
                optimizer,
                recipe.peak_learning_rate,
                total_steps=recipe.epochs * steps,
                pct_start=recipe.warm_up,
            )
        case PublishedRecipe():
            # Adam adds weight_decay * w to the gradient: the gradient of l2 * w**2 is 2 * l2 * w.
            optimizer = torch.optim.Adam(
                [
                    {"params": weights[:-1], "weight_decay": 2.0 * recipe.l2},
                    {"params": [weights[-1], *others], "weight_decay": 0.0},
                ],
                lr=recipe.learning_rate,
                eps=KERAS_ADAM_EPSILON,
                fused=True,
            )
            return optimizer, torch.optim.lr_scheduler.LambdaLR(
                optimizer, lambda update: 1.0 / (1.0 + recipe.decay * update)
            )


def for_inference(network: nn.Sequential, temperature: float) -> nn.Sequential:
    """Return a copy that gives calibrated probabilities (N, 2).

    Batch norm is folded into the layer before it, and the temperature into the last layer. A linear
    layer divided by T gives `softmax(logits / T)`.
    """
    layers, last = _split(network)
    with torch.no_grad():
        last.weight.div_(temperature)
        last.bias.div_(temperature)
    return nn.Sequential(*layers, last, nn.Softmax(dim=1)).eval()


def for_margin(network: nn.Sequential) -> nn.Sequential:
    """Return a copy that gives log-odds of slip (N, 1), folded like `for_inference`."""
    layers, last = _split(network)
    margin = nn.Linear(last.in_features, 1)
    with torch.no_grad():
        margin.weight.copy_(last.weight[1:] - last.weight[:1])
        margin.bias.copy_(last.bias[1:] - last.bias[:1])
    return nn.Sequential(*layers, margin).eval()


def _fit(
    network: nn.Sequential, inputs: torch.Tensor, targets: torch.Tensor, recipe: AnyRecipe
) -> None:
    batches = _batches(len(inputs), recipe)
    optimizer, schedule = optimization(network, recipe, len(batches))
    loss = nn.CrossEntropyLoss(label_smoothing=recipe.label_smoothing)
    for _ in range(recipe.epochs):
        order = torch.randperm(len(inputs))
        for batch in batches:
            chosen = order[batch]
            seen = inputs[chosen]
            if isinstance(recipe, SessionRecipe):
                seen = on_another_day(seen, recipe.day_shift)
            if recipe.input_noise > 0.0:
                seen = seen + recipe.input_noise * torch.randn(seen.shape)
            optimizer.zero_grad()
            loss(network(seen), targets[chosen]).backward()
            optimizer.step()
            schedule.step()


def _batches(grasps: int, recipe: AnyRecipe) -> Sequence[slice]:
    """Return an epoch's slices of the shuffled order, one per batch, the last if long enough."""
    batch = min(recipe.batch, grasps)
    # A batch norm cannot be trained on a single grasp. Keras uses any larger remainder.
    least = batch if isinstance(recipe, Recipe) else 2
    starts = range(0, grasps, batch)
    return [slice(start, start + batch) for start in starts if grasps - start >= least]


def _look(config: NetworkConfig, shape: tuple[int, ...]) -> list[nn.Module]:
    """Return the layers from the input to the hidden layer's inputs."""
    if len(shape) == 3:
        return [ChannelsFirst(), *_convolutions(config, shape[2])]
    (features,) = shape
    fingers, extra = divmod(features, FEATURES_PER_FINGER)
    if extra:
        fingers, extra = divmod(features, ELECTRODES)
    if extra:
        raise ValueError(f"{features} features are not those of whole fingers")
    layers = [FeatureImages(fingers), *_convolutions(config, fingers)]
    first = fingers * ELECTRODES
    return layers if first == features else [Beside(nn.Sequential(*layers), first)]


def _convolutions(config: NetworkConfig, channels: int) -> list[nn.Module]:
    layers = _convolution(channels, config.filters, KERNEL, config.batch_norm)
    if config.pool:
        layers.append(nn.MaxPool2d(POOL))
    if config.second is not None:
        second = config.second
        layers += _convolution(config.filters, second.filters, second.kernel, config.batch_norm)
    return [*layers, nn.Flatten()]


def _convolution(inputs: int, filters: int, kernel: int, batch_norm: bool) -> list[nn.Module]:
    norm = [nn.BatchNorm2d(filters, eps=NORM_EPSILON)] if batch_norm else []
    return [nn.Conv2d(inputs, filters, kernel, bias=not batch_norm), *norm, nn.ReLU()]


def _folded(network: nn.Sequential) -> list[nn.Module]:
    """Return the layers without batch norm (folded) and dropout. Changes `network`."""
    layers: list[nn.Module] = []
    for layer in network:
        if isinstance(layer, nn.BatchNorm2d) and isinstance(layers[-1], nn.Conv2d):
            layers[-1] = fuse_conv_bn_eval(layers[-1], layer)
        elif isinstance(layer, nn.BatchNorm1d) and isinstance(layers[-1], nn.Linear):
            layers[-1] = fuse_linear_bn_eval(layers[-1], layer)
        elif isinstance(layer, Beside):
            layers.append(Beside(nn.Sequential(*_folded(layer.look)), layer.first))
        elif not isinstance(layer, nn.Dropout):
            layers.append(layer)
    return layers


def _split(network: nn.Sequential) -> tuple[list[nn.Module], nn.Linear]:
    """Return a copy for inference as two parts: the folded layers, and the last layer."""
    *layers, last = _folded(copy.deepcopy(network).eval())
    if not isinstance(last, nn.Linear):
        raise TypeError(f"a network ends in a linear layer, not {type(last).__name__}")
    return layers, last
