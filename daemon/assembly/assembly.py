"""Make the model, the judge and the drivers of a scene."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from graspd.daemon.judge.decision import GateLimits, HandLimits, JointLimits, Limits
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.process.files import write_atomically
from graspd.daemon.scene import Scene, SceneError
from graspd.daemon.scene.drivers import (
    CanTactile,
    PalmJoints,
    PalmTactile,
    ReplayTactile,
    SpiTactile,
    StreamJoints,
)
from graspd.daemon.scene.scene import GateMode
from graspd.daemon.trust.trust import Trust
from graspd.drivers.base import Driver, DriverError, LinkError
from graspd.extras import require
from graspd.models import trial, zoo
from graspd.models.contract import ModelError, SessionInput
from graspd.models.runtime import TactileModel
from graspd.models.trust.risk import RiskLimits

if TYPE_CHECKING:
    from graspd.drivers.recordings.csv_rows import Columns

DEFAULT_MODEL = "small-session"
RECORDED_MAX_AGE_MS = 1000.0
"""Age limit of recorded readings, ms; generous, because a recording has no link to be late on."""
NO_SILENCE_NS = 3_600_000_000_000
"""Time without a reading, ns, that counts as silence: no pause of a recording does."""
MCAP = ".mcap"


def model_path(scene: Scene) -> Path:
    """Return the model file for the hand's fingers. Raises `ModelError`."""
    if scene.model.path is not None:
        return scene.model.path
    name = DEFAULT_MODEL if scene.model.name is None else scene.model.name
    return zoo.find(zoo.for_hand(name, scene.hand.fingers))


def load_model(scene: Scene) -> TactileModel:
    """Load the scene's model and run it once. Raises `ModelError`."""
    return trial.load(model_path(scene))


def keep_digest(model: TactileModel) -> Iterator[str]:
    """Write a card beside an own model without one: a later change of the model is refused.

    Yield a warning if that is impossible.
    """
    about = model.path.with_suffix(".json")
    if not zoo.ships(model.path, model.sha256) and not about.exists():
        try:
            write_atomically(about, json.dumps(trial.card(model.path)).encode(), mode=0o644)
        except OSError as error:
            yield f"{about}: cannot keep the model's digest, to notice a change: {error.strerror}"


def build_pipeline(
    scene: Scene,
    model: TactileModel,
    clock: Callable[[], int] = time.monotonic_ns,
    *,
    learns: bool = True,
) -> Pipeline:
    """Build the scene's judge. Raises `ModelError`, `SceneError` or `RecordingError`."""
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
        hand=hand_limits(scene),
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
    """Return advice on `tactile.sensors` if sensors are wired in the order of `hand.fingers`."""
    match scene.tactile:
        case SpiTactile(sensors=None) | CanTactile(sensors=None):
            return f" and tactile.sensors = {json.dumps(scene.hand.fingers)}, as they are wired"
        case _:
            return ""


def gate_mode(scene: Scene) -> GateMode:
    """Return the gate's mode; without `gate.mode` the recordings decide. Raises `SceneError`."""
    if scene.gate.mode is not None:
        return scene.gate.mode
    if not isinstance(scene.tactile, ReplayTactile) or is_mcap(scene.tactile):
        return "settled"
    streams = {columns.is_stream for columns in _columns(scene, scene.tactile)}
    if len(streams) > 1:
        raise SceneError("tactile.recordings: both grasp tables and streams; say gate.mode")
    return "settled" if True in streams else "every"


def hand_limits(scene: Scene) -> HandLimits | None:
    """Return the limits of the gate; None in mode `every`."""
    mode, gate = gate_mode(scene), scene.gate
    if mode == "every":
        return None
    return HandLimits(
        on_request=mode == "request",
        required=gate.fingers,
        gate=GateLimits(
            false_alarms=gate.false_alarms,
            early=gate.early,
            request_ns=round(gate.request_ms * 1e6),
        ),
        joints=JointLimits() if has_joints(scene) else None,
    )


def _columns(scene: Scene, options: ReplayTactile) -> list[Columns]:
    from graspd.drivers.recordings.csv_rows import columns_of

    return [columns_of(path, scene.hand.fingers) for path in options.recordings]


