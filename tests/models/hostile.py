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
    """A zoo model of a few bytes more that multiplies matrices of so many rows for minutes."""
    import onnx
    from onnx import TensorProto, helper

    model, path = _zoo_model(), folder / "giant.onnx"
    graph = model.graph
    node = next(node for node in graph.node if "probability" in node.output)
    node.output[0] = "sound"
    graph.initializer.append(helper.make_tensor("sides", TensorProto.INT64, [2], [side, side]))
    graph.initializer.append(helper.make_tensor("none", TensorProto.FLOAT, [], [0.0]))
    graph.node.append(helper.make_node("ReduceSum", ["sound"], ["sum"], keepdims=0))
    graph.node.append(helper.make_node("Mul", ["sum", "none"], ["zero"]))
    graph.node.append(helper.make_node("Expand", ["zero", "sides"], ["m0"]))
    for number in range(40):
        graph.node.append(
            helper.make_node("MatMul", [f"m{number}", f"m{number}"], [f"m{number + 1}"])
        )
    graph.node.append(helper.make_node("ReduceSum", ["m40"], ["nothing"], keepdims=0))
    graph.node.append(helper.make_node("Add", ["sound", "nothing"], ["probability"]))
    onnx.save_model(model, path)
    return path
