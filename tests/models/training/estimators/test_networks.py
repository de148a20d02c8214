"""Networks: sizes, order of axes, and how they are trained, against the published formulas."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

import torch
from torch import nn

import graspd
from graspd.models.inputs import VectorBuilder
from graspd.models.tactile_image import TactileImager
from graspd.models.training.estimators import networks
from graspd.models.training.estimators.configs import (
    CNN0,
    CNN1,
    CNN3,
    DayShift,
    NetworkConfig,
    PublishedRecipe,
    Recipe,
    SecondConvolution,
    SessionRecipe,
)
from graspd.models.training.estimators.networks import (
    Beside,
    build,
    on_another_day,
    optimization,
    reproducible,
    train_network,
)
from tests.models.training.samples import separable_counts

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


def test_z_values_become_filled_images_and_other_features_pass_unchanged() -> None:
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


QUICK = Recipe(epochs=4)
COUNTS, SLIPPED = separable_counts(160)
IMAGES, VECTORS = (inputs.build_batch(COUNTS)[0] for inputs in (TactileImager(3), VectorBuilder(3)))


def plain_network(inputs: int = 72) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, 5), nn.ReLU(), nn.Linear(5, 2))


def _weights(network: nn.Sequential) -> list[float]:
    return [value for tensor in network.state_dict().values() for value in tensor.ravel().tolist()]


def test_the_seed_alone_decides_the_weights() -> None:
    trained = _weights(train_network(TINY, IMAGES, SLIPPED, QUICK, seed=1))
    torch.manual_seed(99)  # the state around a training does not matter
    assert _weights(train_network(TINY, IMAGES, SLIPPED, QUICK, seed=1)) == trained
    assert _weights(train_network(TINY, IMAGES, SLIPPED, QUICK, seed=2)) != trained


def test_training_restores_torchs_threads_and_random_state() -> None:
    threads, state = torch.get_num_threads(), torch.random.get_rng_state()
    train_network(TINY, IMAGES, SLIPPED, Recipe(epochs=1, threads=threads + 1), seed=1)
    assert torch.get_num_threads() == threads
    assert not torch.are_deterministic_algorithms_enabled()
    assert torch.equal(torch.random.get_rng_state(), state)


def test_training_on_less_than_two_grasps_is_refused() -> None:
    with pytest.raises(ValueError, match="cannot train on 1 grasps"):
        train_network(TINY, IMAGES[:1], SLIPPED[:1], QUICK, seed=1)


def test_the_published_recipe_updates_as_keras_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forward, backward, L2 loss term, Adam and time decay of Keras 2.0.8, in numpy."""
    monkeypatch.setattr(networks, "build", lambda *_: plain_network())
    recipe = PublishedRecipe(epochs=6, batch=160, learning_rate=0.01, decay=0.5, l2=0.03)
    network = train_network(TINY, VECTORS, SLIPPED, recipe, seed=4)
    with reproducible(seed=4):
        start = plain_network()
    weights = [tensor.detach().double().numpy().copy() for tensor in start.parameters()]
    first = [np.zeros_like(weight) for weight in weights]
    second = [np.zeros_like(weight) for weight in weights]
    inputs, truth = VECTORS.astype(np.float64), np.eye(2)[SLIPPED.astype(np.int64)]
    for update in range(6):
        w1, b1, w2, b2 = weights
        before = inputs @ w1.T + b1
        hidden = np.maximum(before, 0.0)
        odds = np.exp(hidden @ w2.T + b2)
        error = (odds / odds.sum(axis=1, keepdims=True) - truth) / len(truth)
        back = error @ w2 * (before > 0.0)
        gradients = [
            back.T @ inputs + 2.0 * 0.03 * w1,  # of 0.03 * sum(w1**2)
            back.sum(axis=0),
            error.T @ hidden,
            error.sum(axis=0),
        ]
        rate = 0.01 / (1.0 + 0.5 * update)
        step = rate * np.sqrt(1.0 - 0.999 ** (update + 1)) / (1.0 - 0.9 ** (update + 1))
        for place, gradient in enumerate(gradients):
            first[place] = 0.9 * first[place] + 0.1 * gradient
            second[place] = 0.999 * second[place] + 0.001 * gradient**2
            weights[place] = weights[place] - step * first[place] / (np.sqrt(second[place]) + 1e-8)
    for tensor, expected in zip(network.parameters(), weights, strict=True):
        assert tensor.detach().numpy() == pytest.approx(expected, abs=2e-4)


