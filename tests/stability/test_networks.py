"""Networks with extreme variances in batch norm, which no training gives."""

from __future__ import annotations

import copy

import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

import torch
from torch import nn

from graspd.models.training.estimators.configs import NetworkConfig
from graspd.models.training.estimators.networks import IMAGE_SHAPE, build, for_inference
from graspd.models.training.reports.stability.chain import P_SLIP_ERROR_MAX

VARIANCES = torch.tensor((0.0, 1e-38, 1e-12, 1.0, 1e12, 1e38))
"""Running variances of batch norm, repeated over the channels; the last is near float32's limit."""


def test_folding_batch_norm_of_any_variance_keeps_the_probabilities() -> None:
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(0)
        network = build(NetworkConfig(filters=12, hidden=24, dropout=0.4)).eval()
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
        folded = for_inference(network, 1.0)
        difference = folded(images).double() - wide(images.double())
    gone = nn.BatchNorm1d | nn.BatchNorm2d | nn.Dropout
    assert not any(isinstance(layer, gone) for layer in folded.modules())
    error = float(difference.abs().max())
    assert error < P_SLIP_ERROR_MAX
