"""graspd: says before a hand lifts whether the grasp is stable or will slip.

Names are loaded when they are first used: `import graspd` alone takes no time.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    __version__: str
    from graspd import client
    from graspd.daemon.library import GraspModel, judge, load
    from graspd.daemon.record.frames import read_grasps, read_recording
    from graspd.models.pictures import plot_grasp, tactile_images

__all__ = [
    "GraspModel",
    "__version__",
    "client",
    "judge",
    "load",
    "plot_grasp",
    "read_grasps",
    "read_recording",
    "tactile_images",
]

_MODULES = {
    "GraspModel": "graspd.daemon.library",
    "judge": "graspd.daemon.library",
    "load": "graspd.daemon.library",
    "plot_grasp": "graspd.models.pictures",
    "read_grasps": "graspd.daemon.record.frames",
    "read_recording": "graspd.daemon.record.frames",
    "tactile_images": "graspd.models.pictures",
}


def __dir__() -> list[str]:
    """Return the public names, without loading their modules."""
    return list(__all__)


def __getattr__(name: str) -> object:
    """Return what a public name stands for, and load its module. Raises `AttributeError`."""
    if name == "__version__":
        return import_module("graspd.daemon").version()
    if name == "client":
        return import_module("graspd.client")
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module 'graspd' has no attribute '{name}'")
