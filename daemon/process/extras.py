"""The extras of `pyproject.toml` that commands need beyond the core packages."""

from __future__ import annotations

EXTRAS = {
    "export-grasps": "record",
    "train": "train",
    "evaluate": "train",
    "report": "train,report",
    "watch": "watch",
}
"""Extras that a command needs."""
