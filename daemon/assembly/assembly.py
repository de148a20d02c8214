"""Make the model, the judge and the drivers of a scene."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from graspd.daemon.assembly.plan import NO_SWEEPS, Plan, recorded_kind
from graspd.daemon.judge.decision import Limits
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.process.files import require_linux, write_atomically
from graspd.daemon.scene import Scene, SceneError
from graspd.daemon.scene.drivers import (
    CanTactile,
    DatagramsTactile,
    PalmJoints,
    PalmTactile,
    ReplayTactile,
    SpiTactile,
    StreamJoints,
)
from graspd.daemon.trust.trust import Trust
from graspd.drivers.base import Driver, DriverError, LinkError
from graspd.drivers.recordings.kinds import BAGS, Kind
from graspd.models import trial, zoo
from graspd.models.contract import ModelError, SessionInput
from graspd.models.runtime import TactileModel
from graspd.models.trust.risk import RiskLimits

if TYPE_CHECKING:
    from graspd.daemon.record.player import McapReplayDriver
    from graspd.drivers.recordings.bag import BagDriver
    from graspd.drivers.recordings.csv_player import ReplayDriver

DEFAULT_MODEL = "small-session"
RECORDED_MAX_AGE_MS = 1000.0
"""Time without a reading that counts as silence in a replay at a given speed, ms."""
NO_SILENCE_NS = 3_600_000_000_000
"""Value of the silence limit, ns, that no pause of a recording reaches."""


def model_path(scene: Scene) -> Path:
    """Return the path of the scene's model; of a named one, the file for the hand's fingers.

    Raises `ModelError` for an unknown name.
    """
    if scene.model.path is not None:
        return scene.model.path
    name = DEFAULT_MODEL if scene.model.name is None else scene.model.name
    return zoo.find(zoo.for_hand(name, scene.hand.fingers))


def load_model(scene: Scene) -> TactileModel:
    """Load the scene's model and run it once. Raises `ModelError`."""
    return trial.load(model_path(scene))


def keep_digest(model: TactileModel) -> Iterator[str]:
    """Write a card beside a user's model that has none, so that a later change of it is refused.

    Yield a warning if the card cannot be written.
    """
    about = model.path.with_suffix(".json")
    if not zoo.ships(model.path, model.sha256) and not about.exists():
        try:
            write_atomically(about, json.dumps(trial.card(model.path)).encode(), mode=0o644)
        except OSError as error:
            yield f"{about}: cannot keep the model's digest, to notice a change: {error.strerror}"


def build_pipeline(
    plan: Plan,
    model: TactileModel,
    clock: Callable[[], int] = time.monotonic_ns,
    *,
    learns: bool = True,
) -> Pipeline:
    """Build the scene's judge. `clock`: monotonic ns. `learns`: True lets judged grasps calibrate
    its session. Raises `ModelError`."""
    scene = plan.scene
    _refuse_other_fingers(scene, model)
    limits = Limits(
        max_age_ns=scene.max_age_ns,
        slip_threshold=scene.model.slip_threshold,
        min_confidence=scene.model.min_confidence,
    )
    return Pipeline(
        model,
        scene.hand.fingers,
        limits,
        clock,
        hand=plan.hand,
        learns=learns,
        needs_session=scene.session.required,
        trust=_trust(scene, model),
    )


def _trust(scene: Scene, model: TactileModel) -> Trust | None:
    risk, given = scene.risk, model.contract.input
    if risk is None and not scene.learn.enabled:
        return None
    limits = RiskLimits() if risk is None else RiskLimits(**risk.model_dump())
    inputs = len(given.mean) if isinstance(given, SessionInput) else 0
    return Trust(model.sha256, inputs, limits, learns=scene.learn.enabled)


def _refuse_other_fingers(scene: Scene, model: TactileModel) -> None:
    """Raise `ModelError`, with advice, if the model is not for the hand's fingers."""
    expected, hand = model.contract.fingers, scene.hand.fingers
    if hand == expected:
        return
    if set(hand) == set(expected):
        advice = f"write hand.fingers = {json.dumps(expected)}{_and_sensors(scene)}"
    elif names := zoo.judging(hand):
        advice = f"the zoo has {', '.join(names)} for these"
    else:
        advice = "the zoo has no model for these"
    raise ModelError(
        f"{model.path}: judges the fingers {', '.join(expected)} in this order, "
        f"the hand has {', '.join(hand)}: {advice}"
    )


