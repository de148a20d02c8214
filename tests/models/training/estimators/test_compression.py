"""Smaller forms of a network: what they keep, and that they judge as their files do."""

from __future__ import annotations

import dataclasses
import importlib
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("onnxruntime.quantization")

import onnx
import torch
from numpy.typing import NDArray
from onnx import numpy_helper

from models.training.estimators import compression, graphs
from models.training.estimators.compression import (
    HalfWeights,
    Integers,
    LowRank,
    compressed,
    graph_margins,
)
from models.training.estimators.networks import NetworkConfig, build
from models.training.evaluating.campaign import campaign
from models.training.fitting.fit import fit
from models.training.systems.registry import SYSTEMS
from models.training.systems.system import digest, with_recipes
from tests.models.training.evaluation_samples import sessions

SHAPE = (12, 11, 3)
CONFIG = NetworkConfig(filters=4, hidden=32)


def inputs(number: int = 64) -> NDArray[np.float32]:
    return np.random.default_rng(0).standard_normal((number, *SHAPE)).astype(np.float32)


@pytest.fixture(scope="module")
def margin() -> onnx.ModelProto:
    torch.manual_seed(0)
    network = build(CONFIG, SHAPE)
    network.eval()
    return graphs.network_margin(network, SHAPE, "image")


def weights(model: onnx.ModelProto) -> dict[str, NDArray[np.float32]]:
    return {t.name: numpy_helper.to_array(t) for t in model.graph.initializer}


def test_half_weights_move_a_margin_by_the_rounding_of_a_half_and_no_more(
    margin: onnx.ModelProto,
) -> None:
    small = compressed(margin, HalfWeights(), inputs())
    exact, moved = graph_margins(margin, inputs()), graph_margins(small, inputs())
    # IEEE half: 11 bits, so a relative rounding of 2**-11 of each weight.
    assert 0.0 < np.abs(moved - exact).max() < 2.0**-11 * 30
    assert len(small.SerializeToString()) < 0.6 * len(margin.SerializeToString())


@pytest.mark.parametrize("rank", [1, 4, 16])
def test_a_factored_layer_is_the_best_approximation_of_its_rank(
    margin: onnx.ModelProto, rank: int
) -> None:
    small = compressed(margin, LowRank(rank), inputs())
    before = max(weights(margin).values(), key=lambda values: values.size)
    inner, outer = (
        next(v for name, v in weights(small).items() if name.endswith(end))
        for end in ("_inner", "_outer")
    )
    assert inner.shape == (rank, before.shape[1])
    assert outer.shape == (before.shape[0], rank)
    # Eckart, Young: no matrix of this rank is nearer than by the next singular values.
    beyond = np.linalg.svd(before.astype(np.float64), compute_uv=False)[rank:]
    distance = np.linalg.norm(before - outer.astype(np.float64) @ inner.astype(np.float64))
    assert distance == pytest.approx(np.sqrt((beyond**2).sum()), rel=1e-4)


def test_a_layer_factored_to_its_full_rank_judges_as_before(margin: onnx.ModelProto) -> None:
    small = compressed(margin, LowRank(32), inputs())
    np.testing.assert_allclose(
        graph_margins(small, inputs()), graph_margins(margin, inputs()), atol=1e-4
    )


@pytest.mark.parametrize("static", [False, True])
def test_integers_of_eight_bits_stay_near_the_margins(
    margin: onnx.ModelProto, static: bool
) -> None:
    small = compressed(margin, Integers(static), inputs())
    exact, moved = graph_margins(margin, inputs()), graph_margins(small, inputs())
    assert np.abs(moved - exact).max() < 0.1 * exact.std()
    assert any(values.dtype == np.int8 for values in weights(small).values())
    assert len(small.SerializeToString()) < 0.5 * len(margin.SerializeToString())


def test_a_reading_is_judged_alike_whatever_it_is_judged_with(margin: onnx.ModelProto) -> None:
    small = compressed(margin, Integers(static=False), inputs())
    one = np.concatenate([graph_margins(small, inputs()[i : i + 1]) for i in range(64)])
    np.testing.assert_array_equal(graph_margins(small, inputs()), one)


def test_the_original_is_left_as_it_was(margin: onnx.ModelProto) -> None:
    before = margin.SerializeToString(deterministic=True)
    for how in (HalfWeights(), LowRank(2), Integers(static=True)):
        compressed(margin, how, inputs())
    assert margin.SerializeToString(deterministic=True) == before


def test_a_graph_without_a_dense_layer_cannot_be_factored() -> None:
    node = onnx.helper.make_node("Identity", ["x"], ["margin"])
    value = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        [node], "g", [value("x", 1, [None, 1])], [value("margin", 1, [None, 1])]
    )
    with pytest.raises(ValueError, match="no dense layer"):
        compressed(onnx.helper.make_model(graph), LowRank(2), inputs())


def test_a_network_is_trained_once_for_all_its_forms(monkeypatch: pytest.MonkeyPatch) -> None:
    trainings = []
    system = with_recipes(SYSTEMS["narrow-4x32"], epochs=1)

    def counted(*arguments: Any, **more: Any) -> Any:  # noqa: ANN401 - passes them on
        trainings.append(arguments)
        return original(*arguments, **more)

    fitting = importlib.import_module("models.training.fitting.fit")

    original = fitting.train_network
    monkeypatch.setattr(fitting, "train_network", counted)
    slipped = np.arange(64) % 2 == 0
    fitted = [
        fit(dataclasses.replace(system, compression=how), inputs(), slipped, seed=0)
        for how in (HalfWeights(), LowRank(4), LowRank(8))
    ]
    assert len(trainings) == 1
    fit(dataclasses.replace(system, compression=LowRank(8)), inputs(), slipped, seed=1)
    assert len(trainings) == 2
    assert fitted[1].parameters < fitted[2].parameters


def test_forms_of_a_network_follow_each_other_and_others_keep_their_key() -> None:
    names = ["cnn1-rank-8", "svm", "cnn1-int8"]
    wanted = campaign([SYSTEMS[name] for name in names], ["cv"], sessions(60), seeds=1)
    first = [job.system.name for job in wanted.jobs[:4]]
    assert first == ["cnn1-rank-8", "cnn1-int8", "cnn1-rank-8", "cnn1-int8"]
    assert digest(SYSTEMS["cnn1-int8"]) != digest(SYSTEMS["cnn1"])
    assert digest(dataclasses.replace(SYSTEMS["cnn1-int8"], compression=None)) == digest(
        SYSTEMS["cnn1"]
    )
    assert compression.size(onnx.ModelProto()) == 0
