"""Build scene and driver that judge a link log again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import Parts
from graspd.daemon.assembly.tables import changed
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.publish.companion import Companion
from graspd.daemon.scene import Scene, SceneError
from graspd.daemon.scene.drivers import CanTactile, SpiTactile
from graspd.drivers.recordings.player import CANDUMP, SERIAL, LinkLogDriver
from graspd.models.runtime import TactileModel

_DRIVER = {CANDUMP: "can", SERIAL: "spi"}
_SECTIONS = ("hand", "tactile", "model", "gate", "session")
"""Sections of a scene that change verdicts; a link log has no joints."""


class LinkLogs:
    """Link logs of one kind, in order of time, to judge again."""

    def __init__(self, paths: Sequence[Path], scene_path: Path | None) -> None:
        """`scene_path`: the scene; None: defaults. Raises `SceneError` for two kinds of files."""
        endings = {path.suffix for path in paths}
        if len(endings) > 1:
            raise SceneError(f"files of {' and '.join(sorted(endings))} are not one recording")
        self._paths = tuple(paths)
        self._ending = paths[0].suffix
        self._scene_path = scene_path

    def scene(self, publish: dict[str, Any], model: dict[str, Any], mode: str | None) -> Scene:
        """Return the scene, changed by these sections. Raises `SceneError`."""
        driver = _DRIVER[self._ending]
        if self._scene_path is None:
            port = {"port": "link log"} if self._ending == SERIAL else {}
            sections: dict[str, dict[str, Any]] = {"tactile": {"driver": driver, **port}}
        else:
            loaded = scene.load(self._scene_path)
            if loaded.tactile.driver != driver:
                raise SceneError(f"{self._scene_path}: tactile.driver must be {driver}")
            written = loaded.model_dump(mode="json", exclude_unset=True)
            sections = {name: written[name] for name in _SECTIONS if name in written}
        return scene.parse(
            changed(sections, publish, model, mode), self._scene_path or Path("command line")
        )

    def parts(self, replayed: Scene, model: TactileModel, speed: float | None) -> Parts:
        """Return driver and judge of the files; `speed` None: fast. Raises `SceneError`."""
        try:
            driver = _driver(replayed, self._paths, speed)
        except ValueError as error:
            raise SceneError(f"[tactile] {error}") from error
        pipeline = assembly.build_pipeline(
            replayed, model, lambda: driver.handed_over_ns, learns=replayed.session.learn
        )
        return Parts(replayed, model, pipeline, [driver])

    def restore(self, pipeline: Pipeline) -> None:
        """Do nothing: a link log has no session."""

    def tell(self, companion: Companion) -> None:
        """Do nothing: a link log has no outcomes."""


def _driver(replayed: Scene, paths: Sequence[Path], speed: float | None) -> LinkLogDriver[Any]:
    tactile, fingers = replayed.tactile, replayed.hand.fingers
    if isinstance(tactile, SpiTactile):
        from graspd.drivers.recordings.serial_log import SerialLog

        return SerialLog(paths, fingers, tactile.sensors, speed=speed)
    if not isinstance(tactile, CanTactile):
        raise ValueError("link logs are of the drivers can and spi")
    from graspd.drivers.recordings.can_log import CanLog

    board = tactile.model_dump(
        exclude={"driver", "interface", "channel", "bitrate", "data_bitrate"}
    )
    return CanLog(paths, fingers, speed=speed, **board)
