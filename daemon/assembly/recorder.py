"""Build the recorder of a scene."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from msgspec.structs import replace

from graspd.daemon.assembly import assembly
from graspd.daemon.judge.memory import encode, remember
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.scene import Scene
from graspd.daemon.scene.scene import Record
from graspd.daemon.trust.trust import encode as encode_trust
from graspd.models.runtime import TactileModel

if TYPE_CHECKING:
    from graspd.daemon.record.link_log import Tap
    from graspd.daemon.record.mcap import RecordingHeader
    from graspd.daemon.record.recorder import Recorder


def build_recorder(
    scene: Scene,
    options: Record,
    model: TactileModel,
    pipeline: Pipeline,
    boot_id: str,
    tap: Tap | None,
) -> Recorder:
    """Start the recorder of the scene's `[record]`. Raises `SceneError` without `mcap`."""
    assembly.require_mcap("[record]")
    from graspd.daemon.record.recorder import Recorder

    recorder = Recorder(
        options,
        scene.hand.name,
        boot_id,
        take_header=partial(header_now, pipeline, header_of(scene, model, boot_id)),
        tap=tap,
    )
    pipeline.on_exchange = recorder.exchanged
    return recorder


def header_of(scene: Scene, model: TactileModel, boot_id: str) -> RecordingHeader:
    """Return the header of a recording, without the state of judge and session."""
    from graspd.daemon.record.mcap import RecordingHeader

    network = scene.model.model_dump(mode="json", exclude_none=True)
    if scene.model.path is not None:
        network["path"] = str(scene.model.path.absolute())
    sections = {
        "hand": scene.hand.model_dump(mode="json"),
        "model": network,
        "gate": {
            **scene.gate.model_dump(mode="json", exclude_none=True),
            "mode": assembly.gate_mode(scene),
        },
        "session": {"learn": scene.session.learn, "required": scene.session.required},
        "learn": scene.learn.model_dump(mode="json"),
    }
    if scene.risk is not None:
        sections["risk"] = scene.risk.model_dump(mode="json")
    return RecordingHeader(
        fingers=scene.hand.fingers,
        joints=assembly.joint_limits(scene) is not None,
        boot_id=boot_id,
        scene=sections,
        model=model.contract.name,
        model_sha256=model.sha256,
    )


def header_now(pipeline: Pipeline, header: RecordingHeader) -> Callable[[], RecordingHeader]:
    """Copy the judge's state; return a function that makes the header in any thread."""
    judge, session, axis_ns = remember(pipeline), pipeline.session, pipeline.axis_ns
    state = None if session is None else session.state()
    trust = None if pipeline.trust is None else pipeline.trust.state()
    return lambda: replace(
        header,
        judge=encode(judge),
        axis_ns=axis_ns,
        session=state,
        trust=b"" if trust is None else encode_trust(trust),
    )
