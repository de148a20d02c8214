"""Measure what scenes cost: memory, start, and the time of a reading.

`python -m tests.bench.footprint [SCENE ...]` prints the table of deploy/MEASURED.md; without
scenes, that of the examples. Each scene is measured in a process of its own, which makes its parts
as `graspd run` does but opens no device, socket of the scene or kept session. Imports stand where
they are measured.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.kit.programs import ran

if TYPE_CHECKING:
    from graspd.daemon.assembly.parts import Parts
    from graspd.daemon.publish.outbox import Outbox
    from graspd.daemon.scene import Scene
    from graspd.drivers.base import Reading

EXAMPLES = Path(__file__).parents[2] / "deploy" / "scenes"
READINGS = 300
"""Readings that are timed: three grasps."""
ASK_EVERY = 20
"""Readings between two questions, if the scene judges a grasp on request only."""
SILENCE_NS = 100_000_000
MIB = 1024
TITLES = (
    "scene",
    "memory, MiB (over Python's own)",
    "start, ms of CPU",
    "per reading p50 / p99, us",
    "judged p50, us",
)

Footprint = dict[str, Any]
"""`modules`: names of all loaded; `rss_kib`, `own_kib` (Python's own), `threads`, `descriptors`,
`cpu_ms`: once the first reading is judged and reported; `reading`, `judged`: CPU times, us, of all
readings and of those that the model judged, sorted."""


def measure(scene: Path) -> Footprint:
    """Measure a scene in a process of its own, for about a second. Raises `RuntimeError`."""
    with tempfile.TemporaryDirectory(prefix="graspd-") as folder:
        words = ("-m", "tests.bench.footprint", "--here", scene.absolute(), folder)
        result = ran(sys.executable, *words, cwd=EXAMPLES.parents[1])
    if result.returncode:
        raise RuntimeError(f"{scene}: {result.stderr}")
    return dict(json.loads(result.stdout))


def main(scenes: Sequence[Path]) -> None:
    """Print a row for each scene."""
    from graspd.models.training.evaluating.files import markdown_table

    rows = [(f"`{scene.name}`", *_cells(measure(scene))) for scene in scenes]
    print("\n".join(markdown_table(TITLES, rows, right=TITLES[1:])))  # noqa: T201


def _cells(cost: Footprint) -> tuple[str, ...]:
    reading, judged = cost["reading"], cost["judged"]
    return (
        f"{cost['rss_kib'] / MIB:.1f} ({(cost['rss_kib'] - cost['own_kib']) / MIB:.1f})",
        f"{cost['cpu_ms']:.0f}",
        f"{reading[len(reading) // 2]:.0f} / {reading[99 * len(reading) // 100]:.0f}",
        f"{judged[len(judged) // 2]:.0f}" if judged else "-",
    )


def here(path: Path, folder: Path) -> Footprint:
    """Measure a scene in this process, with its sockets and session in a folder."""
    own_kib = _status("VmRSS")
    from graspd.daemon.process import set_up_libraries

    set_up_libraries()
    from graspd.daemon import scene
    from graspd.daemon.assembly import assembly
    from graspd.daemon.assembly.parts import Parts
    from graspd.daemon.assembly.plan import Plan
    from graspd.daemon.commands import run  # noqa: F401 - what the command loads

    wanted = _apart(scene.load(path), folder)
    parts = Parts.of(Plan.of(wanted), assembly.load_model(wanted))
    with ExitStack() as stack:
        stack.callback(parts.drivers[0].close)
        assembly.open_file(wanted, parts.drivers[0])
        outbox = _around(parts, stack)
        readings = _readings(parts)
        _judge(next(readings), parts, outbox)
        cost: Footprint = {
            "own_kib": own_kib,
            "rss_kib": _status("VmRSS"),
            "threads": _status("Threads"),
            "descriptors": len(os.listdir("/proc/self/fd")) - 1,  # without that of the listing
            "cpu_ms": time.process_time_ns() / 1e6,
        }
        cost |= _timed(readings, parts, outbox)
    return cost | {"modules": sorted(sys.modules)}


def _apart(wanted: Scene, folder: Path) -> Scene:
    """Return the scene with its sockets and session in `folder`, and fast replay of recordings."""
    from graspd.daemon.scene.drivers import ReplayTactile
    from graspd.daemon.scene.scene import Ask

    changes: dict[str, object] = {
        "publish": wanted.publish.model_copy(update={"endpoint": f"ipc://{folder}/verdicts"}),
        "session": wanted.session.model_copy(update={"folder": folder / "session"}),
    }
    if wanted.ask_endpoint is not None:
        changes["ask"] = Ask(endpoint=f"ipc://{folder}/questions")
    if isinstance(wanted.tactile, ReplayTactile):
        changes["tactile"] = wanted.tactile.model_copy(update={"pace": "fast"})
    return wanted.model_copy(update=changes)


def _around(parts: Parts, stack: ExitStack) -> Outbox:
    """Build session, sockets and loop around the judge, as `graspd run` does; return the outbox."""
    from graspd.daemon.assembly.parts import Assembly
    from graspd.daemon.process.signals import StopSignal
    from graspd.daemon.run.loop import Loop, LoopTiming

    around = Assembly(parts, stack)
    around.keep_session()
    around.open_sockets()
    outbox = around.build_outbox()
    stop, timing = stack.enter_context(StopSignal()), LoopTiming(parts.scene.max_age_ns)
    Loop(parts.drivers, parts.pipeline, outbox, stop, around.companions, timing)
    return outbox


def _readings(parts: Parts) -> Iterator[Reading]:
    """Yield the readings of the scene's own recordings, else synthetic grasps made now."""
    from graspd.daemon.scene.drivers import ReplayTactile

    if isinstance(parts.scene.tactile, ReplayTactile):
        while not parts.drivers[0].exhausted:
            yield from parts.drivers[0].read_ready()
        return
    import numpy as np

    from graspd.daemon.run.rehearsal import PERIOD_NS, grasps
    from graspd.drivers.base import JointReading, TactileReading

    hall_rad = 0.0006  # a count of a Hall sensor: frozen angles would not be believed
    for number, counts in enumerate(grasps(parts.model.contract.seen, READINGS)):
        now_ns, made_ns = time.monotonic_ns(), number * PERIOD_NS
        if parts.scene.joints is not None:
            angles = np.array([0.2, 0.2 + hall_rad * (number % 2)])
            yield JointReading(now_ns, number, ("FFJ3", "MFJ3"), angles, made_ns)
        yield TactileReading(
            now_ns, number, counts, np.zeros_like(counts, np.uint8), recorded_ns=made_ns
        )


def _judge(reading: Reading, parts: Parts, outbox: Outbox) -> tuple[float, bool] | None:
    """Judge and report a reading; return the CPU time of judging, us, and if the model was run.

    None for joint angles, which are only taken in.
    """
    from graspd.drivers.base import JointReading

    if isinstance(reading, JointReading):
        parts.pipeline.observe_joints(reading)
        return None
    begun_ns = time.thread_time_ns()
    judgement = parts.pipeline.judge(reading)
    took_us = (time.thread_time_ns() - begun_ns) / 1e3
    outbox.verdict(judgement, judgement.t_ns, SILENCE_NS)
    return took_us, judgement.moment.judged or judgement.judged_counts is not None


def _timed(readings: Iterator[Reading], parts: Parts, outbox: Outbox) -> Footprint:
    times: list[tuple[float, bool]] = []
    for reading in readings:
        if parts.pipeline.on_request and len(times) % ASK_EVERY == 0:
            parts.pipeline.ask()
        if (took := _judge(reading, parts, outbox)) is not None:
            times.append(took)
        if len(times) == READINGS:
            break
    return {
        "reading": sorted(us for us, _ in times),
        "judged": sorted(us for us, is_judged in times if is_judged),
    }


def _status(key: str) -> int:
    """Return the number of a key in /proc/self/status (proc(5)); memory is in KiB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{key}:"))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--here"]:
        json.dump(here(Path(sys.argv[2]), Path(sys.argv[3])), sys.stdout)
    else:
        main([Path(name) for name in sys.argv[1:]] or sorted(EXAMPLES.glob("*.toml")))
