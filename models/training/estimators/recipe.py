"""Train a network, by one-cycle AdamW or as published; seeded, on fixed threads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm

from graspd.models.contract import FEATURES_PER_FINGER
from graspd.models.layout import ELECTRODES
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
from graspd.models.training.estimators.networks import build

INFERENCE_BATCH = 512
"""Most inputs of a forward pass; it limits memory and changes nothing else."""
KERAS_ADAM_EPSILON = 1e-8
"""Epsilon of Adam in Keras 2.0.8, which trained the published networks."""


@contextmanager
def reproducible(seed: int, threads: int = THREADS) -> Iterator[None]:
    """Seed torch, fix its threads, and allow only deterministic algorithms, until the end."""
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
    slipped: Bools | Floats,
    recipe: AnyRecipe,
    *,
    seed: int,
) -> nn.Sequential:
    """Train a network on inputs (N, *shape) and labels (N,); return it in evaluation mode.

    The same arguments give the same weights on the same machine. Each epoch sees the grasps once,
    shuffled. Raises `ValueError` for less than two grasps.
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
    not change. Raises `ValueError` if these are no session features.
    """
    if features.ndim != 2 or features.shape[1] % FEATURES_PER_FINGER:
        raise ValueError(f"inputs {tuple(features.shape[1:])} are no session features")
    grasps, width = features.shape
    fingers = width // FEATURES_PER_FINGER
    electrodes = fingers * ELECTRODES
    exponent = shift.gain * torch.randn(grasps, width)
    of_finger = shift.finger_gain * torch.randn(grasps, fingers)
    exponent[:, :electrodes] += of_finger.repeat_interleave(ELECTRODES, dim=1)
    shifted = features * exponent.exp()
    shifted[:, electrodes:] += shift.offset * torch.randn(grasps, width - electrodes)
    return shifted


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


def _batches(grasps: int, recipe: AnyRecipe) -> Sequence[slice]:
    """Return the slices of an epoch's shuffled order, one per batch."""
    batch = min(recipe.batch, grasps)
    # A batch norm cannot be trained on a single grasp; Keras takes any other remainder.
    least = batch if isinstance(recipe, Recipe) else 2
    starts = range(0, grasps, batch)
    return [slice(start, start + batch) for start in starts if grasps - start >= least]
