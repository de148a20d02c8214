"""Scenes that play the demo, and of live sensors."""

from __future__ import annotations

import csv
from pathlib import Path

from graspd.drivers.recordings.columns import SLIPPED
from graspd.drivers.recordings.csv_player import DEMO_TABLE


def written(folder: Path, text: str) -> Path:
    """Write `scene.toml` in `folder`; return its path."""
    path = folder / "scene.toml"
    path.write_text(text)
    return path


def demo_scene(
    folder: Path, tactile: str = "", *, sections: str = "", recording: Path = DEMO_TABLE
) -> Path:
    """Write a scene of a recording that publishes at `v` in `folder`; return its path.

    `tactile` has further lines of `[tactile]`, `sections` further sections.
    """
    return written(
        folder,
        f'[tactile]\ndriver = "replay"\nrecordings = ["{recording}"]\n{tactile}\n'
        f'[publish]\nendpoint = "ipc://{folder}/v"\n{sections}\n',
    )


def session_scene(folder: Path, model: str = "small-session", sections: str = "") -> Path:
    """Write a scene of an SPI bridge that keeps sessions in `right` beside it; return its path.

    `sections` has further lines of `[session]`, or further sections.
    """
    folder.mkdir(exist_ok=True)
    return written(
        folder,
        f'[tactile]\ndriver = "spi"\nport = "/nowhere"\n[model]\nname = "{model}"\n'
        f'[session]\nfolder = "right"\n{sections}',
    )


def unlabelled_demo(folder: Path) -> Path:
    """Write the demo table without the column of outcomes; return its path."""
    path = folder / "unlabelled.csv"
    with DEMO_TABLE.open(newline="") as labelled, path.open("w", newline="") as out:
        rows = csv.DictReader(labelled)
        names = [name for name in rows.fieldnames or () if name != SLIPPED]
        writer = csv.DictWriter(out, names, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return path
