"""The networks of the paper as PyTorch modules, made from a configuration."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval, fuse_linear_bn_eval

IMAGE_SHAPE = (12, 11, 3)
"""Height, width, fingers of the D1 image."""
KERNEL = 3
"""Side of every convolution, pixels."""
NORM_EPSILON = 1e-3
"""Keras' default: the published networks were trained with it."""


@dataclass(frozen=True, slots=True)
class NetworkConfig:
    """Size of a network: convolution - batch norm - ReLU - dense - batch norm - ReLU - dense(2)."""

    name: str
    filters: int
    """Filters of the 3 x 3 convolution (valid, no bias)."""
    hidden: int
    """Units of the hidden dense layer."""
    image_shape: tuple[int, int, int] = IMAGE_SHAPE


CNN1 = NetworkConfig("cnn1", filters=32, hidden=1024)
"""The best network of the paper: Conv32 - FC1024."""
NETWORKS = {config.name: config for config in (CNN1,)}


class ChannelsFirst(nn.Module):
    """Images (N, height, width, fingers), as the daemon builds them, to (N, fingers, ...)."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Move the fingers from the last axis to the second."""
        return images.permute(0, 3, 1, 2)


def build(config: NetworkConfig) -> nn.Sequential:
    """A network with fresh weights from torch's global random state.

    Takes float32 images (N, *image_shape), returns logits (N, 2) in the order (stable, slip).
    Weights are Glorot-uniform and biases zero, as Keras starts them.
    """
    height, width, fingers = config.image_shape
    pixels = (height - KERNEL + 1) * (width - KERNEL + 1)
    network = nn.Sequential(
        ChannelsFirst(),
        nn.Conv2d(fingers, config.filters, KERNEL, bias=False),
        nn.BatchNorm2d(config.filters, eps=NORM_EPSILON),
        nn.ReLU(),
        nn.Flatten(),
        nn.Linear(config.filters * pixels, config.hidden),
        nn.BatchNorm1d(config.hidden, eps=NORM_EPSILON),
        nn.ReLU(),
        nn.Linear(config.hidden, 2),
    )
    for layer in network:
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    return network


def parameter_count(network: nn.Module) -> int:
    """Number of trained parameters."""
    return sum(parameter.numel() for parameter in network.parameters())


def for_inference(network: nn.Sequential, temperature: float) -> nn.Sequential:
    """A copy that returns calibrated probabilities (N, 2), with nothing left to compute twice.

    Batch norm goes into the layer before it, the temperature into the last layer: a linear layer
    divided by T gives `softmax(logits / T)`.
    """
    layers: list[nn.Module] = []
    for layer in copy.deepcopy(network).eval():
        if isinstance(layer, nn.BatchNorm2d) and isinstance(layers[-1], nn.Conv2d):
            layers[-1] = fuse_conv_bn_eval(layers[-1], layer)
        elif isinstance(layer, nn.BatchNorm1d) and isinstance(layers[-1], nn.Linear):
            layers[-1] = fuse_linear_bn_eval(layers[-1], layer)
        else:
            layers.append(layer)
    last = layers[-1]
    if not isinstance(last, nn.Linear):
        raise TypeError(f"a network ends in a linear layer, not {type(last).__name__}")
    with torch.no_grad():
        last.weight.div_(temperature)
        last.bias.div_(temperature)
    return nn.Sequential(*layers, nn.Softmax(dim=1)).eval()
