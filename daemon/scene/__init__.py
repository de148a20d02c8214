"""The scene: one TOML file that names what the hand has, read and checked."""

from graspd.daemon.scene.scene import Scene, SceneError, load, parse

__all__ = ["Scene", "SceneError", "load", "parse"]
