"""Make PyTorch modules from configurations: networks of the paper, and narrower ones."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval, fuse_linear_bn_eval

from graspd.models.contract import FEATURES_PER_FINGER
from graspd.models.layout import D1, ELECTRODES
from graspd.models.tactile_image import Fill, fill_matrix
from graspd.models.training.estimators.configs import NetworkConfig

IMAGE_SHAPE = (12, 11, 3)
"""Height, width, fingers of the D1 image."""
KERNEL = 3
"""Side of the first convolution, pixels."""
POOL = 2
"""Side and stride of a maximum pooling, pixels."""
NORM_EPSILON = 1e-3
"""Keras' default: the published networks were trained with it."""


class ChannelsFirst(nn.Module):
    """Layer from images (N, height, width, fingers), as in the daemon, to (N, fingers, ...)."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return images.permute(0, 3, 1, 2)


class FeatureImages(nn.Module):
    """Layer from electrodes (N, fingers * 24) to D1 images (N, fingers, 12, 11)."""

    fill: torch.Tensor

    def __init__(self, fingers: int) -> None:
        super().__init__()
        matrix = fill_matrix(D1, Fill.NEIGHBOUR_MEAN)[:, :ELECTRODES]
        self.register_buffer("fill", torch.tensor(matrix.T, dtype=torch.float32))
        self._fingers = fingers

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        pixels = values.reshape(-1, self._fingers, ELECTRODES) @ self.fill
        return pixels.reshape(-1, self._fingers, *D1.shape)


class Beside(nn.Module):
    """Module that passes the first features through layers and appends the rest."""

    def __init__(self, look: nn.Sequential, first: int) -> None:
        super().__init__()
        self.look = look
        self.first = first

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Features (N, M) to (N, seen + M - first)."""
        seen = self.look(features[:, : self.first])
        return torch.cat((seen, features[:, self.first :]), dim=1)


def build(config: NetworkConfig, shape: Sequence[int] = IMAGE_SHAPE) -> nn.Sequential:
    """Return a network with new weights from torch's global random state.

    It takes float32 inputs (N, *shape), images or features, and returns logits (N, 2) in the order
    (stable, slip). Weights are Glorot-uniform and biases zero, as Keras starts them. Raises
    `ValueError` if the network does not fit the shape.
    """
    look = _look(config, tuple(shape))
    try:
        width = nn.Sequential(*look).eval()(torch.zeros(1, *shape)).shape[1]
    except RuntimeError as error:
        raise ValueError(f"inputs {tuple(shape)} are too small for the network") from error
    dense = [nn.Linear(width, config.hidden), nn.ReLU()]
    if config.batch_norm:
        dense.insert(1, nn.BatchNorm1d(config.hidden, eps=NORM_EPSILON))
    drop = [nn.Dropout(config.dropout)] if config.dropout > 0.0 else []
    network = nn.Sequential(*look, *drop, *dense, *drop, nn.Linear(config.hidden, 2)).train()
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    return network


def parameter_count(network: nn.Module) -> int:
    """Return the number of trained parameters."""
    return sum(parameter.numel() for parameter in network.parameters())


def for_inference(network: nn.Sequential, temperature: float) -> nn.Sequential:
    """Return a copy that gives calibrated probabilities (N, 2).

    Batch norm is folded into the layer before it, and the temperature into the last layer. A linear
    layer divided by T gives `softmax(logits / T)`.
    """
    layers, last = _split(network)
    with torch.no_grad():
        last.weight.div_(temperature)
        last.bias.div_(temperature)
    return nn.Sequential(*layers, last, nn.Softmax(dim=1)).eval()


def for_margin(network: nn.Sequential) -> nn.Sequential:
    """Return a copy that gives log-odds of slip (N, 1), folded like `for_inference`."""
    layers, last = _split(network)
    margin = nn.Linear(last.in_features, 1)
    with torch.no_grad():
        margin.weight.copy_(last.weight[1:] - last.weight[:1])
        margin.bias.copy_(last.bias[1:] - last.bias[:1])
    return nn.Sequential(*layers, margin).eval()


def _look(config: NetworkConfig, shape: tuple[int, ...]) -> list[nn.Module]:
    """Return the layers that turn an input into the values before the hidden layer."""
    if len(shape) == 3:
        return [ChannelsFirst(), *_convolutions(config, shape[2])]
    (features,) = shape
    fingers, extra = divmod(features, FEATURES_PER_FINGER)
    if extra:
        fingers, extra = divmod(features, ELECTRODES)
    if extra:
        raise ValueError(f"{features} features are not those of whole fingers")
    layers = [FeatureImages(fingers), *_convolutions(config, fingers)]
    first = fingers * ELECTRODES
    return layers if first == features else [Beside(nn.Sequential(*layers), first)]


def _convolutions(config: NetworkConfig, channels: int) -> list[nn.Module]:
    layers = _convolution(channels, config.filters, KERNEL, config.batch_norm)
    if config.pool:
        layers.append(nn.MaxPool2d(POOL))
    if config.second is not None:
        second = config.second
        layers += _convolution(config.filters, second.filters, second.kernel, config.batch_norm)
    return [*layers, nn.Flatten()]


def _convolution(inputs: int, filters: int, kernel: int, batch_norm: bool) -> list[nn.Module]:
    norm = [nn.BatchNorm2d(filters, eps=NORM_EPSILON)] if batch_norm else []
    return [nn.Conv2d(inputs, filters, kernel, bias=not batch_norm), *norm, nn.ReLU()]


def _folded(network: nn.Sequential) -> list[nn.Module]:
    """Return the layers without batch norm (folded) and dropout. Changes `network`."""
    layers: list[nn.Module] = []
    for layer in network:
        if isinstance(layer, nn.BatchNorm2d) and isinstance(layers[-1], nn.Conv2d):
            layers[-1] = fuse_conv_bn_eval(layers[-1], layer)
        elif isinstance(layer, nn.BatchNorm1d) and isinstance(layers[-1], nn.Linear):
            layers[-1] = fuse_linear_bn_eval(layers[-1], layer)
        elif isinstance(layer, Beside):
            layers.append(Beside(nn.Sequential(*_folded(layer.look)), layer.first))
        elif not isinstance(layer, nn.Dropout):
            layers.append(layer)
    return layers


def _split(network: nn.Sequential) -> tuple[list[nn.Module], nn.Linear]:
    """Return a copy for inference: the folded layers, and the last one."""
    *layers, last = _folded(copy.deepcopy(network).eval())
    if not isinstance(last, nn.Linear):
        raise TypeError(f"a network ends in a linear layer, not {type(last).__name__}")
    return layers, last