def is_mcap(options: ReplayTactile) -> bool:
    """Return True for recordings of graspd.

    Raises `SceneError` if some are CSV files, or if the package that reads MCAP is missing.
    """
    kinds = {path.suffix == MCAP for path in options.recordings}
    if len(kinds) > 1:
        raise SceneError("tactile.recordings: both CSV and MCAP files")
    if True in kinds:
        require_mcap("replaying MCAP")
    return True in kinds


def require_mcap(what: str) -> None:
    """Raise `SceneError`, with advice, if `what` lacks the package of the extra `record`."""
    try:
        require("mcap", what, "record")
    except ModuleNotFoundError as error:
        raise SceneError(str(error)) from error


def has_joints(scene: Scene) -> bool:
    """Return True if joint angles come, from their own source or in a recording."""
    options = scene.tactile
    if scene.joints is not None or not isinstance(options, ReplayTactile):
        return scene.joints is not None
    if not is_mcap(options):
        return any(columns.joints for columns in _columns(scene, options))
    from graspd.daemon.record.mcap import header_of

    return any(header_of(path).joints for path in options.recordings)


def refuse_absent_processors(scene: Scene) -> None:
    """Raise `SceneError` if this computer lacks a processor of `[realtime]`."""
    number = os.sysconf("SC_NPROCESSORS_CONF")
    for cpu in (scene.realtime and scene.realtime.cpus) or ():
        if cpu >= number:
            raise SceneError(f"realtime.cpus: no processor {cpu}: there are 0 to {number - 1}")


def build_drivers(scene: Scene) -> list[Driver]:
    """Make the drivers, not open yet, the tactile one first. Raises `SceneError`."""
    with _section("tactile"):
        drivers = [_tactile(scene)]
    if isinstance(scene.joints, StreamJoints):
        from graspd.drivers.joints import JointStreamDriver

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
    """Open the tactile driver if it plays files, and read the joints' calibration; no device.

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


def _tactile(scene: Scene) -> Driver:
    match scene.tactile:
        case ReplayTactile() as options:
            return _replay(scene, options)
        case SpiTactile() as options:
            from graspd.drivers.spi.driver import SpiBridgeDriver

            arguments = options.model_dump(exclude={"driver"})
            return SpiBridgeDriver(fingers=scene.hand.fingers, **arguments)
        case CanTactile() as options:
            from graspd.drivers.can.driver import CanBridgeDriver

            arguments = options.model_dump(exclude={"driver"})
            return CanBridgeDriver(fingers=scene.hand.fingers, **arguments)
        case PalmTactile() as options:
            return _palm(scene, options)


def _palm(scene: Scene, options: PalmTactile) -> Driver:
    from graspd.drivers.palm.stream import PalmDriver

    joints = scene.joints
    return PalmDriver(
        fingers=scene.hand.fingers,
        calibration=joints.calibration if isinstance(joints, PalmJoints) else None,
        **options.model_dump(exclude={"driver"}),
    )


def _replay(scene: Scene, options: ReplayTactile) -> Driver:
    speed = 1.0 if options.pace == "realtime" else None
    if is_mcap(options):
        return _replay_mcap(scene, options, speed)
    from graspd.drivers.recordings.csv_player import ReplayDriver
    from graspd.drivers.recordings.csv_rows import SLIPPED

    if options.outcomes and not all(columns.has_labels for columns in _columns(scene, options)):
        raise ValueError(f"outcomes needs the column `{SLIPPED}` in every recording")
    return ReplayDriver(
        options.recordings,
        scene.hand.fingers,
        speed=speed,
        loop=options.loop,
    )


def _replay_mcap(scene: Scene, options: ReplayTactile, speed: float | None) -> Driver:
    if options.loop:
        raise ValueError("MCAP files are replayed as they are: no loop")
    if options.outcomes:
        raise ValueError("MCAP files have no outcomes to tell: outcomes is for CSV files")
    from graspd.daemon.record.player import McapReplayDriver

    return McapReplayDriver(options.recordings, scene.hand.fingers, speed=speed)
