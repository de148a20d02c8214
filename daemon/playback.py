"""Recordings of graspd itself, judged again as they were judged: their scene, session and times."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from daemon import assembly
from daemon.captures import changed
from daemon.judge.pipeline import Pipeline
from daemon.scene import Scene, SceneError, parse
from drivers.base import RecordingError
from drivers.mcap_recording import RecordingHeader, header_of
from drivers.mcap_replay import McapReplayDriver
from models.runtime import TactileModel
from models.session import SessionState

log = logging.getLogger("graspd")


class Playback:
    """The files of one run, in their order."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """Read the beginning of the first. Raises `RecordingError`."""
        self.header: RecordingHeader = header_of(paths[0])
        self._paths = tuple(paths)
        self._driver: McapReplayDriver | None = None
        try:
            self._sections = json.loads(self.header.texts["scene"])
            self._model_sha256 = self.header.texts["model_sha256"]
            text = self.header.texts["session"]
            self._session = msgspec.json.decode(text, type=SessionState) if text else None
        except (KeyError, ValueError) as error:  # also msgspec's
            raise RecordingError(paths[0], "is a recording of another graspd") from error

    def scene(self, publish: dict[str, Any], model: dict[str, Any], mode: str | None) -> Scene:
        """The scene that was recorded, with another model or gate mode if they are given.

        Raises `SceneError`.
        """
        names = ("hand", "model", "gate", "session")
        sections = {name: dict(self._sections.get(name, {})) for name in names}
        sections["tactile"] = {
            "driver": "replay",
            "recordings": [path.absolute() for path in self._paths],
        }
        return parse(changed(sections, publish, model, mode), self._paths[0])

    def build_driver(self, wanted: Scene, speed: float | None) -> McapReplayDriver:
        """The driver that plays the files."""
        self._driver = McapReplayDriver(self._paths, wanted.hand.fingers, speed=speed)
        return self._driver

    def pipeline(self, wanted: Scene, model: TactileModel, *, learns: bool) -> Pipeline:
        """The judge of what the driver plays, which finds readings as old as they were then."""
        if model.sha256 != self._model_sha256:
            name = self.header.texts.get("model", "another model")
            log.warning("%s: was judged by %s, not by this model", self._paths[0], name)
        driver = self._driver
        if driver is None:
            return assembly.build_pipeline(wanted, model, learns=learns)
        pipeline = assembly.build_pipeline(
            wanted, model, lambda: driver.handed_over_ns, learns=learns
        )
        driver.on_asked = pipeline.ask
        return pipeline

    def restore(self, pipeline: Pipeline) -> None:
        """Begin with the session that the daemon began with. Raises `SceneError`."""
        if pipeline.session is None or self._session is None:
            return
        try:
            pipeline.session.restore(self._session)
        except ValueError as error:
            raise SceneError(f"{self._paths[0]}: the session in it {error}") from error
