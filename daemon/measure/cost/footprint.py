"""What a scene costs, measured from within a process of its own that runs nothing else.

`daemon.measure.cost.tables` starts it. It takes up the parts one by one, in the order of
`graspd run`, and notes after each what the process has become. Imports stand where they are
measured, and what parts share is counted with the first of them.
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

    import numpy as np
    from numpy.typing import NDArray

    from daemon.assembly.parts import Parts
    from daemon.judge.pipeline import Pipeline
    from daemon.publish.outbox import Outbox
    from daemon.scene import Scene
    from drivers.base import Driver, Reading
    from models.contract import ModelContract
    from models.runtime import TactileModel

CORE = (
    ("numpy", ("numpy",)),
    ("msgspec", ("msgspec",)),
    ("onnxruntime", ("onnxruntime",)),
    ("pydantic", ("pydantic.main", "pydantic.types")),
    ("graspd", ("daemon.commands.run",)),
)
"""Part and modules: what every scene imports."""
ELSEWHERE = (
    ("driver replay", ("drivers.recordings.csv_player",)),
    ("driver spi", ("drivers.spi.driver",)),
    ("driver can", ("drivers.can.driver",)),
    ("driver palm", ("drivers.palm.driver",)),
    ("joints", ("daemon.judge.joint_motion", "drivers.joints.driver", "drivers.palm.calibration")),
    ("gate", ("daemon.judge.hand",)),
    ("session", ("daemon.judge.calibration",)),
    ("session file", ("daemon.session.keeper",)),
    ("questions", ("daemon.publish.questions",)),
    ("keys", ("daemon.publish.keys", "zmq.auth.thread")),
)
"""Part and modules: what only some scenes import."""
READINGS = 300
"""Readings that are timed: three grasps."""
SILENCE_NS = 100_000_000
ASK_EVERY = 20
"""Readings between two questions, where a grasp is judged on request only."""
WRONG = 2


class Meter:
    """Notes what each part adds to this process."""

    def __init__(self, started_ns: int) -> None:
        """Begin with the interpreter, started at monotonic `started_ns`."""
        self.parts: list[dict[str, object]] = []
        self._last = {"modules": 0, "rss_kib": 0, "threads": 0, "descriptors": 0}
        self._wall_ns, self._cpu_ns = started_ns, 0
        self.take("interpreter")

    def take(self, name: str) -> None:
        """Count all that was added since the last call for the part `name`."""
        wall_ns, cpu_ns = time.monotonic_ns(), time.process_time_ns()
        now = _now()
        added: dict[str, object] = {key: now[key] - self._last[key] for key in now}
        added["wall_ms"] = (wall_ns - self._wall_ns) / 1e6
        added["cpu_ms"] = (cpu_ns - self._cpu_ns) / 1e6
        self.parts.append({"name": name, **added})
        self.skip()

    def skip(self) -> None:
        """Count what was added since the last call for no part."""
        self._last = _now()
        self._wall_ns, self._cpu_ns = time.monotonic_ns(), time.process_time_ns()


def main(arguments: list[str]) -> int:
    """Measure; `arguments` are the scene, a folder for sockets, and the monotonic ns of the start.

    One JSON object on stdout, as `tables.Footprint` reads it. 2 and a line on stderr if the
    scene, its model or its files are wrong.
    """
    path, folder, started_ns = arguments
    meter = Meter(int(started_ns))
    import gc
    import importlib

    from daemon.process import set_up_libraries

    set_up_libraries()
    for name, modules in CORE:
        for module in modules:
            importlib.import_module(module)
        meter.take(name)
    gc.freeze()
    import json
    from contextlib import ExitStack
    from pathlib import Path

    from daemon.process.text import complain
    from daemon.publish.listener import PublishError
    from daemon.scene import SceneError
    from drivers.base import DriverError
    from models.contract import ModelError

    meter.skip()
    try:
        with ExitStack() as stack:
            found = _measure(meter, Path(path), Path(folder), stack)
    except (SceneError, ModelError, DriverError, PublishError) as error:
        complain(error)
        return WRONG
    sys.stdout.write(json.dumps(found) + "\n")
    return 0


def _measure(meter: Meter, path: Path, folder: Path, stack: ExitStack) -> dict[str, object]:
    from daemon import scene
    from daemon.assembly import assembly
    from daemon.assembly.parts import Parts

    wanted = _apart(scene.load(path), folder)
    meter.take("scene")
    model = assembly.load_model(wanted)
    meter.take("model")
    drivers = _drivers(wanted, meter, stack)
    pipeline = _pipeline(wanted, model, meter)
    outbox = _around(Parts(wanted, model, pipeline, drivers), meter, stack)
    feed = _feed(wanted, drivers[0], model.contract)
    meter.skip()
    _judge(next(feed), pipeline, outbox)
    meter.take("first reading")
    timed = _timed(feed, pipeline, outbox)
    meter.take("readings")
    whole, modules = _now(), sorted(sys.modules)
    return {
        "parts": meter.parts,
        "whole": whole | {"peak_kib": _status("VmHWM")},
        "modules": modules,
        "timed": timed,
        "left_out": _left_out(),
    }


def _apart(wanted: Scene, folder: Path) -> Scene:
    """The scene with its sockets and its session in `folder`, playing recordings at once."""
    from daemon.scene.drivers import ReplayTactile
    from daemon.scene.scene import Ask

    ask, tactile = wanted.ask, wanted.tactile
    if wanted.ask_endpoint is not None:
        ask = Ask(endpoint=f"ipc://{folder}/questions")
    if isinstance(tactile, ReplayTactile):
        tactile = tactile.model_copy(update={"pace": "fast"})
    places = {
        "publish": wanted.publish.model_copy(update={"endpoint": f"ipc://{folder}/verdicts"}),
        "session": wanted.session.model_copy(update={"file": folder / "session.json"}),
    }
    return wanted.model_copy(update={"ask": ask, "tactile": tactile, **places})


def _drivers(wanted: Scene, meter: Meter, stack: ExitStack) -> list[Driver]:
    """The drivers, constructed; one that plays recordings is open as well."""
    from daemon.assembly import assembly
    from daemon.scene.drivers import PalmJoints, ReplayTactile

    drivers = assembly.build_drivers(wanted.model_copy(update={"joints": None}))
    if isinstance(wanted.tactile, ReplayTactile):
        stack.callback(drivers[0].close)
        assembly.open_driver(drivers[0])
    meter.take(f"driver {wanted.tactile.driver}")
    if wanted.joints is not None:
        drivers += assembly.build_drivers(wanted)[1:]
        if isinstance(wanted.joints, PalmJoints):
            from drivers.palm.calibration import load_calibration

            load_calibration(wanted.joints.calibration)
    gated = assembly.gate_mode(wanted) != "every"
    if (gated and assembly.joint_limits(wanted) is not None) or wanted.joints is not None:
        meter.take("joints")
    return drivers


def _pipeline(wanted: Scene, model: TactileModel, meter: Meter) -> Pipeline:
    from daemon.assembly import assembly

    every = wanted.gate.model_copy(update={"mode": "every", "sweeps": None})
    learns = wanted.session.learn
    simple = wanted.model_copy(update={"gate": every})
    pipeline = assembly.build_pipeline(simple, model, learns=learns)
    meter.take("judge" if pipeline.session is None else "judge, session")
    if assembly.gate_mode(wanted) != "every":
        pipeline = assembly.build_pipeline(wanted, model, learns=learns)
        meter.take("gate")
    return pipeline


def _around(parts: Parts, meter: Meter, stack: ExitStack) -> Outbox:
    """What `graspd run` puts around the judge."""
    from daemon.assembly.parts import Assembly
    from daemon.publish.sockets import Sockets

    around = Assembly(parts, stack)
    if around.keep_session():
        meter.take("session file")
    around.add_sockets(stack.enter_context(Sockets(parts.scene)))
    outbox = around.build_outbox()
    meter.take("sockets")
    from daemon.process.signals import StopSignal
    from daemon.run.loop import Loop, LoopTiming
    from daemon.run.reload import Reload

    stop = Reload(stack.enter_context(StopSignal()), lambda: parts, lambda: None)
    stack.callback(stop.close)
    timing = LoopTiming(parts.scene.max_age_ns)
    Loop(parts.drivers, parts.pipeline, outbox, stop, around.companions, timing)
    meter.take("loop")
    return outbox


def _feed(wanted: Scene, driver: Driver, contract: ModelContract) -> Iterator[Reading]:
    """Readings to judge: those of the scene's own recordings, else synthetic grasps."""
    from daemon.scene.drivers import ReplayTactile

    if isinstance(wanted.tactile, ReplayTactile):
        return _played(driver)
    joints = wanted.joints is not None
    from daemon.run.rehearsal import grasps

    counts = list(grasps(contract.seen, READINGS))
    return _synthetic(counts, joints=joints)


