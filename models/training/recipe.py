"""How a network is trained: one-cycle AdamW, seeded, on a fixed number of threads."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from models.training.networks import NetworkConfig, build

THREADS = 2
"""Threads of a training. Fixed, because sums over more threads round differently."""
INFERENCE_BATCH = 512
"""Images per forward pass: bounds memory, changes nothing else."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """Settings of one training.

    Twenty epochs of one cycle stand for the paper's 300 epochs of Adam at a falling rate; the
    cross-validated F1 stays within the paper's spread.
    """

    epochs: int = 20
    batch: int = 32
    peak_learning_rate: float = 1e-3
    warm_up: float = 0.3
    """Fraction of the training in which the learning rate rises."""
    weight_decay: float = 0.5
    """Decoupled (times the learning rate in each step), on convolution and dense weights only;
    stands for the paper's L2 term."""
    threads: int = THREADS


Progress = Callable[[], None]
"""Called after each epoch."""


@contextmanager
def reproducible(seed: int, threads: int = THREADS) -> Iterator[None]:
    """Seed torch, allow deterministic algorithms only, and fix its threads; restore afterwards."""
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


def train(
    config: NetworkConfig,
    images: NDArray[np.float32],
    slipped: NDArray[np.bool_],
    recipe: Recipe,
    *,
    seed: int,
    on_epoch: Progress | None = None,
) -> nn.Sequential:
    """Train a network on images (N, 12, 11, 3) and labels (N,); returns it in evaluation mode.

    The same arguments give the same weights on the same machine. Each epoch sees every grasp once,
    shuffled, except the remainder of the last batch. Raises `ValueError` for less than two grasps.
    """
    if len(images) < 2:
        raise ValueError(f"cannot train on {len(images)} grasps")
    with reproducible(seed, recipe.threads):
        network = build(config).train()
        _fit(network, torch.from_numpy(images), torch.from_numpy(slipped).long(), recipe, on_epoch)
        return network.eval()


def logits(
    network: nn.Module, images: NDArray[np.float32], threads: int = THREADS
) -> NDArray[np.float64]:
    """Logits (N, 2), order (stable, slip), of images (N, 12, 11, 3)."""
    batches = torch.split(torch.from_numpy(images), INFERENCE_BATCH)
    with reproducible(0, threads), torch.no_grad():
        return torch.cat([network(batch) for batch in batches]).double().numpy()


def _fit(
    network: nn.Sequential,
    images: torch.Tensor,
    labels: torch.Tensor,
    recipe: Recipe,
    on_epoch: Progress | None,
) -> None:
    batch = min(recipe.batch, len(images))
    steps = len(images) // batch
    optimizer = _optimizer(network, recipe)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer,
        recipe.peak_learning_rate,
        total_steps=recipe.epochs * steps,
        pct_start=recipe.warm_up,
    )
    loss = nn.CrossEntropyLoss()
    for _ in range(recipe.epochs):
        order = torch.randperm(len(images))
        for chosen in torch.split(order[: steps * batch], batch):
            optimizer.zero_grad()
            loss(network(images[chosen]), labels[chosen]).backward()
            optimizer.step()
            schedule.step()
        if on_epoch is not None:
            on_epoch()


def _optimizer(network: nn.Sequential, recipe: Recipe) -> torch.optim.Optimizer:
    weights = [parameter for parameter in network.parameters() if parameter.ndim > 1]
    others = [parameter for parameter in network.parameters() if parameter.ndim <= 1]
    return torch.optim.AdamW(
        [
            {"params": weights, "weight_decay": recipe.weight_decay},
            {"params": others, "weight_decay": 0.0},
        ],
        lr=recipe.peak_learning_rate,
        fused=True,
    )
