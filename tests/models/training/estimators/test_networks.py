"""The networks: sizes, shapes, order of axes, folding for inference."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

import torch
from torch import nn

import graspd
from graspd.models.training.estimators.configs import (
    CNN0,
    CNN1,
    CNN3,
    NetworkConfig,
    SecondConvolution,
)
from graspd.models.training.estimators.networks import (
    Beside,
    build,
    reproducible,
)

TINY = NetworkConfig(filters=4, hidden=16)
DEEP = NetworkConfig(
    filters=4, hidden=8, pool=True, second=SecondConvolution(5, kernel=3), dropout=0.4
)
IMAGE, FEATURES, VECTOR = (12, 11, 3), (78,), (72,)


@pytest.mark.parametrize(
    ("config", "shape", "parameters"),
    [
        (CNN1, IMAGE, 2_955_170),  # the published network
        # convolution + its norm + hidden layer + its norm + last layer, by hand
        (CNN0, IMAGE, 864 + 64 + (2880 * 128 + 128) + 256 + 258),
        (CNN3, IMAGE, 864 + 64 + (32 * 64 + 128) + (1280 * 1024 + 1024) + 2048 + 2050),
        (
            NetworkConfig(32, 1024, pool=True, second=SecondConvolution(64, kernel=3)),
            IMAGE,
            864 + 64 + (32 * 64 * 9 + 128) + (384 * 1024 + 1024) + 2048 + 2050,
        ),
        (NetworkConfig(16, 64), FEATURES, 432 + 32 + (1446 * 64 + 64) + 128 + 130),
        (NetworkConfig(8, 32), VECTOR, 216 + 16 + (720 * 32 + 32) + 64 + 66),
        (NetworkConfig(8, 32, batch_norm=False), IMAGE, 216 + 8 + (720 * 32 + 32) + 66),
    ],
)
def test_a_network_has_the_parameters_of_its_layers(
    config: NetworkConfig, shape: tuple[int, ...], parameters: int
) -> None:
    network = build(config, shape).eval()
    assert sum(parameter.numel() for parameter in network.parameters()) == parameters
    assert network(torch.zeros(2, *shape)).shape == (2, 2)


def test_a_network_that_does_not_fit_its_input_is_refused() -> None:
    for config, shape in ((DEEP, (4, 7, 3)), (TINY, (2, 5, 3))):
        with pytest.raises(ValueError, match="too small"):
            build(config, shape)
    with pytest.raises(ValueError, match="not those of whole fingers"):
        build(TINY, (77,))


def test_weights_start_as_in_keras() -> None:
    with reproducible(seed=0):
        network = build(CNN1)
    fans = {(32, 3, 3, 3): 27 + 288, (1024, 2880): 2880 + 1024, (2, 1024): 1024 + 2}
    for layer in network:
        if isinstance(layer, nn.Conv2d | nn.Linear):
            weight = layer.weight.detach().numpy()
            limit = (6 / fans[weight.shape]) ** 0.5
            assert np.abs(weight).max() <= limit
            assert weight.std() == pytest.approx(limit / 3**0.5, rel=0.05)
            assert layer.bias is None or not layer.bias.any()
        if isinstance(layer, nn.BatchNorm2d | nn.BatchNorm1d):
            assert layer.eps == 1e-3


def test_features_become_the_filled_image_and_the_rest_stands_beside() -> None:
    features = np.random.default_rng(5).integers(1, 4096, (3, 78)).astype(np.float32)
    network = build(NetworkConfig(filters=4, hidden=8), FEATURES).eval()
    beside = network[0]
    assert isinstance(beside, Beside)
    front = beside.look[0](torch.from_numpy(features[:, :72])).numpy()
    assert front.shape == (3, 3, 12, 11)
    filled = graspd.tactile_images(features[:, :72].reshape(3, 3, 24))
    assert front == pytest.approx(filled.transpose(0, 3, 1, 2), rel=1e-6)
    laid = beside(torch.from_numpy(features)).detach().numpy()
    assert laid.shape == (3, 4 * 90 + 6)
    assert np.array_equal(laid[:, -6:], features[:, 72:])
