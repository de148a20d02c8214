"""From a scene to the parts that it needs, and to no others: a driver is imported when named."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from daemon.judge.pipeline import Limits, Pipeline
from daemon.scene import ReplayTactile, Scene
from drivers.base import Driver
from models import zoo
from models.runtime import TactileModel

DEFAULT_MODEL = "cnn1"


def model_path(scene: Scene) -> Path:
    """File of the scene's model. Raises `ModelError` if the zoo does not have it."""
    return scene.model.path or zoo.find(scene.model.name or DEFAULT_MODEL)


def load_model(scene: Scene) -> TactileModel:
    """The scene's model, warm. Raises `ModelError`."""
    return TactileModel(model_path(scene))


def build_pipeline(
    scene: Scene, model: TactileModel, clock: Callable[[], int] = time.monotonic_ns
) -> Pipeline:
    """The judge of this scene. Raises `ModelError` if the model does not fit the hand."""
    limits = Limits(max_age_ns=scene.max_age_ns, slip_threshold=scene.model.slip_threshold)
    return Pipeline(model, scene.hand.fingers, limits, clock)


def build_driver(scene: Scene, clock: Callable[[], int] = time.monotonic_ns) -> Driver:
    """The tactile driver of this scene, not yet open."""
    return _replay(scene, scene.tactile, clock)


def _replay(scene: Scene, options: ReplayTactile, clock: Callable[[], int]) -> Driver:
    from drivers.faults import ReplayFaults
    from drivers.replay import Pace, ReplayDriver

    return ReplayDriver(
        options.recordings,
        scene.hand.fingers,
        pace=Pace(options.pace),
        speed=options.speed,
        rate_hz=options.rate_hz,
        loop=options.loop,
        strict=options.strict,
        faults=ReplayFaults(**options.faults.model_dump()),
        clock=clock,
    )
