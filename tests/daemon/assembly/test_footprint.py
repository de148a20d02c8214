"""What a scene does not need is not there: modules, memory, threads, descriptors."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.bench.footprint import measure
from tests.kit.scenes import demo_scene

DEPLOY = Path(__file__).parents[3] / "deploy"
SCENES = sorted((DEPLOY / "scenes").glob("*.toml"))


def ours(*names: str) -> set[str]:
    """Full names of modules of graspd."""
    return {f"graspd.{name}" for name in names}


NEVER = {
    *("torch", "sklearn", "onnx", "onnxscript", "skl2onnx", "scipy", "pandas", "matplotlib"),
    *("rich", "distributed", "mcap", "msgpack", "pydantic.v1", "pydantic_settings", "yaml"),
    *("numpy.ma", "numpy.random", "numpy.testing", "jsonschema", "zstandard", "lz4", "zmq.auth"),
    "difflib",
} | ours(
    *("models.training", "models.onnx_file", "drivers.twins", "drivers.recordings.can_log"),
    "drivers.recordings.serial_log",
    *("daemon.run.summary", "daemon.run.realtime", "daemon.run.systemd"),
    *("daemon.scene.errors", "daemon.commands.doctor", "daemon.watch"),
    *("daemon.record", "daemon.assembly.recordings", "daemon.assembly.sources"),
    "daemon.publish.keys",
)
"""Modules, each with all below it, that these scenes do not need: what no scene does, and what is
for a service, realtime, known keys or a model that is not of the zoo."""
BUSES = {
    "replay": ours("drivers.recordings.csv_player", "drivers.recordings.csv_rows"),
    "spi": {"serial", "cobs"} | ours("drivers.spi.driver"),
    "can": {"can", "asyncio", "sqlite3"} | ours("drivers.can.driver", "drivers.can.bus"),
    "palm": ours("drivers.palm.stream", "drivers.palm.packet"),
    "datagrams": ours("drivers.datagrams.tactile"),
}
"""Modules that only one driver needs, by driver; python-can brings asyncio and sqlite3."""
JOINTS = ours("daemon.judge.joint_motion", "drivers.datagrams.joints")
HALL = ours("drivers.palm.calibration")
GATE = ours(*(f"daemon.judge.{name}" for name in ("gate", "contact", "hand", "stillness")))
KEPT = ours("daemon.session.file", "daemon.session.folder", "daemon.session.keeper")
ASK = ours("daemon.publish.questions")


def buses_but(own: str) -> set[str]:
    """Modules that only drivers other than `own` need."""
    return set().union(*(modules for name, modules in BUSES.items() if name != own))


FORBIDDEN = {
    # The demo's recording has joints; nothing is kept of a replay.
    "demo": {
        *(buses_but("replay") | HALL | KEPT),
        "graspd.drivers.datagrams.joints",
    },
    "two-fingers": buses_but("spi") | JOINTS | HALL | ASK,
    **{name: buses_but(name) | JOINTS | HALL | ASK for name in ("spi", "can", "palm", "datagrams")},
}
"""Modules that must not be loaded, by example scene."""
DRIVER = {"demo": "replay", "two-fingers": "spi"}
"""Driver by example scene, where the scene has another name."""
MEMORY_MIB = 132
"""Most resident memory; measured 82 to 88 MiB with numpy 2.4, onnxruntime 1.31 and pydantic 2.13.
Other versions may take half as much again."""

STANDARD = 3
"""Descriptors of standard input, output and error."""
SIGNALS = 2
"""Descriptors of the pipe by which a signal wakes the loop."""
SOCKET = 14
"""Descriptors of a socket at a path, and of the sockets and pipes to the process that serves it."""
ASK_SOCKET = 3
"""Descriptors that a second socket adds."""
ZMQ_THREADS = 2
"""Threads of ZeroMQ: one serves sockets, one closes them. Peers are served by another process."""
FILE = 1
"""Descriptor of the recording that plays, or of the lock of the kept session."""


@pytest.fixture(autouse=True)
def as_everywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let libraries start no thread per core, so that every computer counts the same threads.

    The telemetry of onnxruntime, on by default from 1.29 on, is off as in CI.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "ORT_DISABLE_TELEMETRY"):
        monkeypatch.setenv(name, "1")


def below(names: set[str], modules: tuple[str, ...]) -> list[str]:
    """Those of `modules` that are in `names`, or below a module in `names`."""
    return [m for m in modules if any(m == name or m.startswith(name + ".") for name in names)]


@pytest.mark.parametrize("scene", SCENES, ids=lambda path: path.stem)
def test_an_example_scene_takes_only_needed_modules_memory_threads_descriptors(scene: Path) -> None:
    cost = measure(scene)
    assert below(NEVER | FORBIDDEN[scene.stem], cost["modules"]) == []
    assert BUSES[DRIVER.get(scene.stem, scene.stem)] <= set(cost["modules"])
    commands = [name for name in cost["modules"] if name.startswith("graspd.daemon.commands.")]
    assert commands == ["graspd.daemon.commands.run"]
    assert cost["rss_kib"] < MEMORY_MIB * 1024
    assert cost["threads"] == 1 + ZMQ_THREADS
    sockets = SOCKET + ASK_SOCKET * (set(cost["modules"]) >= ASK)
    # Whether the connection of a subscriber has gone by now is a matter of time.
    assert STANDARD + SIGNALS + sockets + FILE - cost["descriptors"] in {0, 1}
    # Three seconds with some grasps, each judged as it settles and then twenty times a second.
    assert len(cost["reading"]) == 300
    assert 5 <= len(cost["judged"]) <= 4 + 60


def test_a_replayed_table_loads_neither_gate_nor_joints(tmp_path: Path) -> None:
    found = measure(demo_scene(tmp_path))
    assert below(GATE | JOINTS | HALL | KEPT | ASK, found["modules"]) == []
    assert len(found["judged"]) == len(found["reading"])


def test_replay_loads_no_modules_for_buses_ports_or_training() -> None:
    code = (
        "import json, sys; from graspd.daemon.__main__ import main; sys.argv[1:] = ['replay']; "
        "main(); sys.stderr.write(json.dumps(sorted(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    modules = tuple(json.loads(result.stderr))
    unwanted = NEVER - ours("daemon.assembly.sources", "daemon.run.summary")
    unwanted |= buses_but("replay") | HALL | ASK
    unwanted.add("graspd.daemon.session.keeper")
    assert below(unwanted, modules) == []
    assert "graspd.drivers.recordings.csv_player" in modules
