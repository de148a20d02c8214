"""Classifiers of scikit-learn on vectors and features."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier, RandomForestClassifier
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPClassifier
from sklearn.svm import SVC
from threadpoolctl import threadpool_limits

from graspd.models.training.arrays import Bools, Floats, Floats32
from graspd.models.training.estimators.configs import (
    BoostingConfig,
    ClassicalConfig,
    ForestConfig,
    MlpConfig,
    SvmConfig,
)

PROBABILITY_FLOOR = 1e-3
"""Distance of a forest's probability from 0 and 1, where its log-odds are infinite."""
INTERRUPTED = "Training interrupted"
"""Start of scikit-learn's warning that Ctrl-C ended the training of a perceptron."""


class Boosting(HistGradientBoostingClassifier):  # type: ignore[misc]  # scikit-learn has no types
    """Gradient boosting with access to its trees."""

    @property
    def trees(self) -> list[NDArray[np.void]]:
        """Nodes of each tree, as scikit-learn keeps them."""
        return [predictor.nodes for (predictor,) in self._predictors]

    @property
    def base(self) -> float:
        """Margin before the first tree."""
        return float(self._baseline_prediction.item())


ClassicalModel: TypeAlias = SVC | RandomForestClassifier | MLPClassifier | Boosting


def fit_classical(
    config: ClassicalConfig, inputs: Floats32, slipped: Bools, seed: int
) -> ClassicalModel:
    """Fit a classifier to inputs (N, M) and labels (N,), on one thread.

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
    """Return the log-odds of slip (N,), up to a temperature, of inputs (N, M)."""
    if not len(inputs):
        return np.empty(0)
    with _one_thread():
        match model:
            case SVC() | Boosting():
                margins: Floats = model.decision_function(inputs)
            case MLPClassifier():
                margins = _mlp_margins(model, inputs)
            case _:
                slip = model.predict_proba(inputs)[:, 1]
                slip = slip.clip(PROBABILITY_FLOOR, 1.0 - PROBABILITY_FLOOR)
                margins = np.log(slip / (1.0 - slip))
    return margins


def classical_size(model: ClassicalModel) -> int:
    """Return the number of weights, support vectors' values or tree nodes of a model."""
    match model:
        case SVC():
            return int(model.support_vectors_.size + model.dual_coef_.size + 1)
        case MLPClassifier():
            return sum(int(part.size) for part in (*model.coefs_, *model.intercepts_))
        case Boosting():
            return sum(map(len, model.trees))
        case _:
            return sum(int(tree.tree_.node_count) for tree in model.estimators_)


def _model(config: ClassicalConfig, seed: int) -> ClassicalModel:
    match config:
        case SvmConfig():
            return SVC(C=config.c, gamma=config.gamma, class_weight="balanced")
        case ForestConfig():
            return RandomForestClassifier(
                n_estimators=config.trees, max_depth=config.depth, random_state=seed
            )
        case MlpConfig():
            return MLPClassifier(
                hidden_layer_sizes=config.hidden,
                alpha=config.alpha,
                learning_rate_init=config.learning_rate,
                max_iter=config.epochs,
                n_iter_no_change=config.epochs,
                random_state=seed,
            )
        case BoostingConfig():
            return Boosting(
                max_iter=config.iterations,
                learning_rate=config.learning_rate,
                max_leaf_nodes=config.leaves,
                min_samples_leaf=config.leaf_grasps,
                l2_regularization=config.l2,
                max_features=config.features,
                early_stopping=False,
                random_state=seed,
            )


def _mlp_margins(model: MLPClassifier, inputs: Floats32) -> Floats:
    """Return the output before its logistic function, which would lose large margins."""
    values = inputs.astype(np.float64)
    for weights, bias in zip(model.coefs_[:-1], model.intercepts_[:-1], strict=True):
        values = np.maximum(values @ weights + bias, 0.0)
    margins: Floats = (values @ model.coefs_[-1] + model.intercepts_[-1])[:, 0]
    return margins


@contextmanager
def _one_thread() -> Iterator[None]:
    """Limit libraries to one thread, because sums over more threads round differently."""
    with threadpool_limits(1), warnings.catch_warnings():
        # A perceptron's number of epochs is a setting here, not a failure to converge.
        warnings.filterwarnings("ignore", category=ConvergenceWarning)
        # A perceptron takes Ctrl-C for the end of its training, and only warns.
        warnings.filterwarnings("error", message=INTERRUPTED, category=UserWarning)
        try:
            yield
        except UserWarning as warning:
            if str(warning).startswith(INTERRUPTED):
                raise KeyboardInterrupt from warning
            raise