def _played(driver: Driver) -> Iterator[Reading]:
    while not driver.exhausted:
        yield from driver.read_ready()


def _synthetic(counts: list[NDArray[np.uint16]], *, joints: bool) -> Iterator[Reading]:
    """Readings of these counts made now, and with `joints` angles that waver before each."""
    import numpy as np

    from daemon.run.rehearsal import PERIOD_NS
    from drivers.base import JointReading, TactileReading

    sound = np.zeros(counts[0].shape, dtype=np.uint8)
    hall_rad = 0.0006
    for number, values in enumerate(counts):
        now_ns, made_ns = time.monotonic_ns(), number * PERIOD_NS
        if joints:
            angles = np.array([0.2, 0.2 + hall_rad * (number % 2)])
            yield JointReading(now_ns, number, ("FFJ3", "MFJ3"), angles, made_ns)
        yield TactileReading(now_ns, number, values, sound, recorded_ns=made_ns)


def _judge(reading: Reading, pipeline: Pipeline, outbox: Outbox) -> tuple[int, int, bool] | None:
    """CPU time, ns, of judging and of reporting, and whether the network ran; None for joints.

    What else runs on the machine counts for nothing.
    """
    from drivers.base import JointReading

    if isinstance(reading, JointReading):
        pipeline.observe_joints(reading)
        return None
    begun_ns = time.thread_time_ns()
    judgement = pipeline.judge(reading)
    judged_ns = time.thread_time_ns()
    outbox.verdict(judgement, judgement.t_ns, SILENCE_NS)
    ran = judgement.moment.judged or judgement.judged_counts is not None
    return judged_ns - begun_ns, time.thread_time_ns() - judged_ns, ran


