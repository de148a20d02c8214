"""Build scene and judge to replay grasp tables and streams (CSV), ROS bags and link logs."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from graspd.biotac import FINGERS, Finger
from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import Parts
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.publish.companion import Companion
from graspd.daemon.scene import Scene, SceneError
from graspd.daemon.scene.drivers import CanTactile, ReplayTactile, SpiTactile
from graspd.daemon.scene.scene import Hand
from graspd.drivers.recordings.columns import MissingFingersError
from graspd.drivers.recordings.kinds import BAGS, CAN_LOGS, Kind, kind_of, kind_of_all
from graspd.drivers.recordings.layout import ReadAs
from graspd.models import zoo
from graspd.models.runtime import TactileModel

if TYPE_CHECKING:
    from graspd.drivers.recordings.player import LinkLogDriver

DRAWS = "replay"
"""`boot_id` of a replayed table or link log; it fixes the random draws of lifts to supervise."""
LINK_LOGS = {Kind.SERIAL: "spi", **dict.fromkeys(CAN_LOGS, "can")}
"""Name of the driver for each kind of link log."""
LINK_SECTIONS = ("hand", "tactile", "model", "gate", "session", "learn", "risk")
"""Sections of a scene that count for a link log, which has no joints."""


def model_keys(model: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the keys of `[model]` for the name of a model or for the path of an ONNX file."""
    if isinstance(model, str) and not model.endswith(".onnx"):
        return {"name": model}
    return {"path": Path(model).absolute()}


class Source:
    """Recorded readings to judge again, and the sections of the scene that judges them."""

    def __init__(self, sections: Mapping[str, dict[str, Any]], where: Path) -> None:
        """`sections`: those of the scene by name. `where`: their file, for messages; relative paths
        begin in its folder."""
        self._sections = sections
        self._where = where

    def scene(self, publish: dict[str, Any], model: dict[str, Any], mode: str | None) -> Scene:
        """Return the scene with the keys `publish` for `[publish]`. Raises `SceneError`.

        `model`: key `name` or `path` of another model; thresholds stay. Empty: the same model.
        `mode`: mode of the gate; None: that of the sections, else by the files.
        """
        former = self._sections.get("model", {})
        if model:
            former = {key: value for key, value in former.items() if key not in ("name", "path")}
        gate = self._sections.get("gate", {}) | ({} if mode is None else {"mode": mode})
        changes = {"model": former | model, "gate": gate, "publish": publish}
        return scene.parse({**self._sections, **changes}, self._where)

    def parts(self, replayed: Scene, model: TactileModel, speed: float | None) -> Parts:
        """Make driver and judge. `speed`: factor of real time; None: as fast as possible.

        Raises `SceneError` or `RecordingError`.
        """
        raise NotImplementedError

    def restore(self, pipeline: Pipeline) -> None:
        """Restore the recorded session and learning, if there are any. Raises `SceneError`."""

    def tell(self, companion: Companion) -> None:
        """Pass the recorded outcomes to `companion`, if there are any."""

    def companions(self) -> list[Companion]:
        """Return what the replay's loop also calls, such as a count of changed verdicts."""
        return []

    def end(self) -> None:
        """Warn if verdicts differ from recorded ones, for recordings that have any."""


