"""The scene: one TOML file that describes a hand and how to judge, read and checked."""

from graspd.daemon.scene.scene import Scene, SceneError, load, parse

__all__ = ["Scene", "SceneError", "load", "parse"]
