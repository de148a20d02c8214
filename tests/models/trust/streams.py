"""Lifts made up for the learner, and their outcomes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from graspd.models.trust.learner import Learner, sigmoid

CLIP = 3.0
Outcome = tuple[float, NDArray[np.float32], bool]
"""Margin, inputs, whether it slipped."""


def lifts(
    number: int, inputs: int, seed: int = 0, strength: float = 0.6, spread: float = 1.0
) -> Iterator[Outcome]:
    """Yield margin, inputs and outcome of lifts, drawn by a logistic model of margin and inputs.

    `number`: of lifts. `inputs`: of each. `strength`: size of the model's weights. `spread`:
    standard deviation of the inputs.
    """
    random = np.random.default_rng(seed)
    weights = random.normal(0.0, strength / math.sqrt(inputs), inputs)
    for _ in range(number):
        x = np.clip(random.normal(0.0, spread, inputs), -CLIP, CLIP).astype(np.float32)
        margin = float(random.normal(0.0, 2.0))
        slipped = random.random() < sigmoid(0.4 * margin - 0.5 + 2.0 * float(x @ weights))
        yield margin, x, bool(slipped)


def learn(learner: Learner, stream: Iterable[Outcome]) -> None:
    for margin, x, slipped in stream:
        learner.learn(learner.judge(margin, x)[1], slipped=slipped)
