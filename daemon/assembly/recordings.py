"""Build the judge of a replay from session and learning in the headers of recordings."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from graspd.daemon.assembly.parts import Parts
from graspd.daemon.assembly.plan import NO_SWEEPS, Plan
from graspd.daemon.assembly.sources import Source
from graspd.daemon.judge.exchange import Exchanged
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.judge.reasons import GateCause
from graspd.daemon.publish.companion import Companion, PublishedVerdict
from graspd.daemon.publish.messages import GateMessage, OutcomeMessage
from graspd.daemon.record.mcap_reader import header_of
from graspd.daemon.record.player import McapReplayDriver, RecordedEvent
from graspd.daemon.record.topics import Late, Said, TakenBack, Topic
from graspd.daemon.scene import Scene, SceneError
from graspd.daemon.scene import scene as kinds
from graspd.daemon.scene.drivers import Section
from graspd.daemon.trust.lift_book import GraspId, Report
from graspd.daemon.trust.trust import FormatError, decode
from graspd.drivers.base import RecordingError
from graspd.models.runtime import TactileModel

log = logging.getLogger("graspd")

SECTIONS: Final[Mapping[str, type[Section]]] = {
    "hand": kinds.Hand,
    "model": kinds.Model,
    "gate": kinds.GateSection,
    "session": kinds.SessionSection,
    "learn": kinds.Learn,
    "risk": kinds.RiskSection,
}
"""Sections of a scene that a recording has."""
BEGINS_WITHIN: Final = (
    "%s: begins in the middle of a run: verdicts may differ until the hand has been open for a "
    "second and grasps again"
)
LOST_HEADER = (
    "%s: another tool has dropped the record `graspd` (`mcap filter` needs --include-metadata): "
    "judged with the defaults, without session and learning, so verdicts may differ"
)
SEVERAL_RUNS = "is of another run than the file before it: replay each run alone"


class Same(Companion):
    """Counts the verdicts of a replay that differ from the recorded ones."""

    def __init__(self) -> None:
        self.said: Said | None = None
        """Recorded verdict on the next reading. None: not recorded."""
        self.compared = self.differ = 0

    def on_verdict(self, published: PublishedVerdict) -> None:
        if self.said is None or published.reading is None:
            return
        now = Said(published.verdict.verdict, published.verdict.judged)
        self.compared += 1
        self.differ += now != self.said
        self.said = None


class RecordedRun(Source):
    """One or more recordings of one run of the daemon, in the order of time."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """Read the headers; warn if a file between them is missing.

        Raises `RecordingError`, also for files of several runs: grasps are known by their numbers.
        """
        headers = [header_of(path) for path in paths]
        self.header = headers[0]
        self._paths = tuple(paths)
        self._companion = Companion()
        self.same = Same()
        self._same_model = self._as_then = False
        """`_same_model`: True if the model is the run's. `_as_then`: session and learning too."""
        self._same_grasps = True
        """False with another gate mode: recorded outcomes then belong to other grasps."""
        for path, header, former in zip(paths[1:], headers[1:], headers, strict=False):
            boot_ids = {header.boot_id, former.boot_id}
            if len(boot_ids - {""}) > 1:  # without readings a lost header has none
                raise RecordingError(path, SEVERAL_RUNS)
            if len(boot_ids) > 1 or header.file != former.file + 1:
                log.warning("%s: does not continue where the file before it ends", path)
        recorded = self.header.scene
        if not recorded:
            log.warning(LOST_HEADER, paths[0])
            recorded = {"hand": {"fingers": self.header.fingers}}
        sections: dict[str, dict[str, Any]] = {}
        for name in filter(recorded.__contains__, SECTIONS):
            keys, known = recorded[name], SECTIONS[name].model_fields
            sections[name] = {key: value for key, value in keys.items() if key in known}
            if gone := [key for key in keys if key not in known]:
                log.warning("%s: was judged with %s, not known here", paths[0], ", ".join(gone))
        sections["tactile"] = {
            "driver": "replay",
            "recordings": [path.absolute() for path in paths],
        }
        super().__init__(sections, paths[0])

    def scene(self, publish: dict[str, Any], model: dict[str, Any], mode: str | None) -> Scene:
        was = self._sections.get("gate", {}).get("mode")
        if mode == "every" and was != "every":
            raise SceneError(f"{self._paths[0]}: {NO_SWEEPS}")
        self._same_grasps = mode is None or (mode == "every") == (was == "every")
        if not self._same_grasps:
            log.warning(
                "%s: was judged with gate mode %s: its outcomes are of other grasps, and left out",
                self._paths[0],
                was,
            )
        return super().scene(publish, model, mode)

    def parts(self, replayed: Scene, model: TactileModel, speed: float | None) -> Parts:
        header = self.header
        self._same_model = header.model_sha256 == model.sha256[: len(header.model_sha256)]
        if not self._same_model:
            log.warning("%s: was judged by %s, not by this model", self._paths[0], header.model)
        if header.file > 0:
            log.warning(BEGINS_WITHIN, self._paths[0])
        driver = McapReplayDriver(self._paths, replayed.hand.fingers, speed=speed)
        parts = Parts.of(Plan.of(replayed), model, driver, lambda: driver.handed_over_ns)
        parts = replace(parts, boot_id=header.boot_id)
        parts.pipeline.hand.count_from(header.grasps)
        driver.on_event = partial(self._repeat, parts.pipeline)
        return parts

    def restore(self, pipeline: Pipeline) -> None:
        header = self.header
        self._as_then = True
        try:
            if pipeline.session is not None and header.session is not None:
                pipeline.session.restore(header.session)
            if pipeline.trust is not None and header.trust:
                learned = decode(header.trust)
                if pipeline.trust.fits(learned):
                    pipeline.trust.restore(learned)
        except FormatError as error:
            log.warning("%s: what was learned %s; replayed without it", self._paths[0], error)
        except ValueError as error:
            raise SceneError(f"{self._paths[0]}: the session in it {error}") from error

    def tell(self, companion: Companion) -> None:
        self._companion = companion

    def companions(self) -> list[Companion]:
        return [self.same]

    def end(self) -> None:
        if self.same.differ and self._as_then and self._same_grasps and self._same_model:
            differ, compared = self.same.differ, self.same.compared
            log.warning("%d of %d verdicts are not those of the run", differ, compared)

    def _repeat(self, pipeline: Pipeline, event: RecordedEvent) -> None:
        match event:
            case Topic.ASKED:
                pipeline.ask()
            case Topic.SKIPPED:
                pipeline.skip()
            case Topic.ANNOUNCED if self._same_grasps:
                pipeline.lifts.announce()
            case TakenBack(boot_id, number) if self._same_grasps:
                pipeline.lifts.take_back(None if number is None else GraspId(boot_id, number))
            case Late():
                pipeline.expect_late(judged=event.judged)
            case Said():
                self.same.said = event
            case GateMessage(cause=GateCause.CONTACT) if self._same_grasps:
                pipeline.hand.count_from(event.grasp - 1)
            case Exchanged():
                try:
                    pipeline.sensors_exchanged(event)
                except ValueError:  # the recorded state is of another model
                    pipeline.sensors_exchanged()
            case OutcomeMessage() if self._same_grasps:
                grasp = GraspId(event.grasp_boot_id or self.header.boot_id, event.grasp)
                pipeline.outcome(grasp, slipped=event.outcome == "slip")
                if event.grasp_boot_id is None:
                    self._companion.on_outcome(Report(grasp, event.outcome, event.object))