class Tables(Source):
    """Grasp tables, streams and ROS bags, which have no record of how they were judged."""

    def __init__(
        self,
        paths: Sequence[Path],
        sections: Mapping[str, dict[str, Any]],
        *,
        read_as: ReadAs | None = None,
        rate_hz: float | None = None,
        loop: bool = False,
        strict: bool = False,
        outcomes: bool = False,
    ) -> None:
        """`sections`: sections of the scene that replace the defaults for playing `paths`.

        Not for bags: `read_as`: what the rows are; None: find out. `rate_hz`: rows/s of files
        without times; None: the usual ones. `loop`: start again after the last file. `strict`:
        a value that is not a count raises. `outcomes`: so does an outcome that cannot be read.
        """
        self._paths = [path.absolute() for path in paths]
        self._refuses = {"strict": strict, "outcomes": outcomes}
        tactile = {"driver": "replay", "recordings": self._paths, "loop": loop}
        changes: dict[str, dict[str, Any]] = {
            "tactile": {**tactile, "read_as": read_as, "rate_hz": rate_hz},
            "gate": {"max_age_ms": assembly.RECORDED_MAX_AGE_MS},
        }
        super().__init__({**sections, **changes}, Path("command line"))

    def parts(self, replayed: Scene, model: TactileModel, speed: float | None) -> Parts:
        """Make driver and judge for a hand of the model's fingers. `speed`: as in the base class.

        Raises `SceneError` if a file lacks a finger, or `RecordingError`.
        """
        hand = Hand(fingers=model.contract.fingers)
        for path in self._paths:
            if kind_of(path) in BAGS:
                from graspd.drivers.recordings.bag import fingers_of

                _refuse_other_fingers(path, fingers_of(path), model)
        try:
            plan = Plan.of(replayed.model_copy(update={"hand": hand}))
        except MissingFingersError as error:
            _refuse_other_fingers(error.path, error.there, model)
            raise
        options = cast(ReplayTactile, replayed.tactile)
        driver = assembly.player(plan, options, speed, **self._refuses)
        parts = Parts.of(plan, model, driver, lambda: driver.handed_over_ns)
        return replace(parts, boot_id=DRAWS)


def _refuse_other_fingers(path: Path, there: Sequence[Finger], model: TactileModel) -> None:
    """Raise `SceneError`, with models that fit, if a file lacks fingers of the model."""
    if missing := [finger for finger in model.contract.fingers if finger not in there]:
        fits = zoo.judging([finger for finger in FINGERS if finger in there])
        advice = f": --model {fits[0]} judges these" if fits else ", and no model judges these"
        raise SceneError(
            f"{path}: has {', '.join(there) or 'no finger'}; {model.contract.name} also needs "
            f"{', '.join(missing)}{advice}"
        )


class LinkLogs(Source):
    """Link logs of one kind, in order of time."""

    def __init__(self, paths: Sequence[Path], path: Path | None) -> None:
        """`path`: scene file; None: default scene. Raises `RecordingError` for two kinds of files,
        `SceneError` for a scene with another driver."""
        self._paths = tuple(paths)
        driver = LINK_LOGS[kind_of_all(paths)]
        if path is None:
            port = {"port": "link log"} if driver == "spi" else {}
            super().__init__({"tactile": {"driver": driver, **port}}, Path("command line"))
            return
        loaded = scene.load(path)
        if loaded.tactile.driver != driver:
            raise SceneError(f"{path}: tactile.driver must be {driver}")
        written = loaded.model_dump(mode="json", exclude_unset=True)
        sections = {key: written[key] for key in LINK_SECTIONS if key in written}
        super().__init__(sections, Path("command line"))  # paths no longer begin at the scene

    def parts(self, replayed: Scene, model: TactileModel, speed: float | None) -> Parts:
        try:
            driver = self._driver(replayed, speed)
        except ValueError as error:
            raise SceneError(f"[tactile] {error}") from error
        parts = Parts.of(Plan.of(replayed), model, driver, lambda: driver.handed_over_ns)
        return replace(parts, boot_id=DRAWS)

    def _driver(self, replayed: Scene, speed: float | None) -> LinkLogDriver[Any]:
        tactile, fingers = replayed.tactile, replayed.hand.fingers
        if isinstance(tactile, SpiTactile):
            from graspd.drivers.recordings.serial_log import SerialLog

            return SerialLog(self._paths, fingers, tactile.sensors, speed=speed)
        if not isinstance(tactile, CanTactile):
            raise ValueError("link logs are of the drivers can and spi")
        from graspd.drivers.recordings.can_log import CanLog

        board = tactile.model_dump(exclude={"driver", "interface", "bitrate", "options"})
        return CanLog(self._paths, fingers, speed=speed, **board)