def _and_sensors(scene: Scene) -> str:
    """Return advice to write `tactile.sensors`, if a driver with that key lacks it, else ""."""
    match scene.tactile:
        case SpiTactile(sensors=None) | CanTactile(sensors=None):
            return f" and tactile.sensors = {json.dumps(scene.hand.fingers)}, as they are wired"
        case _:
            return ""


def refuse_absent_processors(scene: Scene) -> None:
    """Raise `SceneError` if this computer lacks a processor of `[realtime]`."""
    cpus = scene.realtime and scene.realtime.cpus
    if not cpus:
        return
    require_linux("realtime.cpus")
    number = os.sysconf("SC_NPROCESSORS_CONF")
    for cpu in cpus:
        if cpu >= number:
            raise SceneError(f"realtime.cpus: no processor {cpu}: there are 0 to {number - 1}")


def build_drivers(plan: Plan) -> list[Driver]:
    """Make the drivers, not open yet, the tactile one first. Raises `SceneError`."""
    scene = plan.scene
    with _section("tactile"):
        drivers = [_tactile(plan)]
    if isinstance(scene.joints, StreamJoints):
        from graspd.drivers.datagrams.joints import JointStreamDriver

        with _section("joints"):
            drivers.append(JointStreamDriver(scene.joints.source, only_from=scene.joints.only_from))
    return drivers


def open_driver(driver: Driver) -> None:
    """Open a driver. Raises `LinkError` if a retry may succeed, else `SceneError`."""
    try:
        driver.open()
    except LinkError:
        raise
    except (DriverError, ValueError) as error:
        raise SceneError(str(error)) from error


def open_file(scene: Scene, driver: Driver) -> None:
    """Open the tactile driver if it plays files, and read the joints' calibration; open no device.

    Raises as `open_driver`, and `DriverError` for a wrong calibration.
    """
    if isinstance(scene.tactile, ReplayTactile):
        open_driver(driver)
    if isinstance(scene.joints, PalmJoints):
        from graspd.drivers.palm.calibration import load_calibration

        load_calibration(scene.joints.calibration)


@contextmanager
def _section(name: str) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise SceneError(f"[{name}] {error}") from error


def _tactile(plan: Plan) -> Driver:
    fingers, joints = plan.scene.hand.fingers, plan.scene.joints
    options = plan.scene.tactile
    arguments = options.model_dump(exclude={"driver"})
    match options:
        case ReplayTactile():
            return player(plan, options, 1.0 if options.pace == "realtime" else None)
        case SpiTactile():
            from graspd.drivers.spi.driver import SpiBridgeDriver

            return SpiBridgeDriver(fingers=fingers, **arguments)
        case CanTactile():
            from graspd.drivers.can.driver import CanBridgeDriver

            return CanBridgeDriver(fingers=fingers, **arguments)
        case PalmTactile():
            from graspd.drivers.palm.stream import PalmDriver

            calibration = joints.calibration if isinstance(joints, PalmJoints) else None
            return PalmDriver(fingers=fingers, calibration=calibration, **arguments)
        case DatagramsTactile():
            from graspd.drivers.datagrams.tactile import TactileStreamDriver

            return TactileStreamDriver(fingers=fingers, hand=plan.scene.hand.name, **arguments)


def player(
    plan: Plan,
    options: ReplayTactile,
    speed: float | None,
    *,
    strict: bool = False,
    outcomes: bool = False,
) -> ReplayDriver | BagDriver | McapReplayDriver:
    """Make the driver that plays a scene's recordings. Raises `ValueError`.

    `speed`: factor of real time; None: as fast as possible. `strict`: a value in a table that is
    not a count ends the replay with an error. `outcomes`: so does an unreadable outcome.
    """
    fingers, kind = plan.scene.hand.fingers, recorded_kind(options)
    if kind in BAGS:
        from graspd.drivers.recordings.bag import BagDriver

        return BagDriver(options.recordings, fingers, speed=speed)
    if kind is Kind.MCAP:
        if plan.mode == "every":
            raise ValueError(NO_SWEEPS)
        from graspd.daemon.record.player import McapReplayDriver

        return McapReplayDriver(options.recordings, fingers, speed=speed)
    from graspd.drivers.recordings.columns import SLIPPED
    from graspd.drivers.recordings.csv_player import ReplayDriver

    if options.outcomes and plan.without_outcomes:
        raise ValueError(
            f"outcomes needs the column `{SLIPPED}` in every recording, with some in it"
        )
    return ReplayDriver(
        options.recordings,
        fingers,
        layouts=plan.layouts,
        speed=speed,
        rate_hz=options.rate_hz,
        loop=options.loop,
        strict=strict,
        outcomes=outcomes or options.outcomes,
    )
