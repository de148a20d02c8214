"""Decision trees of an ONNX file in float64 (operators of the domain ai.onnx.ml)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

DEPTH_MAX = 10_000
"""A tree that is deeper than this has a circle."""


class UnknownOperatorError(Exception):
    """The file holds something of which there is no reference here: teach it, then measure."""


class Trees:
    """A TreeEnsembleClassifier or TreeEnsembleRegressor whose nodes ask `value <= threshold`."""

    def __init__(self, kind: str, attributes: Mapping[str, Any]) -> None:
        """Raises `UnknownOperatorError` for trees of another kind."""
        self._classifies = kind == "TreeEnsembleClassifier"
        modes = np.array(attributes["nodes_modes"])
        sums = attributes.get("aggregate_function", b"SUM") == b"SUM"
        plain = attributes.get("post_transform", b"NONE") == b"NONE"
        if not (set(modes) <= {b"LEAF", b"BRANCH_LEQ"} and sums and plain):
            raise UnknownOperatorError(f"no float64 reference of this kind of {kind}")
        trees = np.array(attributes["nodes_treeids"], dtype=np.int64)
        nodes = np.array(attributes["nodes_nodeids"], dtype=np.int64)
        place = {key: at for at, key in enumerate(zip(trees.tolist(), nodes.tolist(), strict=True))}
        leaf = modes == b"LEAF"
        self._feature = np.array(attributes["nodes_featureids"], dtype=np.int64)
        self._threshold = np.array(attributes["nodes_values"], dtype=np.float64)
        itself = np.arange(len(nodes))
        self._below, self._above = (
            np.array(
                [
                    at if end else place[tree, child]
                    for at, end, tree, child in zip(
                        itself.tolist(), leaf.tolist(), trees.tolist(), children, strict=True
                    )
                ]
            )
            for children in (attributes["nodes_truenodeids"], attributes["nodes_falsenodeids"])
        )
        # A root is nobody's child.
        children = np.concatenate((self._below[~leaf], self._above[~leaf]))
        self._roots = np.setdiff1d(itself, children)
        self._weights = self._leaf_weights(attributes, place, len(nodes))
        self._base = np.array(attributes.get("base_values", [0.0]), dtype=np.float64)

    def _leaf_weights(
        self, attributes: Mapping[str, Any], place: Mapping[tuple[int, int], int], nodes: int
    ) -> NDArray[np.float64]:
        """What each node adds to each class or target, shape (nodes, outputs)."""
        name = "class" if self._classifies else "target"
        outputs = attributes[f"{name}_ids"]
        weights = np.zeros((nodes, max(outputs) + 1))
        for tree, node, output, weight in zip(
            attributes[f"{name}_treeids"],
            attributes[f"{name}_nodeids"],
            outputs,
            attributes[f"{name}_weights"],
            strict=True,
        ):
            weights[place[tree, node], output] += weight
        return weights

    def __call__(
        self, given: list[Any], attributes: Mapping[str, Any]
    ) -> NDArray[Any] | tuple[NDArray[Any], ...]:
        """Of a classifier labels (N,) and scores (N, 2), of a regressor sums (N, targets)."""
        values = given[0]
        at = np.tile(self._roots, (len(values), 1))
        rows = np.arange(len(values))[:, np.newaxis]
        for _ in range(DEPTH_MAX):
            below = values[rows, self._feature[at]] <= self._threshold[at]
            following = np.where(below, self._below[at], self._above[at])
            if (following == at).all():
                break
            at = following
        sums: NDArray[np.float64] = self._weights[at].sum(axis=1) + self._base
        if not self._classifies:
            return sums
        if sums.shape[1] == 1:  # of two classes only the second is written down
            sums = np.concatenate((1.0 - sums, sums), axis=1)
        return sums.argmax(axis=1), sums
