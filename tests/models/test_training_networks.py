"""The network, its training and its export."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("torch", reason="the train extra is not installed")
pytest.importorskip("onnx", reason="the train extra is not installed")

import onnxruntime as ort
import torch
from torch import nn

from models.contract import ModelContract
from models.runtime import TactileModel
from models.tactile_image import TactileImager
from models.training import export as export_module
from models.training.datasets import Grasps
from models.training.export import ExportError, export
from models.training.making import Order, make
from models.training.networks import (
    CNN1,
    NetworkConfig,
    build,
    for_inference,
    parameter_count,
)
from models.training.recipe import Recipe, logits, reproducible, train
from tests.models.training_samples import separable_counts

TINY = NetworkConfig("tiny", filters=4, hidden=16)
QUICK = Recipe(epochs=4, threads=1)


@pytest.fixture(scope="module")
def images() -> NDArray[np.float32]:
    return TactileImager(3).build_batch(separable_counts(160)[0])[0]


@pytest.fixture(scope="module")
def slipped() -> NDArray[np.bool_]:
    return separable_counts(160)[1]


@pytest.fixture(scope="module")
def trained(images: NDArray[np.float32], slipped: NDArray[np.bool_]) -> nn.Sequential:
    return train(TINY, images, slipped, QUICK, seed=1)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    counts, slipped = separable_counts(80)
    grasps = Grasps(counts, slipped, ("ball",) * 80, ())
    out = tmp_path_factory.mktemp("made")
    make(Order(TINY, Recipe(epochs=2, threads=1), folds=2, seed=4), grasps, None, out)
    return out / "tiny.onnx"


def test_cnn1_has_the_parameters_of_the_published_network() -> None:
    assert parameter_count(build(CNN1)) == 2_955_170


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


@pytest.mark.parametrize("finger", [0, 1, 2])
def test_each_finger_is_one_input_channel(finger: int, images: NDArray[np.float32]) -> None:
    with reproducible(seed=2):
        network = build(TINY).eval()
    convolution = network[1]
    assert isinstance(convolution, nn.Conv2d)
    with torch.no_grad():
        convolution.weight[:, [other for other in range(3) if other != finger]] = 0.0
    before = logits(network, images)
    for changed in range(3):
        other = images.copy()
        other[..., changed] = images[::-1, ..., changed]
        assert np.array_equal(logits(network, other), before) == (changed != finger)


def test_rows_and_columns_are_not_swapped(images: NDArray[np.float32]) -> None:
    """One filter that passes one pixel on shows where the convolution finds it."""
    with reproducible(seed=2):
        network = build(TINY).eval()
    convolution = network[1]
    assert isinstance(convolution, nn.Conv2d)
    with torch.no_grad():
        convolution.weight.zero_()
        convolution.weight[0, 2, 0, 1] = 1.0  # thumb, the row above the centre
        seen = network[:2](torch.from_numpy(images))[:, 0].numpy()
    assert seen.shape == (160, 10, 9)
    assert np.array_equal(seen, images[:, 0:10, 1:10, 2])


def test_a_tiny_training_learns_what_can_be_separated(
    trained: nn.Sequential, images: NDArray[np.float32], slipped: NDArray[np.bool_]
) -> None:
    counts, labels = separable_counts(100, seed=8)
    unseen = TactileImager(3).build_batch(counts)[0]
    assert ((logits(trained, images).argmax(axis=1) == 1) == slipped).all()
    assert ((logits(trained, unseen).argmax(axis=1) == 1) == labels).all()


def _weights(network: nn.Sequential) -> list[float]:
    return [value for tensor in network.state_dict().values() for value in tensor.ravel().tolist()]


def test_the_same_seed_gives_the_same_weights_and_another_gives_others(
    trained: nn.Sequential, images: NDArray[np.float32], slipped: NDArray[np.bool_]
) -> None:
    torch.manual_seed(99)  # the state around a training does not matter
    assert _weights(train(TINY, images, slipped, QUICK, seed=1)) == _weights(trained)
    assert _weights(train(TINY, images, slipped, QUICK, seed=2)) != _weights(trained)


def test_training_leaves_torch_as_it_was(
    images: NDArray[np.float32], slipped: NDArray[np.bool_]
) -> None:
    threads, state = torch.get_num_threads(), torch.random.get_rng_state()
    train(TINY, images, slipped, Recipe(epochs=1, threads=threads + 1), seed=1)
    assert torch.get_num_threads() == threads
    assert not torch.are_deterministic_algorithms_enabled()
    assert torch.equal(torch.random.get_rng_state(), state)


def test_every_epoch_is_reported(images: NDArray[np.float32], slipped: NDArray[np.bool_]) -> None:
    epochs: list[None] = []
    train(TINY, images, slipped, QUICK, seed=1, on_epoch=lambda: epochs.append(None))
    assert len(epochs) == 4


@pytest.mark.parametrize("grasps", [0, 1])
def test_training_on_less_than_two_grasps_is_refused(
    grasps: int, images: NDArray[np.float32], slipped: NDArray[np.bool_]
) -> None:
    with pytest.raises(ValueError, match=f"cannot train on {grasps} grasps"):
        train(TINY, images[:grasps], slipped[:grasps], QUICK, seed=1)


@pytest.mark.parametrize("temperature", [0.5, 1.0, 2.5])
def test_folding_batch_norm_and_temperature_changes_no_probability(
    trained: nn.Sequential, images: NDArray[np.float32], temperature: float
) -> None:
    folded = for_inference(trained, temperature)
    assert not any("Norm" in type(layer).__name__ for layer in folded)
    scaled = np.exp(logits(trained, images) / temperature)
    expected = scaled / scaled.sum(axis=1, keepdims=True)
    assert np.abs(logits(folded, images) - expected).max() < 1e-5
    assert len(trained) == 9, "the trained network itself must stay as it is"


def test_the_file_takes_any_number_of_images(made: Path, images: NDArray[np.float32]) -> None:
    session = ort.InferenceSession(made, providers=["CPUExecutionProvider"])
    (taken,), (given,) = session.get_inputs(), session.get_outputs()
    assert (taken.name, taken.type, taken.shape[1:]) == (
        "tactile_image",
        "tensor(float)",
        [12, 11, 3],
    )
    assert (given.name, given.type, given.shape[1:]) == ("probability", "tensor(float)", [2])
    model = TactileModel(made)
    for number in (1, 2, 7):
        (together,) = session.run(None, {"tactile_image": images[:number]})
        assert together.shape == (number, 2)
        for image, row in zip(images, together, strict=False):
            model.image[...] = image
            assert model.run() == pytest.approx(tuple(row), abs=1e-6)


def test_the_file_is_one_and_tells_nothing_of_the_machine(made: Path) -> None:
    assert sorted(path.name for path in made.parent.iterdir()) == ["tiny.json", "tiny.onnx"]
    for path in made.parent.iterdir():
        text = path.read_bytes().decode("latin-1")
        for trace in (str(Path(__file__).parents[2]), str(Path.home()), "site-packages", ".py"):
            assert trace not in text
        assert not re.search(r"/(tmp|home|usr|work|root)/", text)


def test_the_same_order_makes_the_same_bytes(made: Path, tmp_path: Path) -> None:
    counts, slipped = separable_counts(80)
    grasps = Grasps(counts, slipped, ("ball",) * 80, ())
    make(Order(TINY, Recipe(epochs=2, threads=1), folds=2, seed=4), grasps, None, tmp_path)
    for name in ("tiny.onnx", "tiny.json"):
        assert (tmp_path / name).read_bytes() == made.with_name(name).read_bytes()


def test_a_file_that_judges_otherwise_is_not_written(
    made: Path, trained: nn.Sequential, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def warmer(network: nn.Sequential, temperature: float) -> nn.Sequential:
        return for_inference(network, temperature * 1.01)

    monkeypatch.setattr(export_module, "for_inference", warmer)
    path = tmp_path / "tiny.onnx"
    path.write_bytes(b"the file before")
    contract: ModelContract = TactileModel(made).contract
    with pytest.raises(ExportError, match="differs from the network"):
        export(trained, 1.0, contract, separable_counts(40)[0], path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["tiny.onnx"]
    assert path.read_bytes() == b"the file before"
