"""Classifiers of scikit-learn on vectors and features, and their ONNX graphs."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper
from skl2onnx import to_onnx
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
from graspd.models.training.estimators.graphs import (
    DOUBLE,
    FLOAT,
    MARGIN_NAME,
    ML_OPSET,
    OPSET,
    Fitted,
    constant,
    feed,
    nodes_of,
    vector_model,
)

PROBABILITY_FLOOR = 1e-3
"""Smallest distance of a forest's probability from 0 and 1, so that log-odds are finite."""
INTERRUPTED = "Training interrupted"
"""Start of scikit-learn's warning that Ctrl-C ended the training of a perceptron."""


class Boosting(HistGradientBoostingClassifier):  # type: ignore[misc]  # scikit-learn has no types
    """Gradient boosting with access to its trees."""

    @property
    def trees(self) -> list[NDArray[np.void]]:
        """Return the nodes of each tree, in scikit-learn's format."""
        return [predictor.nodes for (predictor,) in self._predictors]

    @property
    def base(self) -> float:
        """Return the margin before the first tree."""
        return float(self._baseline_prediction.item())


ClassicalModel: TypeAlias = SVC | RandomForestClassifier | MLPClassifier | Boosting


@dataclass(frozen=True, slots=True, eq=False)
class FittedClassical(Fitted):
    """A fitted classifier; `parameters` are weights, support vectors' values or tree nodes."""

    model: ClassicalModel

    @property
    def parameters(self) -> int:
        match self.model:
            case SVC() as model:
                return int(model.support_vectors_.size + model.dual_coef_.size + 1)
            case MLPClassifier() as model:
                return sum(int(part.size) for part in (*model.coefs_, *model.intercepts_))
            case Boosting() as model:
                return sum(map(len, model.trees))
            case model:
                return sum(int(tree.tree_.node_count) for tree in model.estimators_)

    def margins(self, inputs: Floats32) -> Floats:
        if not len(inputs):
            return np.empty(0)
        with _one_thread():
            match self.model:
                case SVC() | Boosting() as model:
                    margins: Floats = model.decision_function(inputs)
                case MLPClassifier() as model:
                    margins = _mlp_margins(model, inputs)
                case model:
                    slip = model.predict_proba(inputs)[:, 1]
                    slip = slip.clip(PROBABILITY_FLOOR, 1.0 - PROBABILITY_FLOOR)
                    margins = np.log(slip / (1.0 - slip))
        return margins

    def margin_graph(self, input_name: str) -> onnx.ModelProto:
        match self.model:
            case SVC() as model:
                return _svm(model, input_name)
            case MLPClassifier() as model:
                return _perceptron(model, input_name)
            case Boosting() as model:
                return _boosting(model, input_name)
            case model:
                return _forest(model, input_name)


def fit_classical(
    config: ClassicalConfig, inputs: Floats32, slipped: Bools, seed: int
) -> FittedClassical:
    """Fit a classifier to inputs (N, M) and labels (N,), on one thread.

    Raises `ValueError` if the inputs are not vectors or a class is missing.
    """
    if inputs.ndim != 2:
        raise ValueError(f"takes vectors, not inputs {inputs.shape[1:]}")
    if len(np.unique(slipped)) != 2:
        raise ValueError("cannot train on grasps of one class")
    model = _model(config, seed)
    with _one_thread():
        model.fit(inputs, slipped)
    return FittedClassical(model)


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
    """Return a perceptron's log-odds of slip (N,), not from probabilities, which saturate."""
    values = inputs.astype(np.float64)
    for weights, bias in zip(model.coefs_[:-1], model.intercepts_[:-1], strict=True):
        values = np.maximum(values @ weights + bias, 0.0)
    margins: Floats = (values @ model.coefs_[-1] + model.intercepts_[-1])[:, 0]
    return margins


@contextmanager
def _one_thread() -> Iterator[None]:
    """Limit libraries to one thread, because sums over more threads round differently.
    Raises `KeyboardInterrupt` on Ctrl-C also where scikit-learn only warns."""
    with threadpool_limits(1), warnings.catch_warnings():
        # The warning that a perceptron did not converge: its number of epochs is a setting here.
        warnings.filterwarnings("ignore", category=ConvergenceWarning)
        # On Ctrl-C a perceptron ends its training and only warns.
        warnings.filterwarnings("error", message=INTERRUPTED, category=UserWarning)
        try:
            yield
        except UserWarning as warning:
            if str(warning).startswith(INTERRUPTED):
                raise KeyboardInterrupt from warning
            raise


