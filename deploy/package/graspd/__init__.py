"""graspd: says before a hand lifts whether the grasp is stable or will slip."""

from graspd.daemon import __version__

__all__ = ["__version__"]
