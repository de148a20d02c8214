"""From a scene to the parts that it needs, and to no others: a driver is imported when named."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from daemon.judge.pipeline import Limits, Pipeline
from daemon.scene import (
    CanTactile,
    PalmJoints,
    PalmTactile,
    ReplayTactile,
    Scene,
    SceneError,
    SpiTactile,
    StreamJoints,
)
from drivers.base import Driver, DriverError, LinkError
from models import zoo
from models.contract import ModelError
from models.runtime import TactileModel

DEFAULT_MODEL = "small-session"

Clock = Callable[[], int]
"""Gives monotonic ns."""


def model_path(scene: Scene) -> Path:
    """File of the scene's model. Raises `ModelError` if the zoo does not have it."""
    if scene.model.path is not None:
        return scene.model.path
    return zoo.find(DEFAULT_MODEL if scene.model.name is None else scene.model.name)


def load_model(scene: Scene) -> TactileModel:
    """The scene's model, warm. Raises `ModelError`."""
    return TactileModel(model_path(scene))


def build_pipeline(
    scene: Scene,
    model: TactileModel,
    clock: Clock = time.monotonic_ns,
    *,
    learns: bool = True,
) -> Pipeline:
    """The judge of this scene, whose session `learns` from the grasps or stays what it is.

    Raises `ModelError` if the model does not fit the hand or never is right as often as wanted.
    """
    limits = Limits(
        max_age_ns=scene.max_age_ns,
        slip_threshold=scene.model.slip_threshold,
        min_confidence=min_confidence(model, scene.model.min_accuracy),
    )
    return Pipeline(model, scene.hand.fingers, limits, clock, learns=learns)


def min_confidence(model: TactileModel, min_accuracy: float | None) -> float:
    """From which confidence on the model's verdicts are right as often as wanted; 0 for None.

    By the accuracy-coverage curve of its contract, measured on objects that were left out. Raises
    `ModelError` if they never are.
    """
    if min_accuracy is None:
        return 0.0
    from_the_surest = reversed(model.contract.confidence)
    reached = list(itertools.takewhile(lambda s: s.accuracy >= min_accuracy, from_the_surest))
    if not reached:
        best = max((step.accuracy for step in model.contract.confidence), default=0.0)
        raise ModelError(
            f"{model.path}: model.min_accuracy {min_accuracy:g} is more than the model reaches, "
            f"{best:.3f} at best"
        )
    return reached[-1].confidence


def build_drivers(scene: Scene, clock: Clock = time.monotonic_ns) -> list[Driver]:
    """The drivers of this scene, not yet open, the tactile one first.

    Raises `SceneError` naming the section where values do not fit the driver or each other.
    """
    with _section("tactile"):
        drivers = [_tactile(scene, clock)]
    if isinstance(scene.joints, StreamJoints):
        from drivers.joints import JointStreamDriver

        with _section("joints"):
            drivers.append(JointStreamDriver(scene.joints.source, clock=clock))
    return drivers


def open_driver(driver: Driver) -> None:
    """Open a driver.

    Raises `LinkError` where a later try may succeed, and `SceneError` where none can: a recording
    or calibration with mistakes, a device of a kind that there is not.
    """
    try:
        driver.open()
    except LinkError:
        raise
    except (DriverError, ValueError) as error:
        raise SceneError(str(error)) from error


@contextmanager
def _section(name: str) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise SceneError(f"[{name}] {error}") from error


def _tactile(scene: Scene, clock: Clock) -> Driver:
    match scene.tactile:
        case ReplayTactile() as options:
            return _replay(scene, options, clock)
        case SpiTactile() as options:
            from drivers.spi_bridge import SpiBridgeDriver

            wanted = options.model_dump(exclude={"driver"})
            return SpiBridgeDriver(fingers=scene.hand.fingers, clock=clock, **wanted)
        case CanTactile() as options:
            from drivers.can_bridge import CanBridgeDriver

            wanted = options.model_dump(exclude={"driver"})
            return CanBridgeDriver(fingers=scene.hand.fingers, clock=clock, **wanted)
        case PalmTactile() as options:
            from drivers.palm import PalmDriver

            joints = scene.joints
            calibration = joints.calibration if isinstance(joints, PalmJoints) else None
            return PalmDriver(
                options.source,
                scene.hand.fingers,
                calibration=calibration,
                only_from=options.only_from,
                heed_finger_bits=options.heed_finger_bits,
                clock=clock,
            )


def _replay(scene: Scene, options: ReplayTactile, clock: Clock) -> Driver:
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
