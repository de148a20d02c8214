"""Networks made up for the worst: variances, logits and underflow that no training gives."""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from torch import nn

from daemon.judge.decision import HELD, Limits, decide
from daemon.judge.reasons import Decision
from daemon.measure.stability.steps import StepRow
from models.contract import METADATA_KEY, ModelContract, VectorInput
from models.inputs import builder
from models.runtime import TactileModel
from models.training.estimators.graphs import IR_VERSION, MARGIN_NAME, OPSET, with_probability
from models.training.estimators.networks import IMAGE_SHAPE, NetworkConfig, build, for_inference

VARIANCES = (0.0, 1e-38, 1e-12, 1.0, 1e12, 1e38)
"""Of batch norm's running statistics, in turn; the last one is near float32's largest number."""
LARGEST_LOGIT = 1e4
LOGITS = (0.0, 1e-3, 1.0, 17.0, 60.0, 87.0, 88.0, 103.0, 104.0, 200.0, LARGEST_LOGIT)
"""Softmax in float32 gives denormal numbers from a difference of 87 on, and zero from 104 on."""


def network_rows(contract: ModelContract, bound: float) -> Iterator[StepRow]:
    """Errors of `p_slip` must keep below `bound`; `contract` is of any model of the zoo."""
    error = _batch_norm_error()
    yield StepRow(
        "batch norm, variances from 0 to 1e38, folded",
        f"p_slip to {bound:.0e}",
        f"{error:.1e}",
        error < bound,  # false for NaN
    )
    error, published, sums = _logit_errors(contract)
    yield StepRow(
        "logits to +-1e4 and softmax underflow",
        f"p_slip to {bound:.0e}, verdict by the sign",
        f"{error:.1e}, {published} of {2 * len(LOGITS) - 1} judged, sum off 1 by {sums:.0e}",
        error < bound and published == 2 * len(LOGITS) - 1,
    )


def quantised_row(names: Sequence[str], worst: float, bound: float) -> StepRow:
    """Whether integers saturate: quantised models of the zoo, and their largest error."""
    if not names:
        return StepRow("int8 saturation", "only if quantised", "no model is quantised", True)
    return StepRow(
        "int8 saturation",
        f"p_slip to {bound:.0e} in all cases",
        f"{worst:.1e} of {', '.join(names)}",
        worst < bound,
    )


def _batch_norm_error() -> float:
    """Largest error of a network folded in float32, against the same one unfolded in float64."""
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(0)
        network = build(NetworkConfig(filters=12, hidden=24)).eval()
        for layer in network:
            if isinstance(layer, nn.BatchNorm1d | nn.BatchNorm2d):
                _stress(layer)
        images = torch.randn(64, *IMAGE_SHAPE)
        wide = nn.Sequential(*copy.deepcopy(network).double(), nn.Softmax(dim=1)).eval()
        difference = for_inference(network, 1.0)(images).double() - wide(images.double())
        return float(difference.abs().max())


def _stress(layer: nn.BatchNorm1d | nn.BatchNorm2d) -> None:
    if layer.running_var is None or layer.running_mean is None:
        raise TypeError("batch norm keeps no statistics")
    turns = torch.arange(len(layer.running_var)) % len(VARIANCES)
    layer.running_var.copy_(torch.tensor(VARIANCES)[turns])
    layer.running_mean.normal_()
    nn.init.normal_(layer.weight)
    nn.init.normal_(layer.bias)


def _logit_errors(contract: ModelContract) -> tuple[float, int, float]:
    """Largest error of `p_slip`, right verdicts, and how far probabilities are off a sum of 1."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "logits.onnx"
        path.write_bytes(_logit_model(contract))
        model = TactileModel(path)
        errors, published, sums = [], 0, 0.0
        for logit in (*LOGITS, *(-logit for logit in LOGITS if logit)):
            model.input[...] = 0.0
            model.input[0] = logit / LARGEST_LOGIT
            p_stable, p_slip = model.run()
            exact = np.longdouble(model.input[0]) * np.longdouble(LARGEST_LOGIT)
            errors.append(abs(float(1 / (1 + np.exp(-exact)) - np.longdouble(p_slip))))
            sums = max(sums, abs(p_stable + p_slip - 1.0))
            published += 0.0 <= p_slip <= 1.0 and _is_judged(p_slip, logit)
        return max(errors), published, sums


def _is_judged(p_slip: float, logit: float) -> bool:
    """Whether the daemon says of a margin what its sign says."""
    decision, _ = decide(p_slip, (), HELD, 0, Limits(max_age_ns=0))
    return decision is (Decision.SLIP if logit >= 0.0 else Decision.STABLE)


def _logit_model(contract: ModelContract) -> bytes:
    """A model whose margin is 1e4 times its first input."""
    contract = msgspec.structs.replace(contract, input=VectorInput())
    given = builder(contract.input, len(contract.fingers))
    column: NDArray[np.float32] = np.zeros((*given.shape, 1), dtype=np.float32)
    column[0] = LARGEST_LOGIT
    graph = helper.make_graph(
        [helper.make_node("MatMul", [given.name, "column"], [MARGIN_NAME])],
        "margin",
        [helper.make_tensor_value_info(given.name, onnx.TensorProto.FLOAT, ["N", *given.shape])],
        [helper.make_tensor_value_info(MARGIN_NAME, onnx.TensorProto.FLOAT, ["N", 1])],
        [numpy_helper.from_array(column, "column")],
    )
    margin = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION
    )
    model = with_probability(margin, 1.0)
    helper.set_model_props(model, {METADATA_KEY: contract.to_json()})
    serialized: bytes = model.SerializeToString()
    return serialized
