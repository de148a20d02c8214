"""What came over a link, judged again: its scene and its driver."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import Parts
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.publish.companion import Companion
from graspd.daemon.scene import Scene, SceneError
from graspd.daemon.scene.drivers import CanTactile, SpiTactile
from graspd.drivers.recordings.link_log_player import CANDUMP, SERIAL, LinkLogDriver
from graspd.models.runtime import TactileModel

_DRIVER = {CANDUMP: "can", SERIAL: "spi"}
_SECTIONS = ("hand", "tactile", "model", "gate", "session")
"""Those that say how readings are judged; a link log has no joints."""


class LinkLogs:
    """Link logs of one kind, in the order of time."""

    def __init__(self, paths: Sequence[Path], path: Path | None) -> None:
        """`path` is of the scene. Raises `SceneError` for files of two kinds."""
        endings = {path.suffix for path in paths}
        if len(endings) > 1:
            raise SceneError(f"files of {' and '.join(sorted(endings))} are not one recording")
        self._paths = tuple(paths)
        self._ending = paths[0].suffix
        self._scene_path = path

    def scene(self, publish: dict[str, Any], model: dict[str, Any], mode: str | None) -> Scene:
        """Return the scene of the link. Raises `SceneError`."""
        driver = _DRIVER[self._ending]
        if self._scene_path is None:
            port = {"port": "link log"} if self._ending == SERIAL else {}
            sections: dict[str, dict[str, Any]] = {"tactile": {"driver": driver, **port}}
        else:
            wanted = scene.load(self._scene_path)
            if wanted.tactile.driver != driver:
                raise SceneError(f"{self._scene_path}: tactile.driver must be {driver}")
            chosen = wanted.model_dump(mode="json", exclude_unset=True)
            sections = {name: chosen[name] for name in _SECTIONS if name in chosen}
        return scene.parse(
            changed(sections, publish, model, mode), self._scene_path or Path("command line")
        )

    def parts(self, wanted: Scene, model: TactileModel, speed: float | None) -> Parts:
        """Return what plays the files and judges them. Raises `SceneError`."""
        try:
            driver = _driver(wanted, self._paths, speed)
        except ValueError as error:
            raise SceneError(f"[tactile] {error}") from error
        pipeline = assembly.build_pipeline(
            wanted, model, lambda: driver.handed_over_ns, learns=wanted.session.learn
        )
        return Parts(wanted, model, pipeline, [driver])

    def restore(self, pipeline: Pipeline) -> None:
        """Nothing: a link log does not know the session."""

    def tell(self, companion: Companion) -> None:
        """Nothing: a link log has no outcomes."""


def changed(
    sections: dict[str, dict[str, Any]],
    publish: dict[str, Any],
    model: dict[str, Any],
    mode: str | None,
) -> dict[str, dict[str, Any]]:
    """Return sections of a scene with these instead; thresholds of the model stay."""
    former = sections.get("model", {})
    if model:
        former = {key: value for key, value in former.items() if key not in ("name", "path")}
    gate = sections.get("gate", {}) | ({} if mode is None else {"mode": mode})
    return {**sections, "model": former | model, "gate": gate, "publish": publish}


def _driver(wanted: Scene, paths: Sequence[Path], speed: float | None) -> LinkLogDriver[Any]:
    tactile, fingers = wanted.tactile, wanted.hand.fingers
    if isinstance(tactile, SpiTactile):
        from graspd.drivers.recordings.serial_log import SerialLog

        return LinkLogDriver(paths, SerialLog(fingers, tactile.sensors), speed=speed)
    if not isinstance(tactile, CanTactile):
        raise ValueError("link logs are of the drivers can and spi")
    from graspd.drivers.recordings.can_log import CanLog

    board = tactile.model_dump(
        exclude={"driver", "interface", "channel", "bitrate", "data_bitrate"}
    )
    return LinkLogDriver(paths, CanLog(fingers, **board), speed=speed)
