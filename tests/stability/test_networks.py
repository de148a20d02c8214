"""Networks made up for the worst: variances, logits and underflow that no training gives."""

from __future__ import annotations

import copy
from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("onnx", reason="needs the extra `train`")
pytest.importorskip("torch", reason="needs the extra `train`")

import onnx
import torch
from onnx import helper, numpy_helper
from torch import nn

from graspd.daemon.judge.decision import HELD, Limits, decide
from graspd.daemon.judge.reasons import Decision
from graspd.models import zoo
from graspd.models.contract import METADATA_KEY, ModelContract, VectorInput
from graspd.models.inputs import builder
from graspd.models.runtime import TactileModel
from graspd.models.training.estimators.configs import NetworkConfig
from graspd.models.training.estimators.graphs import (
    IR_VERSION,
    MARGIN_NAME,
    OPSET,
    with_probability,
)
from graspd.models.training.estimators.networks import IMAGE_SHAPE, build, for_inference
from graspd.models.training.reports.stability.chain import P_SLIP_ERROR_MAX

VARIANCES = torch.tensor((0.0, 1e-38, 1e-12, 1.0, 1e12, 1e38))
"""Running statistics of batch norm, in turn; the last is near float32's largest number."""
LARGEST_LOGIT = 1e4
LOGITS = (0.0, 1e-3, 1.0, 17.0, 60.0, 87.0, 88.0, 103.0, 104.0, 200.0, LARGEST_LOGIT)
"""Softmax in float32 gives denormal numbers from a difference of 87 on, and zero from 104 on."""


def test_batch_norm_is_folded_whatever_its_variances() -> None:
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(0)
        network = build(NetworkConfig(filters=12, hidden=24)).eval()
        for layer in network:
            if isinstance(layer, nn.BatchNorm1d | nn.BatchNorm2d):
                assert layer.running_var is not None
                assert layer.running_mean is not None
                turns = torch.arange(len(layer.running_var)) % len(VARIANCES)
                layer.running_var.copy_(VARIANCES[turns])
                layer.running_mean.normal_()
                nn.init.normal_(layer.weight)
                nn.init.normal_(layer.bias)
        images = torch.randn(64, *IMAGE_SHAPE)
        wide = nn.Sequential(*copy.deepcopy(network).double(), nn.Softmax(dim=1)).eval()
        difference = for_inference(network, 1.0)(images).double() - wide(images.double())
    error = float(difference.abs().max())
    assert error < P_SLIP_ERROR_MAX


def test_extreme_logits_give_the_verdict_of_their_sign(tmp_path: Path) -> None:
    path = tmp_path / "logits.onnx"
    path.write_bytes(logit_model(TactileModel(zoo.find("mlp")).contract))
    model, limits = TactileModel(path), Limits(max_age_ns=0)
    logits = (*LOGITS, *(-logit for logit in LOGITS if logit))
    errors, sums, judged = [], [], 0
    for logit in logits:
        model.input[...] = 0.0
        model.input[0] = logit / LARGEST_LOGIT
        p_stable, p_slip = model.run()
        exact = np.longdouble(model.input[0]) * np.longdouble(LARGEST_LOGIT)
        errors.append(abs(float(1 / (1 + np.exp(-exact)) - np.longdouble(p_slip))))
        sums.append(abs(p_stable + p_slip - 1.0))
        decision, _ = decide(p_slip, (), HELD, 0, limits)
        right = decision is (Decision.SLIP if logit >= 0.0 else Decision.STABLE)
        judged += right and 0.0 <= p_slip <= 1.0
    assert max(errors) < P_SLIP_ERROR_MAX
    assert judged == len(logits)


def logit_model(contract: ModelContract) -> bytes:
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
    opsets = [helper.make_opsetid("", OPSET)]
    margin = helper.make_model(graph, opset_imports=opsets, ir_version=IR_VERSION)
    model = with_probability(margin, 1.0)
    helper.set_model_props(model, {METADATA_KEY: contract.to_json()})
    serialized: bytes = model.SerializeToString()
    return serialized
