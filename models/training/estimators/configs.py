"""Settings of classifiers, networks and their training.

No library of the training is imported here, so that the help lists every system.
"""

from __future__ import annotations

from dataclasses import dataclass

THREADS = 1
"""Threads of one training. More would round sums differently, and other trainings use the cores."""


@dataclass(frozen=True, slots=True)
class SvmConfig:
    """Support vector machine with a radial kernel, classes weighted to balance."""

    c: float
    gamma: float
    """Gamma of the kernel exp(-gamma * distance**2)."""


@dataclass(frozen=True, slots=True)
class ForestConfig:
    """Random forest."""

    trees: int
    depth: int | None
    """Largest depth of a tree; None: grow until the leaves are pure."""


@dataclass(frozen=True, slots=True)
class MlpConfig:
    """Multi-layer perceptron: ReLU, Adam, a fixed number of epochs."""

    hidden: tuple[int, ...]
    """Units of each hidden layer."""
    alpha: float = 1e-4
    """Weight of the L2 term."""
    learning_rate: float = 1e-3
    epochs: int = 100


@dataclass(frozen=True, slots=True)
class BoostingConfig:
    """Gradient boosting on histograms."""

    iterations: int = 300
    learning_rate: float = 0.1
    leaves: int = 31
    """Largest number of leaves of a tree."""
    leaf_grasps: int = 20
    """Fewest grasps in a leaf."""
    l2: float = 0.0
    features: float = 1.0
    """Fraction of the features that a split may choose from."""


ClassicalConfig = SvmConfig | ForestConfig | MlpConfig | BoostingConfig


@dataclass(frozen=True, slots=True)
class SecondConvolution:
    """A convolution without padding, after the first one and its pooling."""

    filters: int = 64
    kernel: int = 1
    """Side, pixels: the authors' notebooks have 1, the table of the paper has 3."""


@dataclass(frozen=True, slots=True)
class NetworkConfig:
    """A convolutional network: convolution(s), one hidden dense layer, two classes.

    It takes images, or vectors. The 24 electrodes of each finger in a vector become a D1 image
    inside the network; other features are inputs of the hidden layer.
    """

    filters: int
    """Filters of the first convolution, 3 x 3, valid."""
    hidden: int
    """Units of the hidden dense layer."""
    pool: bool = False
    """2 x 2 maximum pooling after the first convolution; an odd row or column is left out."""
    second: SecondConvolution | None = None
    dropout: float = 0.0
    """Fraction of values left out in training, before and after the hidden layer."""
    batch_norm: bool = True
    """True: batch norm after each convolution, without bias then, and after the hidden layer."""


CNN0 = NetworkConfig(filters=32, hidden=128)
CNN1 = NetworkConfig(filters=32, hidden=1024)
"""The best network of the paper: Conv32 - FC1024."""
CNN2 = NetworkConfig(filters=32, hidden=1024, pool=True)
CNN3 = NetworkConfig(filters=32, hidden=1024, pool=True, second=SecondConvolution())


@dataclass(frozen=True, slots=True)
class Augmentation:
    """Flips and small rotations of tactile images (paper, section III-E): four times the images."""

    rotation_deg: float = 10.0
    """Each image is rotated by this angle, to the left or to the right at random."""


@dataclass(frozen=True, slots=True)
class DayShift:
    """Assumed difference of the features of two days after standardising.

    Twice these values help networks trained on a single day more, but harm the others.
    """

    gain: float = 0.3
    """Each feature is multiplied by `exp(gain * e)`, e standard normal."""
    finger_gain: float = 0.3
    """All 24 z-values of a finger are multiplied by the same `exp(finger_gain * e)`."""
    offset: float = 0.7
    """Standard deviation of the offsets added to each finger's mean and spread."""


DAY_SHIFT = DayShift()


@dataclass(frozen=True, slots=True)
class Recipe:
    """Settings of one training by a one-cycle AdamW schedule.

    Twenty epochs of one cycle replace the paper's 300 epochs of Adam at a falling rate; the
    cross-validated F1 stays within the paper's spread. An incomplete last batch is left out.
    """

    epochs: int = 20
    batch: int = 32
    peak_learning_rate: float = 1e-3
    warm_up: float = 0.3
    """Fraction of the training in which the learning rate rises."""
    weight_decay: float = 0.5
    """Decoupled weight decay of convolution and dense weights; replaces the paper's L2 term."""
    label_smoothing: float = 0.0
    """Share of each target that is divided equally between both classes."""
    input_noise: float = 0.0
    """Standard deviation of the noise added to each input, in the input's own (z-score) units."""
    norm_momentum: float = 0.1
    """Weight of a new batch in the running statistics of a batch norm."""
    threads: int = THREADS


@dataclass(frozen=True, slots=True)
class SessionRecipe(Recipe):
    """Recipe for session features: each grasp of a batch is shifted at random by `day_shift`."""

    epochs: int = 40
    weight_decay: float = 1.0
    input_noise: float = 0.4
    day_shift: DayShift = DAY_SHIFT


@dataclass(frozen=True, slots=True)
class PublishedRecipe:
    """Settings of one training as published: Adam at a rate that falls with every update."""

    epochs: int = 300
    batch: int = 32
    learning_rate: float = 1e-4
    decay: float = 0.005
    """Keras' time decay: update t (from 0) has the rate `learning_rate / (1 + decay * t)`."""
    l2: float = 0.01
    """Keras' kernel regularizer: the loss has `l2 * sum(w**2)` over the weights of every layer
    but the last."""
    label_smoothing: float = 0.0
    input_noise: float = 0.0
    norm_momentum: float = 0.01
    """Weight of a new batch in the running statistics; Keras writes 0.99, the old weight."""
    threads: int = THREADS


AnyRecipe = Recipe | PublishedRecipe
