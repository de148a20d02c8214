"""The cost of a scene, measured in a process of its own, which `graspd.daemon.measure.cost` starts.

It adds and measures parts in the order of `graspd run`. Imports stand where they are measured.
"""

from __future__ import annotations

import os
import sys
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator
    from contextlib import ExitStack
    from pathlib import Path

    from graspd.daemon.assembly.parts import Parts
    from graspd.daemon.judge.pipeline import Pipeline
    from graspd.daemon.publish.outbox import Outbox
    from graspd.daemon.scene import Scene
    from graspd.drivers.base import Driver, Reading
    from graspd.models.contract import SeenCounts

CORE = (
    ("numpy", ("numpy",)),
    ("msgspec", ("msgspec",)),
    ("onnxruntime", ("onnxruntime",)),
    ("pydantic", ("pydantic.main", "pydantic.types")),
    ("graspd", ("graspd.daemon.commands.run",)),
)
"""Parts that every scene imports, with their modules."""
READINGS = 300
"""Readings that are timed: three grasps."""
SILENCE_NS = 100_000_000
ASK_EVERY = 20
"""Readings between two questions, where a grasp is judged on request only."""
WRONG = 2


class Meter:
    """Notes what each part adds to this process.

    A part has `modules`, resident memory (`rss_kib`), `threads`, `descriptors`, and time on the
    wall and of the CPU (`wall_ms`, `cpu_ms`).
    """

    def __init__(self, started_ns: int) -> None:
        """Begin with the interpreter, started at monotonic `started_ns`."""
        self.parts: list[dict[str, float | str]] = []
        self._first = self._last = dict.fromkeys(_now(), 0) | {"wall_ms": started_ns / 1e6}
        self.take("interpreter")

    def take(self, name: str) -> None:
        """Count what was added since the last call for the part `name`."""
        now = _now()
        self.parts.append(_added(name, self._last, now))
        self._last = now

    def whole(self) -> dict[str, float | str]:
        """Return what was added until the last call of `take`."""
        return _added("all", self._first, self._last)


def main(arguments: list[str]) -> int:
    """Measure and write the cost to stdout, as JSON; 2 if the scene or its files are wrong.

    `arguments`: the scene, a folder for sockets, and the monotonic ns of the start. The JSON has

    - `parts`, see `Meter`, in the order of the start; shared cost counts with the first of them.
    - `start`: their sum, from the start of the process to the first reading judged and reported
    - `peak_kib`: largest resident memory
    - `modules`: names of all that are imported
    - `timed`: CPU time of a `reading`, of one that is `judged` by the network, and of its `report`
    """
    path, folder, started_ns = arguments
    meter = Meter(int(started_ns))
    import gc
    import importlib

    from graspd.daemon.process import set_up_libraries

    set_up_libraries()
    for name, modules in CORE:
        for module in modules:
            importlib.import_module(module)
        meter.take(name)
    gc.freeze()
    from contextlib import ExitStack
    from pathlib import Path

    from graspd.daemon.process.text import complain, write_json
    from graspd.daemon.publish.listener import PublishError
    from graspd.daemon.scene import SceneError
    from graspd.drivers.base import DriverError
    from graspd.models.contract import ModelError

    try:
        with ExitStack() as stack:
            cost = _measure(meter, Path(path), Path(folder), stack)
    except (SceneError, ModelError, DriverError, PublishError) as error:
        complain(error)
        return WRONG
    write_json(cost)
    return 0


def _measure(meter: Meter, path: Path, folder: Path, stack: ExitStack) -> dict[str, object]:
    from graspd.daemon import scene
    from graspd.daemon.assembly import assembly
    from graspd.daemon.assembly.parts import Parts

    wanted = _apart(scene.load(path), folder)
    meter.take("scene")
    model = assembly.load_model(wanted)
    meter.take("model")
    drivers = assembly.build_drivers(wanted)
    stack.callback(drivers[0].close)
    assembly.open_file(wanted, drivers[0])
    meter.take(f"driver {wanted.tactile.driver}")
    pipeline = assembly.build_pipeline(wanted, model, learns=wanted.session.learn)
    meter.take("judge")
    outbox = _around(Parts(wanted, model, pipeline, drivers), meter, stack)
    readings = _readings(wanted, drivers[0], model.contract.seen)
    _judge(next(readings), pipeline, outbox)
    meter.take("first reading")
    return {
        "parts": meter.parts,
        "start": meter.whole(),
        "timed": _timed(readings, pipeline, outbox),
        "peak_kib": _status("VmHWM"),
        "modules": sorted(sys.modules),
    }


