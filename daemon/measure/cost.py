"""Measure the cost of scenes: run `footprint` for each, and write tables."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from graspd.daemon.process.text import printable
from graspd.models.training.evaluating.files import markdown_table

TIMEOUT_S = 120.0
"""Longest measurement, s. A scene takes about a second."""
MESSAGE_MAX = 320
"""Longest error that is shown, characters."""
KIB_PER_MIB = 1024

Footprint = dict[str, Any]
"""Cost of one scene, as `graspd.daemon.measure.footprint` writes it."""


class CostError(Exception):
    """The scene could not be measured; the message says why."""


def measure(scene: Path) -> Footprint:
    """Run the scene's parts in a process of their own, for about a second. Raises `CostError`.
    Nothing is published, and no device or kept session is touched."""
    with tempfile.TemporaryDirectory(prefix="graspd-") as folder:
        # -P, so that the files in the folder at hand are not taken for modules.
        command = [sys.executable, "-P", "-m", "graspd.daemon.measure.footprint"]
        try:
            result = subprocess.run(
                [*command, str(scene), folder, str(time.monotonic_ns())],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=TIMEOUT_S,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise CostError(f"{scene}: cannot be measured: {error}") from error
    if result.returncode != 0:
        why = result.stderr.strip().removeprefix("graspd: ")[-MESSAGE_MAX:]
        raise CostError(f"{scene}: cannot be measured: {why or result.returncode}")
    return dict(json.loads(result.stdout))


def lines(cost: Footprint) -> Iterator[str]:
    """Yield the cost of one scene, part by part, for people."""
    heads = ("modules", "MiB", "threads", "descr.", "wall ms", "CPU ms")
    yield f"  {'cost':16}" + "".join(f"{head:>9}" for head in heads)
    for part in (*cost["parts"], cost["start"]):
        yield (
            f"  {part['name']:16}{part['modules']:9}{part['rss_kib'] / KIB_PER_MIB:9.1f}"
            f"{part['threads']:9}{part['descriptors']:9}{part['wall_ms']:9.1f}{part['cpu_ms']:9.1f}"
        )
    yield f"  at most {cost['peak_kib'] / KIB_PER_MIB:.1f} MiB"
    for name, times in cost["timed"].items():
        yield (
            f"  {name}: p50 {times['p50_us']:.0f} us, p99 {times['p99_us']:.0f} us of CPU time "
            f"({times['number']})"
        )


TITLES = (
    "Scene",
    "Modules",
    "Memory, MiB (over Python's own)",
    "Threads",
    "Descriptors",
    "Start, ms (CPU)",
    "Per reading, us p50 / p99",
    "Judged, us p50",
)


def markdown(costs: Sequence[tuple[Path, Footprint]]) -> Iterator[str]:
    """Return the lines of a table with a row for each scene."""
    rows = [_cells(printable(path.stem), cost) for path, cost in costs]
    return markdown_table(TITLES, rows, right=TITLES[1:])


def _cells(name: str, cost: Footprint) -> Sequence[str]:
    start, timed = cost["start"], cost["timed"]
    reading, judged = timed.get("reading"), timed.get("judged")
    over_kib = start["rss_kib"] - cost["parts"][0]["rss_kib"]
    return (
        name,
        str(start["modules"]),
        f"{start['rss_kib'] / KIB_PER_MIB:.1f} ({over_kib / KIB_PER_MIB:.1f})",
        str(start["threads"]),
        str(start["descriptors"]),
        f"{start['wall_ms']:.0f} ({start['cpu_ms']:.0f})",
        "-" if reading is None else f"{reading['p50_us']:.0f} / {reading['p99_us']:.0f}",
        "-" if judged is None else f"{judged['p50_us']:.0f}",
    )