def _svm(model: SVC, input_name: str) -> onnx.ModelProto:
    """Return the graph of a support vector machine in double precision.

    ONNX's own SVMClassifier sums in float32; with large C its margins are wrong by over 0.01.
    """
    vectors = model.support_vectors_
    features = vectors.shape[1]
    gamma = float(model.gamma)
    # -gamma * |x - v|**2 = 2 gamma x.v - gamma |v|**2 - gamma |x|**2
    constants = [
        # Support vectors are inputs of the training, which are float32, so nothing is lost.
        constant("vectors", vectors.T.astype(np.float32)),
        constant("two_gamma", np.array(2.0 * gamma)),
        constant("minus_gamma", np.array(-gamma)),
        constant("vector_part", -gamma * np.square(vectors).sum(axis=1)),
        constant("weights", model.dual_coef_.reshape(-1, 1).astype(np.float64)),
        constant("bias", model.intercept_.astype(np.float64)),
        constant("axis", np.array([1])),
    ]
    nodes = nodes_of(
        f"x_64 = Cast <to: int = {DOUBLE}> ({input_name})",
        f"vectors_64 = Cast <to: int = {DOUBLE}> (vectors)",
        "products = MatMul (x_64, vectors_64)",
        "both_part = Mul (products, two_gamma)",
        "squares = ReduceSumSquare <keepdims: int = 1> (x_64, axis)",
        "x_part = Mul (squares, minus_gamma)",
        "without_x = Add (both_part, vector_part)",
        "exponent = Add (without_x, x_part)",
        "kernel = Exp (exponent)",
        "weighted = MatMul (kernel, weights)",
        "decision = Add (weighted, bias)",
        f"{MARGIN_NAME} = Cast <to: int = {FLOAT}> (decision)",
    )
    return vector_model(nodes, constants, input_name, features)


def _boosting(model: Boosting, input_name: str) -> onnx.ModelProto:
    """Return boosted trees as one TreeEnsembleRegressor; skl2onnx 1.20 fails with onnx 1.23."""
    trees = model.trees
    of_tree = np.repeat(np.arange(len(trees)), [len(tree) for tree in trees])
    of_node = np.concatenate([np.arange(len(tree)) for tree in trees])
    nodes = np.concatenate(trees)
    leaf = nodes["is_leaf"].astype(np.bool_)
    node = helper.make_node(
        "TreeEnsembleRegressor",
        [input_name],
        [MARGIN_NAME],
        domain="ai.onnx.ml",
        n_targets=1,
        aggregate_function="SUM",
        base_values=[model.base],
        nodes_treeids=of_tree.tolist(),
        nodes_nodeids=of_node.tolist(),
        nodes_modes=np.where(leaf, "LEAF", "BRANCH_LEQ").tolist(),
        nodes_featureids=np.where(leaf, 0, nodes["feature_idx"]).tolist(),
        nodes_values=np.where(leaf, 0.0, _float32_below(nodes["num_threshold"])).tolist(),
        nodes_truenodeids=np.where(leaf, 0, nodes["left"]).tolist(),
        nodes_falsenodeids=np.where(leaf, 0, nodes["right"]).tolist(),
        target_treeids=of_tree[leaf].tolist(),
        target_nodeids=of_node[leaf].tolist(),
        target_ids=[0] * int(leaf.sum()),
        target_weights=nodes["value"][leaf].tolist(),
    )
    return vector_model([node], [], input_name, model.n_features_in_)


def _float32_below(thresholds: Floats) -> Floats32:
    """Return the largest float32 not above each threshold, so that comparisons agree."""
    nearest = thresholds.astype(np.float32)
    return np.where(nearest > thresholds, np.nextafter(nearest, np.float32(-np.inf)), nearest)


def _forest(model: RandomForestClassifier, input_name: str) -> onnx.ModelProto:
    """Return a forest's graph. Trees add whole votes: shares such as 1/199 would be rounded."""
    (trees,) = _from_sklearn(model, input_name).graph.node
    number = len(model.estimators_)
    (weights,) = (part for part in trees.attribute if part.name == "class_weights")
    weights.floats[:] = np.array(weights.floats) * number
    nodes = nodes_of(
        "votes = Gather <axis: int = 1> (probabilities, slip_column)",
        f"votes_64 = Cast <to: int = {DOUBLE}> (votes)",
        "p = Div (votes_64, trees)",
        "p_slip = Clip (p, floor, ceiling)",
        "p_stable = Sub (one, p_slip)",
        "odds = Div (p_slip, p_stable)",
        "log_odds = Log (odds)",
        f"{MARGIN_NAME} = Cast <to: int = {FLOAT}> (log_odds)",
    )
    constants = [
        constant("slip_column", np.array([1])),
        constant("trees", np.array(float(number))),
        constant("floor", np.array(PROBABILITY_FLOOR)),
        constant("ceiling", np.array(1.0 - PROBABILITY_FLOOR)),
        constant("one", np.array(1.0)),
    ]
    return vector_model([trees, *nodes], constants, input_name, model.n_features_in_)


def _perceptron(model: MLPClassifier, input_name: str) -> onnx.ModelProto:
    """Return a perceptron's graph without its last logistic function, which would saturate."""
    graph = _from_sklearn(model, input_name).graph
    kinds = [node.op_type for node in graph.node]
    nodes = list(graph.node[: kinds.index("Sigmoid")])
    nodes[-1].output[0] = MARGIN_NAME
    used = {name for node in nodes for name in node.input}
    constants = [tensor for tensor in graph.initializer if tensor.name in used]
    return vector_model(nodes, constants, input_name, model.n_features_in_)


def _from_sklearn(model: ClassicalModel, input_name: str) -> onnx.ModelProto:
    """Return a classifier as ONNX, with the outputs `label` and `probabilities` (N, 2)."""
    converted: onnx.ModelProto = to_onnx(
        model,
        np.zeros((1, model.n_features_in_), dtype=np.float32),
        target_opset={"": OPSET, "ai.onnx.ml": ML_OPSET},
        options={id(model): {"zipmap": False}},
    )
    feed(converted.graph, converted.graph.input[0].name, input_name)
    return converted
