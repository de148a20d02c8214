"""Models made to harm who loads them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from graspd.models import zoo


def _zoo_model() -> Any:  # noqa: ANN401 - onnx has no types
    import onnx

    return onnx.load(zoo.find("small-session"))


def external(folder: Path) -> Path:
    """A zoo model whose weights are in a file beside it, which may be changed under its sha."""
    import onnx

    model, path = _zoo_model(), folder / "external.onnx"
    onnx.save_model(
        model, path, save_as_external_data=True, location="weights.bin", size_threshold=1024
    )
    return path


def giant(folder: Path, side: int = 5000) -> Path:
    """A zoo model, a little larger, that multiplies matrices of so many rows for minutes."""
    import numpy as np
    import onnx
    from onnx import helper, numpy_helper

    model, path = _zoo_model(), folder / "giant.onnx"
    graph = model.graph
    node = next(node for node in graph.node if "probability" in node.output)
    node.output[0] = "sound"
    for name, shape in (("wide", (2, side)), ("row", (1, side)), ("two", (side, 2))):
        graph.initializer.append(numpy_helper.from_array(np.zeros(shape, np.float32), name))
    graph.initializer.append(numpy_helper.from_array(np.array([side, 1]), "column"))
    products = [("sound", "wide", "line"), ("upright", "row", "m0")]
    products += [(f"m{number}", f"m{number}", f"m{number + 1}") for number in range(40)]
    products += [("row", "m40", "last"), ("last", "two", "nothing")]
    graph.node.extend(helper.make_node("MatMul", [a, b], [c]) for a, b, c in products[:1])
    graph.node.append(helper.make_node("Reshape", ["line", "column"], ["upright"]))
    graph.node.extend(helper.make_node("MatMul", [a, b], [c]) for a, b, c in products[1:])
    graph.node.append(helper.make_node("Add", ["sound", "nothing"], ["probability"]))
    onnx.save_model(model, path)
    return path


def cyclic(folder: Path) -> Path:
    """A model with a tree whose nodes 2 and 4 lead to each other above 100 counts."""
    import onnx
    from onnx import helper

    from graspd.models.contract import METADATA_KEY
    from graspd.models.training.estimators.graphs import vector_model, with_probability

    path = folder / "cyclic.onnx"
    node = helper.make_node(
        "TreeEnsembleRegressor",
        ["tactile_counts"],
        ["margin"],
        domain="ai.onnx.ml",
        n_targets=1,
        nodes_treeids=[0] * 6,
        nodes_nodeids=[0, 1, 2, 3, 4, 5],
        nodes_modes=["BRANCH_LEQ", "LEAF"] * 3,
        nodes_featureids=[0] * 6,
        nodes_values=[100.0, 0.0, 1e9, 0.0, 1e9, 0.0],
        nodes_truenodeids=[1, 0, 4, 0, 2, 0],
        nodes_falsenodeids=[2, 0, 3, 0, 5, 0],
        target_treeids=[0] * 3,
        target_nodeids=[1, 3, 5],
        target_ids=[0] * 3,
        target_weights=[1.0, 2.0, 3.0],
    )
    model = with_probability(vector_model([node], [], "tactile_counts", 72), 1.0)
    contract = onnx.load(zoo.find("small-electrodes")).metadata_props
    (text,) = (each.value for each in contract if each.key == METADATA_KEY)
    helper.set_model_props(model, {METADATA_KEY: text})
    onnx.save_model(model, path)
    return path
