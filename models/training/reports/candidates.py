"""Candidates of `report error-vs-time`, timed: graspd's models, and the published code of `cnn1`.

The published network is not trained here, because its time does not depend on its weights. Steps
are timed in a hot loop and paced, one candidate after the other in every round.
"""

from __future__ import annotations

import gc
import math
import os
import time
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from graspd.biotac import TABLE_FINGERS
from graspd.models import zoo
from graspd.models.layout import D1
from graspd.models.runtime import TactileModel
from graspd.models.training.commands.common import say
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.estimators.configs import CNN1

CONFIDENCE = 0.95
WARM_UP = 20
ROUNDS = 10
"""Rounds of the hot loop, so that a busy second spoils only one of them."""
PERIOD_S = 0.01
"""Time between paced readings, s. Other work in between makes caches cold."""
QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999}

Row = dict[str, Any]
"""One candidate: `name`, `kind` (`model` or `peer`), `fingers`, `error` by protocol, `time`."""
Step = Callable[[int], object]
"""Function that does the timed work for the reading with this number."""
Times = dict[str, float]
"""`hot_p50_us`, `paced_p99_us` and so on, and `cpu_percent_at_100_hz`, the share of a core."""
Candidate = tuple[Row, Step]
"""Name, kind, fingers and error of a model or a peer, and its timed step."""


def candidates(grasps: Grasps) -> list[Candidate]:
    """Return the models of the zoo for the grasps' fingers, and the published code if Keras is
    installed. Raises `ModelError`."""
    zoo_models = (TactileModel(zoo.find(name)) for name in zoo.names())
    models = [
        _model(model, grasps)
        for model in zoo_models
        if set(model.contract.fingers) <= set(grasps.fingers)
    ]
    if find_spec("keras") is None:
        say("report", "keras is not installed: the published code is left out (extra: report)")
        return models
    published: Row = {
        "name": "published: loops, Keras predict",
        "kind": "peer",
        "fingers": TABLE_FINGERS,
        "error": next((row["error"] for row, _ in models if row["name"] == "cnn1"), {}),
    }
    return [*models, (published, _published(grasps.counts))]


def _model(model: TactileModel, grasps: Grasps) -> Candidate:
    name, fingers = model.contract.name, model.contract.fingers
    protocols = zoo.card(name)["protocols"]
    error = {protocol: errors(figures) for protocol, figures in protocols.items()}
    counts = grasps.of_fingers(fingers).counts

    def step(index: int) -> None:
        model.inputs.build(counts[index % len(counts)], model.input)
        model.run()

    return {"name": name, "kind": "model", "fingers": fingers, "error": error}, step


def errors(figures: dict[str, Any]) -> dict[str, float]:
    """Return `f1`, `accuracy`, `brier` and `ece`, 0..1, from a protocol's figures in a card.

    `low` to `high` is the 95 % interval of `f1` (Nadeau and Bengio)."""
    spreads, folds = figures["spreads"], figures["folds"]
    f1 = spreads["f1"]
    share = figures["test_grasps"] / figures["train_grasps"]
    error = f1["std"] * math.sqrt(1.0 / folds + share)
    reach = error * float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, folds - 1))
    return {
        "f1": f1["mean"],
        "low": max(f1["mean"] - reach, 0.0),
        "high": min(f1["mean"] + reach, 1.0),
        **{name: spreads[name]["mean"] for name in ("accuracy", "brier", "ece")},
    }


def loop_image(counts: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Return the image (12, 11, fingers) of counts (fingers, 24), as the authors' notebooks do."""
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
    os.environ.setdefault("KERAS_BACKEND", "torch")  # read when Keras is imported
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


def measure(steps: Mapping[str, Step], readings: int, paced: int) -> dict[str, Times]:
    """Return times of each step: of `readings` without pause (hot), and of `paced` at 100 Hz."""
    for step in steps.values():
        for index in range(WARM_UP):
            step(index)
    gc.disable()  # as timeit does
    try:
        hot = _hot(steps, readings // ROUNDS)
        cold, cpu = _paced(steps, paced)
    finally:
        gc.enable()
    return {name: _quantiles(hot[name], cold[name], cpu[name]) for name in steps}


def _hot(steps: Mapping[str, Step], readings: int) -> dict[str, list[int]]:
    """Return wall times by step, ns: `ROUNDS` times `readings` readings without pause."""
    times: dict[str, list[int]] = {name: [] for name in steps}
    for _ in range(ROUNDS):
        for name, step in steps.items():
            for index in range(readings):
                began_ns = time.perf_counter_ns()
                step(index)
                times[name].append(time.perf_counter_ns() - began_ns)
    return times


def _paced(
    steps: Mapping[str, Step], readings: int
) -> tuple[dict[str, list[int]], dict[str, list[int]]]:
    """Return wall and processor times by step, ns: a step every 10 ms, all in turns."""
    wall: dict[str, list[int]] = {name: [] for name in steps}
    cpu: dict[str, list[int]] = {name: [] for name in steps}
    due_s = time.perf_counter()
    for index in range(readings):
        for name, step in steps.items():
            due_s += PERIOD_S
            time.sleep(max(due_s - time.perf_counter(), 0.0))
            used_ns, began_ns = time.thread_time_ns(), time.perf_counter_ns()
            step(index)
            wall[name].append(time.perf_counter_ns() - began_ns)
            cpu[name].append(time.thread_time_ns() - used_ns)
    return wall, cpu


def _quantiles(hot_ns: list[int], paced_ns: list[int], cpu_ns: list[int]) -> Times:
    times = {"cpu_percent_at_100_hz": float(np.mean(cpu_ns)) * 1e-9 / PERIOD_S * 100.0}
    for kind, values_ns in (("hot", hot_ns), ("paced", paced_ns)):
        for name, share in QUANTILES.items():
            times[f"{kind}_{name}_us"] = float(np.quantile(values_ns, share)) / 1e3
    return times