def _apart(wanted: Scene, folder: Path) -> Scene:
    """Return the scene with its sockets and session in `folder`, playing recordings at once."""
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


def _around(parts: Parts, meter: Meter, stack: ExitStack) -> Outbox:
    """Build what `graspd run` puts around the judge."""
    from graspd.daemon.assembly.parts import Assembly
    from graspd.daemon.publish.sockets import Sockets

    around = Assembly(parts, stack)
    if around.keep_session():
        meter.take("session file")
    around.add_sockets(stack.enter_context(Sockets(parts.scene)))
    outbox = around.build_outbox()
    meter.take("sockets")
    from graspd.daemon.process.signals import StopSignal
    from graspd.daemon.run.loop import Loop, LoopTiming

    stop = stack.enter_context(StopSignal())
    timing = LoopTiming(parts.scene.max_age_ns)
    Loop(parts.drivers, parts.pipeline, outbox, stop, around.companions, timing)
    meter.take("loop")
    return outbox


def _readings(wanted: Scene, driver: Driver, seen: SeenCounts) -> Iterator[Reading]:
    """Yield the readings of the scene's own recordings, else synthetic grasps made now."""
    from graspd.daemon.scene.drivers import ReplayTactile

    if isinstance(wanted.tactile, ReplayTactile):
        while not driver.exhausted:
            yield from driver.read_ready()
        return
    import numpy as np

    from graspd.daemon.run.rehearsal import PERIOD_NS, grasps
    from graspd.drivers.base import JointReading, TactileReading

    hall_rad = 0.0006  # a count of a Hall sensor: frozen angles would not be believed
    for number, counts in enumerate(grasps(seen, READINGS)):
        now_ns, made_ns = time.monotonic_ns(), number * PERIOD_NS
        if wanted.joints is not None:
            angles = np.array([0.2, 0.2 + hall_rad * (number % 2)])
            yield JointReading(now_ns, number, ("FFJ3", "MFJ3"), angles, made_ns)
        yield TactileReading(
            now_ns, number, counts, np.zeros_like(counts, np.uint8), recorded_ns=made_ns
        )


def _judge(reading: Reading, pipeline: Pipeline, outbox: Outbox) -> dict[str, int]:
    """Return ns of CPU by what was done: `reading`, `judged` if the network ran, `report`."""
    from graspd.drivers.base import JointReading

    if isinstance(reading, JointReading):
        pipeline.observe_joints(reading)
        return {}
    begun_ns = time.thread_time_ns()
    judgement = pipeline.judge(reading)
    judged_ns = time.thread_time_ns()
    outbox.verdict(judgement, judgement.t_ns, SILENCE_NS)
    took = {"reading": judged_ns - begun_ns, "report": time.thread_time_ns() - judged_ns}
    if judgement.moment.judged or judgement.judged_counts is not None:
        took["judged"] = took["reading"]
    return took


def _timed(
    readings: Iterator[Reading], pipeline: Pipeline, outbox: Outbox
) -> dict[str, dict[str, float]]:
    """Return quantiles of CPU time by what was done."""
    times_ns: dict[str, list[int]] = {"reading": []}
    for reading in readings:
        if pipeline.on_request and len(times_ns["reading"]) % ASK_EVERY == 0:
            pipeline.ask()
        for name, took_ns in _judge(reading, pipeline, outbox).items():
            times_ns.setdefault(name, []).append(took_ns)
        if len(times_ns["reading"]) == READINGS:
            break
    quantiles = {}
    for name, values in times_ns.items():
        ordered, count = sorted(values), len(values)
        p50_ns, p99_ns = ordered[count // 2], ordered[(99 * count) // 100]
        quantiles[name] = {"number": count, "p50_us": p50_ns / 1e3, "p99_us": p99_ns / 1e3}
    return quantiles


def _now() -> dict[str, float]:
    return {
        "modules": len(sys.modules),
        "rss_kib": _status("VmRSS"),
        "threads": _status("Threads"),
        "descriptors": len(os.listdir("/proc/self/fd")) - 1,  # without that of the listing
        "wall_ms": time.monotonic_ns() / 1e6,
        "cpu_ms": time.process_time_ns() / 1e6,
    }


def _added(name: str, before: dict[str, float], after: dict[str, float]) -> dict[str, float | str]:
    return {"name": name, **{key: value - before[key] for key, value in after.items()}}


def _status(key: str) -> int:
    """Return a number of /proc/self/status (proc(5)); memory is in KiB."""
    with open("/proc/self/status", encoding="ascii", errors="replace") as lines:
        return next(int(line.split()[1]) for line in lines if line.startswith(f"{key}:"))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
