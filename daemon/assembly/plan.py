"""The plan of a run: a scene, and what the headers of its recordings decide."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from graspd.daemon.judge.decision import GateLimits, HandLimits
from graspd.daemon.scene import Scene, SceneError
from graspd.daemon.scene.drivers import ReplayTactile
from graspd.daemon.scene.scene import GateMode
from graspd.drivers.recordings.kinds import BAGS, Kind, kind_of_all, refuse_options
from graspd.drivers.recordings.layout import Layout, layout_of
from graspd.extras import require

NO_SWEEPS = "gate mode `every` judges each row of a grasp table; a sweep of a stream is not a grasp"


@dataclass(frozen=True, slots=True)
class Plan:
    """A scene, and the settings that the headers of its recordings decide."""

    scene: Scene
    mode: GateMode
    """Mode of the gate; without `gate.mode` that of the recordings, `settled` for live sensors."""
    joints: bool
    """True if joint angles come, from their own source or in a recording."""
    without_outcomes: tuple[Path, ...] = ()
    """Grasp tables, streams and bags that do not say how the lifts ended."""
    layouts: Mapping[Path, Layout] = field(default_factory=dict)
    """Layouts of the scene's tables and streams."""

    @classmethod
    def of(cls, scene: Scene) -> Plan:
        """Return the plan of a scene; read the headers of its recordings, if it has any.

        Raises `SceneError` or `RecordingError`.
        """
        options, mode, joints = scene.tactile, scene.gate.mode, scene.joints is not None
        if not isinstance(options, ReplayTactile):
            return cls(scene, mode or "settled", joints)
        kind = recorded_kind(options)
        if kind in BAGS:
            from graspd.drivers.recordings.bag import has_joints

            if mode == "every":
                raise SceneError(f"{options.recordings[0]}: {NO_SWEEPS}")
            joints = joints or any(map(has_joints, options.recordings))
            return cls(scene, mode or "settled", joints, options.recordings)
        if kind is Kind.MCAP:
            from graspd.daemon.record.mcap_reader import header_of

            recorded = [header_of(path).joints for path in options.recordings]
            return cls(scene, mode or "settled", joints or any(recorded))
        layouts = {
            path: layout_of(path, scene.hand.fingers, options.read_as, options.rate_hz)
            for path in options.recordings
        }
        streams = [path for path, each in layouts.items() if each.is_stream]
        if mode is None:
            if 0 < len(streams) < len(layouts):
                raise SceneError("tactile.recordings: both grasp tables and streams; say gate.mode")
            mode = "settled" if streams else "every"
        if mode == "every" and streams:
            raise SceneError(f"{streams[0]}: {NO_SWEEPS}")
        joints = joints or any(each.joints for each in layouts.values())
        unknown = (path for path, each in layouts.items() if not each.has_outcomes)
        return cls(scene, mode, joints, tuple(unknown), layouts)

    @property
    def hand(self) -> HandLimits | None:
        """Limits of the gate; None in mode `every`."""
        gate = self.scene.gate
        if self.mode == "every":
            return None
        return HandLimits(
            on_request=self.mode == "request",
            required=gate.fingers,
            gate=GateLimits(
                false_alarms=gate.false_alarms,
                early=gate.early,
                request_ns=round(gate.request_ms * 1e6),
            ),
            joints=self.joints,
        )


def recorded_kind(options: ReplayTactile) -> Kind:
    """Return what the recordings are: MCAP, bags, or `Kind.TEXT` for tables and streams.

    Raises `RecordingError` for files of two kinds, and for keys that only tables have. Raises
    `SceneError` for files of another kind, or if the package that reads them is missing.
    """
    kind, first = kind_of_all(options.recordings), options.recordings[0]
    if kind is Kind.MCAP:
        require_mcap("replaying MCAP")
    elif kind is not Kind.TEXT and kind not in BAGS:
        raise SceneError(f"tactile.recordings: {first} is {kind.value}: `graspd replay` plays it")
    only_tables = options.model_dump(include={"loop", "outcomes", "read_as", "rate_hz"})
    refuse_options(first, kind, only_tables)
    return kind


def require_mcap(what: str) -> None:
    """Raise `SceneError`, with advice, if the package `mcap`, which `what` needs, is missing."""
    try:
        require("mcap", what, "record")
    except ModuleNotFoundError as error:
        raise SceneError(str(error)) from error
