"""Classifiers of scikit-learn on vectors and features, with the grids they were chosen from."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier, RandomForestClassifier
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPClassifier
from sklearn.svm import SVC
from threadpoolctl import threadpool_limits

from models.training.arrays import Bools, Floats, Floats32

PROBABILITY_FLOOR = 1e-3
"""A forest's probability is kept this far from 0 and 1, where its log-odds are infinite."""


class Boosting(HistGradientBoostingClassifier):  # type: ignore[misc]  # scikit-learn has no types
    """Gradient boosting that shows what it consists of."""

    @property
    def trees(self) -> list[NDArray[np.void]]:
        """Nodes of each tree, as scikit-learn keeps them."""
        return [predictor.nodes for (predictor,) in self._predictors]

    @property
    def base(self) -> float:
        """Margin before the first tree."""
        return float(self._baseline_prediction.item())


@dataclass(frozen=True, slots=True)
class SvmConfig:
    """Support vector machine with a radial kernel, classes weighted to balance."""

    c: float
    gamma: float | Literal["auto"]
    """Of the kernel exp(-gamma * distance**2); auto: one over the number of features."""

    @staticmethod
    def grid() -> list[SvmConfig]:
        """The paper's: C in 0.01..5000, gamma auto or in 1e-4..0.1."""
        costs = (0.01, 0.1, 1.0, 3.0, 10.0, 100.0, 1000.0, 5000.0)
        gammas: tuple[float | Literal["auto"], ...] = ("auto", 1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1)
        return [SvmConfig(c, gamma) for c, gamma in product(costs, gammas)]


@dataclass(frozen=True, slots=True)
class ForestConfig:
    """Random forest."""

    trees: int
    depth: int | None
    """Largest depth of a tree; None: until its leaves are pure."""

    @staticmethod
    def grid() -> list[ForestConfig]:
        """The paper's: 10..200 trees, depth none or 5..30. Odd numbers of trees cannot tie."""
        return [
            ForestConfig(trees, depth)
            for trees, depth in product((11, 25, 51, 101, 199), (None, 5, 10, 15, 20, 30))
        ]


@dataclass(frozen=True, slots=True)
class MlpConfig:
    """Multi-layer perceptron: ReLU, Adam, a fixed number of epochs."""

    hidden: tuple[int, ...]
    """Units of each hidden layer."""
    alpha: float = 1e-4
    """L2 term."""
    learning_rate: float = 1e-3
    epochs: int = 100

    @staticmethod
    def grid() -> list[MlpConfig]:
        """One or two hidden layers around the width of the input; the paper gives no grid."""
        hidden = ((32,), (100,), (300,), (64, 32), (100, 100))
        return [MlpConfig(units, alpha) for units, alpha in product(hidden, (1e-4, 0.1, 1.0))]


@dataclass(frozen=True, slots=True)
class BoostingConfig:
    """Gradient boosting on histograms."""

    iterations: int = 300
    learning_rate: float = 0.1
    leaves: int = 31
    """Largest number of leaves of a tree."""
    leaf_grasps: int = 20
    """Fewest grasps in a leaf."""
    l2: float = 0.0
    features: float = 1.0
    """Fraction of the features that a split may choose from."""

    @staticmethod
    def grid() -> list[BoostingConfig]:
        """Our own: the paper has no boosting."""
        return [
            BoostingConfig(iterations, rate, leaves, features=features)
            for (iterations, rate), leaves, features in product(
                ((150, 0.1), (400, 0.05)), (8, 15, 31), (0.3, 1.0)
            )
        ]


ClassicalConfig = SvmConfig | ForestConfig | MlpConfig | BoostingConfig


class ClassicalModel(Protocol):
    """A classifier of scikit-learn: one of those that `fit_classical` makes."""

    n_features_in_: int

    def fit(self, inputs: Floats32, slipped: Bools) -> object:
        """Fit to inputs (N, M) and labels (N,)."""


def fit_classical(
    config: ClassicalConfig, inputs: Floats32, slipped: Bools, seed: int
) -> ClassicalModel:
    """A classifier fitted to inputs (N, M) and labels (N,), on one thread.

    Raises `ValueError` if the inputs are no vectors or a class is missing.
    """
    if inputs.ndim != 2:
        raise ValueError(f"takes vectors, not inputs {inputs.shape[1:]}")
    if len(np.unique(slipped)) != 2:
        raise ValueError("cannot train on grasps of one class")
    model = _model(config, seed)
    with _one_thread():
        model.fit(inputs, slipped)
    return model


def classical_margins(model: ClassicalModel, inputs: Floats32) -> Floats:
    """Log-odds of slip (N,), up to a temperature, of inputs (N, M)."""
    if not len(inputs):
        return np.empty(0)
    with _one_thread():
        match model:
            case SVC() | Boosting():
                margins: Floats = model.decision_function(inputs)
            case MLPClassifier():
                margins = _mlp_margins(model, inputs)
            case RandomForestClassifier():
                slip = model.predict_proba(inputs)[:, 1]
                slip = slip.clip(PROBABILITY_FLOOR, 1.0 - PROBABILITY_FLOOR)
                margins = np.log(slip / (1.0 - slip))
            case _:
                raise TypeError(f"no classifier of this module: {type(model).__name__}")
    return margins


def classical_size(model: ClassicalModel) -> int:
    """How many numbers the fitted model consists of: weights, support vectors, or tree nodes."""
    match model:
        case SVC():
            return int(model.support_vectors_.size + model.dual_coef_.size + 1)
        case MLPClassifier():
            return sum(int(part.size) for part in (*model.coefs_, *model.intercepts_))
        case RandomForestClassifier():
            return sum(int(tree.tree_.node_count) for tree in model.estimators_)
        case Boosting():
            return sum(map(len, model.trees))
        case _:
            raise TypeError(f"no classifier of this module: {type(model).__name__}")


def _model(config: ClassicalConfig, seed: int) -> ClassicalModel:
    model: ClassicalModel
    match config:
        case SvmConfig():
            model = SVC(C=config.c, gamma=config.gamma, class_weight="balanced")
        case ForestConfig():
            model = RandomForestClassifier(
                n_estimators=config.trees, max_depth=config.depth, random_state=seed
            )
        case MlpConfig():
            model = MLPClassifier(
                hidden_layer_sizes=config.hidden,
                alpha=config.alpha,
                learning_rate_init=config.learning_rate,
                max_iter=config.epochs,
                n_iter_no_change=config.epochs,
                random_state=seed,
            )
        case BoostingConfig():
            model = Boosting(
                max_iter=config.iterations,
                learning_rate=config.learning_rate,
                max_leaf_nodes=config.leaves,
                min_samples_leaf=config.leaf_grasps,
                l2_regularization=config.l2,
                max_features=config.features,
                early_stopping=False,
                random_state=seed,
            )
    return model


def _mlp_margins(model: MLPClassifier, inputs: Floats32) -> Floats:
    """The output layer before its logistic function, which would lose the large ones."""
    values = inputs.astype(np.float64)
    for weights, bias in zip(model.coefs_[:-1], model.intercepts_[:-1], strict=True):
        values = np.maximum(values @ weights + bias, 0.0)
    margins: Floats = (values @ model.coefs_[-1] + model.intercepts_[-1])[:, 0]
    return margins


@contextmanager
def _one_thread() -> Iterator[None]:
    """Sums over more threads round differently."""
    with threadpool_limits(1), warnings.catch_warnings():
        # A perceptron's number of epochs is a setting here, not a failure to converge.
        warnings.filterwarnings("ignore", category=ConvergenceWarning)
        yield