@pytest.mark.parametrize(
    ("recipe", "momentum"),
    [(Recipe(epochs=1, batch=160), 0.1), (PublishedRecipe(epochs=1, batch=160), 0.01)],
)
def test_batch_norm_has_the_momentum_of_the_recipe(
    recipe: Recipe | PublishedRecipe, momentum: float
) -> None:
    with reproducible(seed=4), torch.no_grad():
        first = build(TINY)[:2](torch.from_numpy(IMAGES)).double().numpy()
    norm = train_network(TINY, IMAGES, SLIPPED, recipe, seed=4)[2]
    assert isinstance(norm, nn.BatchNorm2d)
    assert norm.running_mean is not None
    expected = momentum * first.mean(axis=(0, 2, 3))
    assert norm.running_mean.numpy() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("recipe", "grasps", "seen"),
    [
        (Recipe(epochs=1), 80, 64),  # a remainder would disturb the batch norm
        (PublishedRecipe(epochs=1), 80, 80),  # as Keras does
        (PublishedRecipe(epochs=1), 65, 64),  # no batch norm of one grasp
        (Recipe(epochs=1), 20, 20),
    ],
)
def test_an_epoch_sees_each_grasp_at_most_once(
    recipe: Recipe | PublishedRecipe, grasps: int, seen: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    batches: list[torch.Tensor] = []

    class Recorder(nn.Module):
        def forward(self, inputs: torch.Tensor) -> torch.Tensor:
            batches.append(inputs)
            return inputs

    network = nn.Sequential(Recorder(), *plain_network())
    monkeypatch.setattr(networks, "build", lambda *_: network)
    train_network(TINY, VECTORS[:grasps], SLIPPED[:grasps], recipe, seed=0)
    rows = {tuple(row) for row in torch.cat(batches).tolist()}
    assert len(rows) == sum(map(len, batches)) == seen


def test_day_shifts_change_the_weights_reproducibly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(networks, "build", lambda *_: plain_network(26))
    features = np.random.default_rng(0).normal(size=(len(SLIPPED), 26)).astype(np.float32)
    shifted = SessionRecipe(epochs=2)
    first = _weights(train_network(TINY, features, SLIPPED, shifted, seed=1))
    assert first == _weights(train_network(TINY, features, SLIPPED, shifted, seed=1))
    same_day = SessionRecipe(epochs=2, day_shift=DayShift(0.0, 0.0, 0.0))
    assert first != _weights(train_network(TINY, features, SLIPPED, same_day, seed=1))


def test_weight_decay_spares_biases_and_norms() -> None:
    network = build(TINY)
    for recipe in (Recipe(), PublishedRecipe()):
        optimizer, _ = optimization(network, recipe, 10)
        decayed, spared = optimizer.param_groups
        assert all(tensor.ndim > 1 for tensor in decayed["params"])
        assert spared["weight_decay"] == 0.0
        # The published regularizer leaves the last layer alone.
        assert len(decayed["params"]) == (3 if isinstance(recipe, Recipe) else 2)


def shifted(features: torch.Tensor, *shift: float) -> torch.Tensor:
    """Return features as on another day. `shift`: gain, finger gain and offset."""
    torch.manual_seed(0)
    return on_another_day(features, DayShift(*shift))


def test_each_feature_of_a_grasp_has_its_own_gain() -> None:
    exponents = shifted(torch.ones(4000, 52), 0.3, 0.0, 0.0).log()
    assert exponents.std(dim=0).numpy() == pytest.approx(0.3, abs=0.02)
    assert torch.corrcoef(exponents.T).fill_diagonal_(0.0).abs().max() < 0.1


def test_a_finger_gain_scales_that_fingers_24_electrodes_alone() -> None:
    features = shifted(torch.ones(4000, 52), 0.0, 0.3, 0.0)
    ff, th, rest = features[:, :24], features[:, 24:48], features[:, 48:]
    assert torch.equal(ff, ff[:, :1].expand(-1, 24))
    assert torch.equal(th, th[:, :1].expand(-1, 24))
    assert not torch.equal(ff[:, 0], th[:, 0])
    assert ff[:, 0].log().std().item() == pytest.approx(0.3, abs=0.02)
    assert torch.equal(rest, torch.ones(4000, 4))


def test_the_day_offset_moves_means_and_spreads_alone() -> None:
    features = shifted(torch.zeros(4000, 26), 0.0, 0.0, 0.7)
    assert torch.equal(features[:, :24], torch.zeros(4000, 24))
    assert features[:, 24:].std(dim=0).numpy() == pytest.approx(0.7, abs=0.04)
