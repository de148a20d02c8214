"""The scene: one TOML file that describes a hand and how to judge, read and checked."""

from graspd.daemon.process.files import SceneError
from graspd.daemon.scene.scene import Scene, load, parse

__all__ = ["Scene", "SceneError", "load", "parse"]
