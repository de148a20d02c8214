"""The same reading judged in other ways: the published method's own, PyTorch, scikit-learn.

Their networks are not trained: how long one takes does not depend on its weights. The classical
ones are, because it depends on what they have kept.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper

from daemon.measure.error_vs_time.timing import Step
from models.inputs import VectorBuilder
from models.layout import D1
from models.runtime import single_threaded
from models.tactile_image import TactileImager
from models.training.data.datasets import Grasps
from models.training.estimators.classical import ForestConfig, MlpConfig, SvmConfig, fit_classical
from models.training.estimators.networks import CNN1, build
from models.training.systems.registry import SYSTEMS

CLASSICAL = ("svm", "mlp", "rf")


def peers(grasps: Grasps) -> Iterator[tuple[str, Step]]:
    """Name and step of each peer that can be run here; `grasps` are what is read."""
    counts = grasps.counts
    if find_spec("keras") is not None:
        yield "published: loops, Keras predict", _published(counts)
    yield "PyTorch eager, CNN1", _torch(counts)
    for name in CLASSICAL:
        yield f"scikit-learn predict_proba, {name}", _classical(name, grasps)


def empty_session() -> Step:
    """A network that does nothing: what onnxruntime costs by itself."""
    given = helper.make_tensor_value_info("given", TensorProto.FLOAT, [1, 2])
    out = helper.make_tensor_value_info("out", TensorProto.FLOAT, [1, 2])
    graph = helper.make_graph(
        [helper.make_node("Identity", ["given"], ["out"])], "nothing", [given], [out]
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    session = single_threaded(model.SerializeToString())
    binding = session.io_binding()
    values, answer = np.zeros((1, 2), np.float32), np.zeros((1, 2), np.float32)
    binding.bind_input("given", "cpu", 0, np.float32, values.shape, values.ctypes.data)
    binding.bind_output("out", "cpu", 0, np.float32, answer.shape, answer.ctypes.data)

    def step(_index: int, _kept: tuple[object, ...] = (values, answer)) -> None:
        session.run_with_iobinding(binding)

    return step


def loop_image(counts: NDArray[np.uint16]) -> NDArray[np.float32]:
    """The tactile image of counts (fingers, 24) as the authors' notebooks make it: pixel by pixel.

    Shape (12, 11, fingers). The same image as `TactileImager`'s, only slower.
    """
    height, width = D1.shape
    images = []
    for finger in counts:
        image = np.zeros((height, width))
        filled = np.zeros((height, width), dtype=bool)
        for electrode in range(len(finger)):
            image[D1.rows[electrode], D1.columns[electrode]] = finger[electrode]
            filled[D1.rows[electrode], D1.columns[electrode]] = True
        while not filled.all():
            before, known = image.copy(), filled.copy()
            for row in range(height):
                for column in range(width):
                    if known[row, column]:
                        continue
                    around = [
                        before[y, x]
                        for y in range(max(row - 1, 0), min(row + 2, height))
                        for x in range(max(column - 1, 0), min(column + 2, width))
                        if known[y, x]
                    ]
                    if around:
                        image[row, column] = sum(around) / len(around)
                        filled[row, column] = True
        images.append((image - image.mean()) / image.std())
    return np.stack(images, axis=-1).astype(np.float32)


def _published(counts: NDArray[np.uint16]) -> Step:
    # Keras reads it once, when it is imported; it is nobody's setting but Keras'.
    os.environ.setdefault("KERAS_BACKEND", "torch")
    import keras

    layers = keras.layers
    model = keras.Sequential(
        [
            keras.Input((*D1.shape, counts.shape[1])),
            layers.Conv2D(CNN1.filters, 3, use_bias=False),
            layers.BatchNormalization(),
            layers.ReLU(),
            layers.Flatten(),
            layers.Dense(CNN1.hidden),
            layers.BatchNormalization(),
            layers.ReLU(),
            layers.Dense(2, activation="softmax"),
        ]
    )
    return lambda index: model.predict(
        loop_image(counts[index % len(counts)])[np.newaxis], verbose=0
    )


def _torch(counts: NDArray[np.uint16]) -> Step:
    imager = TactileImager(counts.shape[1])
    image = np.zeros(imager.shape, dtype=np.float32)
    network = build(CNN1, imager.shape)
    network.eval()
    given = torch.from_numpy(image[np.newaxis])

    def step(index: int) -> None:
        imager.build(counts[index % len(counts)], image)
        with torch.inference_mode():
            torch.softmax(network(given), dim=1)

    return step


def _classical(name: str, grasps: Grasps) -> Step:
    builder = VectorBuilder(grasps.counts.shape[1])
    inputs, _ = builder.build_batch(grasps.counts)
    config = SYSTEMS[name].estimator
    if not isinstance(config, SvmConfig | MlpConfig | ForestConfig):
        raise TypeError(f"{name} is no system of scikit-learn")
    model: Any = fit_classical(config, inputs, grasps.slipped, 0)
    vector = np.zeros((1, *builder.shape), dtype=np.float32)
    # A support vector machine has probabilities only if it was asked for them when it was fitted.
    judge = getattr(model, "predict_proba", None) or model.decision_function

    def step(index: int) -> None:
        builder.build(grasps.counts[index % len(grasps.counts)], vector[0])
        judge(vector)

    return step
