"""Put the parts of a scene together: to run it, to replay it, to measure its cost."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from msgspec.structs import replace

from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.plan import Plan, require_mcap
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.publish.companion import Answer, Companion, at_once
from graspd.daemon.publish.outbox import Outbox, Output
from graspd.daemon.scene import Scene
from graspd.daemon.scene.drivers import ReplayTactile
from graspd.daemon.scene.scene import Record
from graspd.daemon.session.sensors import SensorWatch
from graspd.daemon.trust.trust import encode as encode_trust
from graspd.drivers.base import Driver
from graspd.models.runtime import TactileModel

if TYPE_CHECKING:
    from graspd.daemon.publish.sockets import Sockets
    from graspd.daemon.record.link_log import Tap
    from graspd.daemon.record.mcap import RecordingHeader
    from graspd.daemon.record.recorder import Recorder


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """Drivers and judge of a scene. The drivers are not open yet."""

    plan: Plan
    model: TactileModel
    pipeline: Pipeline
    drivers: list[Driver]
    """All drivers, the tactile one first."""
    boot_id: str | None = None
    """`boot_id` for the judge: of the recorded run, or `DRAWS` of a table; None: a new one."""

    @property
    def scene(self) -> Scene:
        return self.plan.scene

    @classmethod
    def of(
        cls,
        plan: Plan,
        model: TactileModel,
        player: Driver | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> Parts:
        """Make the parts. Raises `SceneError` or `ModelError`.

        `player`: takes the place of the scene's drivers. `clock`: gives the judge the time, ns.
        """
        assembly.refuse_absent_processors(plan.scene)
        pipeline = assembly.build_pipeline(plan, model, clock, learns=plan.scene.session.learn)
        drivers = assembly.build_drivers(plan) if player is None else [player]
        return cls(plan, model, pipeline, drivers)


class Assembly:
    """Open drivers, sockets, session, recorder of a run, one call for each, until `stack` ends."""

    def __init__(self, parts: Parts, stack: ExitStack) -> None:
        self.companions: list[Companion] = []
        """Companions opened so far: sockets, session keeper, recorder."""
        self.keep: Callable[[Answer], None] = at_once
        """Function that calls its argument, an `Answer`, once the present state is on the disk; at
        once if no session is kept."""
        self._outputs: list[Output] = []
        self._parts = parts
        self._stack = stack
        self._boot_id = uuid.uuid4().hex
        parts.pipeline.boot_id = parts.boot_id or self._boot_id
        self._tap: Tap | None = None

    def open_sockets(self, high_water_mark: int | None = None) -> Sockets:
        """Open the scene's sockets until the stack closes. `high_water_mark`: most messages that
        wait for a subscriber; None: the default."""
        from graspd.daemon.publish.sockets import Sockets

        sockets = Sockets(self._parts.scene, high_water_mark=high_water_mark)
        self._stack.callback(sockets.close)
        self._outputs.append(sockets)
        self.companions.append(sockets)
        return sockets

    def open_drivers(self) -> None:
        """Open the drivers; tap the link if it is recorded. Raises `LinkError` or `SceneError`."""
        record, drivers = self._parts.scene.record, self._parts.drivers
        if record is not None and record.raw:
            from graspd.daemon.record.link_log import tap_of

            self._tap = tap_of(drivers[0], self._parts.scene.tactile)
        for driver in drivers:
            self._stack.callback(driver.close)
            assembly.open_driver(driver)

    def keep_session(self) -> None:
        """Watch for exchanged sensors; restore and keep the session if the scene asks for it.

        The last save is when the stack closes.
        """
        scene, pipeline, tactile = self._parts.scene, self._parts.pipeline, self._parts.drivers[0]
        has_any = pipeline.session is not None or pipeline.trust is not None
        if not (has_any and scene.keeps_session):
            self.companions.append(SensorWatch(pipeline, tactile))
            return
        from graspd.daemon.session.folder import SessionFolder
        from graspd.daemon.session.keeper import SessionKeeper

        folder = SessionFolder(scene.session_path)
        self._stack.callback(folder.close)
        keeper = SessionKeeper(pipeline, scene.hand.fingers, tactile, folder)
        self._stack.callback(keeper.save)
        self.keep = keeper.keep
        self.companions.insert(0, keeper)  # it must answer before the socket is read

    def record(self) -> None:
        """Record if the scene asks for it. Call after `keep_session`. Raises `SceneError`."""
        parts, options = self._parts, self._parts.scene.record
        if options is None:
            return
        recorder = build_recorder(parts, options, self._boot_id, self._tap)
        self._stack.callback(recorder.close)
        self._outputs.append(recorder)
        self.companions.append(recorder)

    def build_outbox(self) -> Outbox:
        hand, model = self._parts.scene.hand, self._parts.model
        return Outbox(
            hand.name,
            hand.fingers,
            model.contract.name,
            model.sha256,
            self._outputs,
            boot_id=self._boot_id,
        )


def build_recorder(parts: Parts, options: Record, boot_id: str, tap: Tap | None) -> Recorder:
    """Start the recorder of `[record]`. `tap`: gives the link's traffic; None: not recorded.

    Raises `SceneError` if the package `mcap` is missing.
    """
    require_mcap("[record]")
    from graspd.daemon.record.recorder import PATIENCE_S, Recorder, ReplayRecorder

    tactile = parts.scene.tactile
    plays = isinstance(tactile, ReplayTactile)
    is_fast = isinstance(tactile, ReplayTactile) and tactile.pace == "fast"
    recorder = (ReplayRecorder if plays else Recorder)(
        options,
        parts.scene.hand.name,
        boot_id,
        take_header=partial(
            header_now, parts.pipeline, header_of(parts.plan, parts.model, boot_id)
        ),
        tap=tap,
        patience_s=PATIENCE_S if is_fast else 0.0,
    )
    parts.pipeline.on_exchange = recorder.exchanged
    return recorder


def header_of(plan: Plan, model: TactileModel, boot_id: str) -> RecordingHeader:
    """Return the header of a recording, without session and learning."""
    from graspd.daemon.record.mcap import RecordingHeader

    scene = plan.scene
    network = scene.model.model_dump(mode="json", exclude_none=True)
    if scene.model.path is not None:
        network["path"] = str(scene.model.path.absolute())
    sections = {
        "hand": scene.hand.model_dump(mode="json"),
        "model": network,
        "gate": {**scene.gate.model_dump(mode="json", exclude_none=True), "mode": plan.mode},
        "session": {"learn": scene.session.learn, "required": scene.session.required},
        "learn": scene.learn.model_dump(mode="json"),
    }
    if scene.risk is not None:
        sections["risk"] = scene.risk.model_dump(mode="json")
    return RecordingHeader(
        fingers=scene.hand.fingers,
        joints=plan.joints,
        boot_id=boot_id,
        scene=sections,
        model=model.contract.name,
        model_sha256=model.sha256,
    )


def header_now(pipeline: Pipeline, header: RecordingHeader) -> Callable[[], RecordingHeader]:
    """Copy session and learning; return a function, for any thread, that adds them to `header`."""
    grasps, session = pipeline.hand.grasp, pipeline.session_then()
    required = {**header.scene["session"], "required": pipeline.needs_session}
    trust = None if pipeline.trust is None else pipeline.trust.state()
    return lambda: replace(
        header,
        scene={**header.scene, "session": required},
        grasps=grasps,
        session=session,
        trust=b"" if trust is None else encode_trust(trust),
    )
