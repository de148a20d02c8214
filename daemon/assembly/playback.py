"""Recordings of graspd itself, judged again as they were judged: their scene, session and times."""

from __future__ import annotations

import base64
import json
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import msgspec

from daemon.assembly import assembly
from daemon.assembly.captures import changed
from daemon.judge.memory import recall
from daemon.judge.pipeline import Pipeline
from daemon.record.mcap import ASKED, EXCHANGED, RecordingHeader, header_of
from daemon.record.player import McapReplayDriver
from daemon.scene import Scene, SceneError, parse
from drivers.base import RecordingError
from models.runtime import TactileModel
from models.session_statistics import SessionState

log = logging.getLogger("graspd")

NOTHING_KNOWN: Final = (
    "%s: begins in the middle of a run and does not say what was known there: verdicts may differ "
    "until the hand has been open and its grasps are known"
)


class Playback:
    """The files of one run, in their order."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """Read the beginning of all. Raises `RecordingError`."""
        headers = [header_of(path) for path in paths]
        self.header: RecordingHeader = headers[0]
        self._paths = tuple(paths)
        self._driver: McapReplayDriver | None = None
        try:
            self._sections = json.loads(self.header.texts["scene"])
            self._model_sha256 = self.header.texts["model_sha256"]
            text = self.header.texts["session"]
            self._session = msgspec.json.decode(text, type=SessionState) if text else None
            self._axis_ns = int(self.header.texts.get("axis_ns", "0"))
            parts = [(header.boot_id, int(header.texts["file"])) for header in headers]
        except (KeyError, ValueError) as error:  # also msgspec's
            raise RecordingError(paths[0], "is a recording of another graspd") from error
        self._is_first = parts[0][1] == 0
        for path, (run, part), former in zip(paths[1:], parts[1:], parts, strict=False):
            if (run, part - 1) != former:
                log.warning("%s: does not go on where the file before it ends", path)

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
        self._driver = McapReplayDriver(
            self._paths, wanted.hand.fingers, speed=speed, axis_ns=self._axis_ns
        )
        return self._driver

    def pipeline(self, wanted: Scene, model: TactileModel, *, learns: bool) -> Pipeline:
        """The judge of what the driver plays, which finds readings as old as they were then.

        It knows what the daemon's judge knew where the recording begins, but for the session.
        """
        same_model = model.sha256 == self._model_sha256
        if not same_model:
            name = self.header.texts.get("model", "another model")
            log.warning("%s: was judged by %s, not by this model", self._paths[0], name)
        driver = self._driver
        clock = time.monotonic_ns if driver is None else lambda: driver.handed_over_ns
        pipeline = assembly.build_pipeline(wanted, model, clock, learns=learns)
        try:
            memory = base64.b64decode(self.header.texts.get("judge", ""))
            recall(pipeline, memory, same_model=same_model)
        except ValueError:
            if not self._is_first:
                log.warning(NOTHING_KNOWN, self._paths[0])
        if driver is not None:
            driver.on_told = {ASKED: pipeline.ask, EXCHANGED: pipeline.sensors_exchanged}
        return pipeline

    def restore(self, pipeline: Pipeline) -> None:
        """Begin with the session that the daemon had where it begins. Raises `SceneError`."""
        if pipeline.session is None or self._session is None:
            return
        try:
            pipeline.session.restore(self._session)
        except ValueError as error:
            raise SceneError(f"{self._paths[0]}: the session in it {error}") from error