def _timed(
    feed: Iterator[Reading], pipeline: Pipeline, outbox: Outbox
) -> dict[str, dict[str, float]]:
    """CPU time of the readings, us: all of them, those that were judged, and reporting them."""
    judge: list[int] = []
    network: list[int] = []
    report: list[int] = []
    for reading in feed:
        if pipeline.on_request and len(judge) % ASK_EVERY == 0:
            pipeline.ask()
        times = _judge(reading, pipeline, outbox)
        if times is None:
            continue
        judge.append(times[0])
        report.append(times[1])
        if times[2]:
            network.append(times[0])
        if len(judge) == READINGS:
            break
    found = {"reading": judge, "judged": network, "report": report}
    return {name: _quantiles(times_ns) for name, times_ns in found.items() if times_ns}


def _quantiles(times_ns: list[int]) -> dict[str, float]:
    ordered, number = sorted(times_ns), len(times_ns)
    return {
        "number": number,
        "p50_us": ordered[number // 2] / 1e3,
        "p99_us": ordered[(99 * number) // 100] / 1e3,
    }


def _left_out() -> list[dict[str, object]]:
    """What the parts that the scene does not import would add, by their code alone."""
    import importlib

    meter = Meter(time.monotonic_ns())
    for name, modules in ELSEWHERE:
        missing = [module for module in modules if module not in sys.modules]
        meter.skip()
        for module in missing:
            importlib.import_module(module)
        if modules[0] in missing:
            meter.take(name)
    return meter.parts[1:]


def _now() -> dict[str, int]:
    return {
        "modules": len(sys.modules),
        "rss_kib": _status("VmRSS"),
        "threads": _status("Threads"),
        "descriptors": len(os.listdir("/proc/self/fd")) - 1,  # without that of the listing
    }


def _status(key: str) -> int:
    """A number of /proc/self/status (proc(5)); memory is in KiB."""
    with open("/proc/self/status", encoding="ascii", errors="replace") as lines:
        return next(int(line.split()[1]) for line in lines if line.startswith(f"{key}:"))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
