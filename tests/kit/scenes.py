"""Texts of scenes that play the demo."""

from __future__ import annotations

from pathlib import Path

from graspd.drivers.recordings.csv_player import DEMO_TABLE


def demo_scene(folder: Path, tactile: str = "", *, sections: str = "") -> Path:
    """Write a scene of the demo table that publishes at `v` in `folder`; return its path.

    `tactile` has further lines of `[tactile]`, `sections` further sections.
    """
    path = folder / "scene.toml"
    path.write_text(
        f'[tactile]\ndriver = "replay"\nrecordings = ["{DEMO_TABLE}"]\n{tactile}\n'
        f'[publish]\nendpoint = "ipc://{folder}/v"\n{sections}\n'
    )
    return path
