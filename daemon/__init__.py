"""The daemon: scene, judge, publisher, service loop, command line."""

__version__ = "0.1.0"
