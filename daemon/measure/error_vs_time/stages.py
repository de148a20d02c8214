"""Where the time of a reading goes: stage by stage, with the daemon's own parts."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.judge.decision import HELD, HandLimits, Limits, decide
from daemon.judge.hand import HandTracker
from daemon.judge.health import Health
from daemon.judge.network import Plausibility
from daemon.judge.pipeline import Pipeline
from daemon.publish.outbox import Outbox
from daemon.publish.sockets import Sockets
from daemon.scene import Scene, parse
from drivers.base import TactileReading
from drivers.recordings.csv_columns import electrode_columns
from drivers.recordings.csv_rows import Recording
from models.electrodes import Electrodes
from models.runtime import TactileModel

PERIOD_NS = 10_000_000


def measure(
    model: TactileModel, counts: NDArray[np.uint16], readings: int
) -> dict[str, dict[str, float]]:
    """p50 and p99, us, of each stage of a reading in a hot loop."""
    chosen = counts[np.arange(readings) % len(counts)]
    times: dict[str, list[float]] = {}
    with (
        tempfile.TemporaryDirectory() as folder,
        Sockets(_scene(Path(folder))) as sockets,
    ):
        steps = _stages(model, chosen, sockets)
        for index in range(readings):
            for name, step in steps.items():
                began_ns = time.perf_counter_ns()
                step(index)
                times.setdefault(name, []).append((time.perf_counter_ns() - began_ns) / 1e3)
    return {
        name: {"p50": float(np.quantile(found, 0.5)), "p99": float(np.quantile(found, 0.99))}
        for name, found in times.items()
    }


def _scene(folder: Path) -> Scene:
    """A scene that publishes in a folder."""
    text = {
        "tactile": {"driver": "replay", "recordings": ["none.csv"]},
        "publish": {"endpoint": f"ipc://{folder}/verdicts"},
    }
    return parse(text, folder / "scene.toml")


def _stages(
    model: TactileModel, counts: NDArray[np.uint16], sockets: Sockets
) -> dict[str, Callable[[int], object]]:
    fingers = model.contract.fingers
    now = [time.monotonic_ns()]
    limits = Limits(max_age_ns=10**12)
    health, hand = Health(len(fingers)), HandTracker(fingers, HandLimits())
    electrodes = Electrodes(model.contract.seen)
    plausibility = Plausibility(fingers, model.contract.seen, electrodes)
    pipeline = Pipeline(model, fingers, limits, time.monotonic_ns, learns=False)
    outbox = Outbox("report", model.contract.fingers, model.contract.name, model.sha256, [sockets])
    readings = [
        TactileReading(now[0] + i * PERIOD_NS, i, row, np.zeros(row.shape, dtype=np.uint8))
        for i, row in enumerate(counts)
    ]
    checked = [health.check(reading) for reading in readings]
    judgement = pipeline.judge(readings[0])
    names = [name for finger in fingers for name in electrode_columns(finger)]
    header = (",".join(names) + "\n").encode()
    lines = [(",".join(map(str, row.ravel())) + "\n").encode() for row in counts]

    def parse(index: int) -> None:
        for _ in Recording(Path("stage"), [header, lines[index]], fingers):
            pass

    def follow(index: int) -> None:
        hand.step(readings[index].t_ns, counts[index], checked[index])

    return {
        "parse a row of CSV, with its header": parse,
        "health": lambda index: health.check(readings[index]),
        "contact and gate": follow,
        "like the training?": lambda index: plausibility.examine(counts[index], None),
        "image or features": lambda index: model.inputs.build(counts[index], model.input),
        "session (the network)": lambda _: model.run(),
        "decision": lambda _: decide(0.25, (), HELD, 0, limits),
        "message and socket": lambda _: outbox.verdict(judgement, now[0], PERIOD_NS),
    }
