"""Build scene and judge of grasp tables and streams (CSV)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import Parts
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.publish.companion import Companion
from graspd.daemon.scene import Scene, parse
from graspd.daemon.scene.scene import Hand
from graspd.models.runtime import TactileModel


class Tables:
    """Grasp tables and streams, which do not say how they were judged."""

    def __init__(self, paths: Sequence[Path], sections: Mapping[str, dict[str, Any]]) -> None:
        """`sections`: of the scene, where it differs from one that plays `paths` fast."""
        recordings = [path.absolute() for path in paths]
        tactile = {"driver": "replay", "pace": "fast", "recordings": recordings}
        self._sections = {
            **sections,
            "tactile": tactile | sections.get("tactile", {}),
            "gate": {"max_age_ms": assembly.RECORDED_MAX_AGE_MS},
        }

    def scene(self, publish: dict[str, Any], model: dict[str, Any], mode: str | None) -> Scene:
        """Return the scene, changed by these sections. Raises `SceneError`."""
        return parse(changed(self._sections, publish, model, mode), Path("command line"))

    def parts(self, wanted: Scene, model: TactileModel, _speed: float | None) -> Parts:
        """Make the parts for the model's fingers. Raises `SceneError` or `RecordingError`."""
        hand = Hand(fingers=model.contract.fingers)
        return Parts.of(wanted.model_copy(update={"hand": hand}), model)

    def restore(self, pipeline: Pipeline) -> None:
        """Do nothing: a table has no session."""

    def tell(self, companion: Companion) -> None:
        """Do nothing: the controller tells the outcomes of a table."""


def changed(
    sections: dict[str, dict[str, Any]],
    publish: dict[str, Any],
    model: dict[str, Any],
    mode: str | None,
) -> dict[str, dict[str, Any]]:
    """Return `sections` with these values instead; the model's thresholds stay."""
    former = sections.get("model", {})
    if model:
        former = {key: value for key, value in former.items() if key not in ("name", "path")}
    gate = sections.get("gate", {}) | ({} if mode is None else {"mode": mode})
    return {**sections, "model": former | model, "gate": gate, "publish": publish}
