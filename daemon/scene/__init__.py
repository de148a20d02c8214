"""The scene: one TOML file that names what the hand has, read and checked."""

from daemon.scene.scene import (
    SCENE_MAX_BYTES,
    STATE_DIRECTORY,
    Ask,
    Curve,
    GateMode,
    Hand,
    Realtime,
    Record,
    Risk,
    Scene,
    SceneError,
    load,
    parse,
)

__all__ = [
    "SCENE_MAX_BYTES",
    "STATE_DIRECTORY",
    "Ask",
    "Curve",
    "GateMode",
    "Hand",
    "Realtime",
    "Record",
    "Risk",
    "Scene",
    "SceneError",
    "load",
    "parse",
]
