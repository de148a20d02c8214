"""From a scene to its parts: every key arrives where it belongs, and nothing else is loaded."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon import assembly
from daemon.judge.verdict import Outcome
from daemon.scene import parse
from drivers.replay import DEMO_TABLE, ReplayDriver
from drivers.spi_bridge import SpiBridgeDriver
from tests.daemon.fakes import Clock, reading

REPLAY = {"driver": "replay", "recordings": [str(DEMO_TABLE)]}


@pytest.mark.parametrize("threshold", [1e-9, 1 - 1e-9])
def test_the_threshold_of_the_scene_decides(threshold: float) -> None:
    scene = parse(
        {"tactile": REPLAY, "model": {"slip_threshold": threshold}, "gate": {"max_age_ms": 1.0}},
        Path("scene.toml"),
    )
    driver = assembly.build_drivers(scene)[0]
    driver.open()
    (first,) = driver.read_ready()
    driver.close()
    clock = Clock(first.t_ns)
    pipeline = assembly.build_pipeline(scene, assembly.load_model(scene), clock)
    assert first.t_ns == clock()
    judgement = pipeline.judge(first)  # type: ignore[arg-type]
    assert judgement.outcome is (Outcome.SLIP if threshold < 0.5 else Outcome.STABLE)
    clock.now_ns += 2_000_000
    assert pipeline.judge(reading(clock() - 1_500_000)).outcome is Outcome.UNKNOWN


def test_the_rate_and_the_faults_of_the_scene_arrive_at_the_replay() -> None:
    tactile = REPLAY | {"rate_hz": 20.0, "speed": 2.0, "faults": {"slow_every": 7}}
    scene = parse({"tactile": tactile}, Path("scene.toml"))
    clock = Clock()
    (driver,) = assembly.build_drivers(scene, clock)
    assert isinstance(driver, ReplayDriver)
    driver.open()
    times_ns = []
    for _ in range(15):
        clock.now_ns = max(clock.now_ns, driver.due_ns() or 0)
        times_ns += [found.t_ns for found in driver.read_ready()]
    driver.close()
    assert driver.period_ns == 25_000_000
    assert [time_ns - times_ns[0] for time_ns in times_ns] == [0, 175_000_000, 350_000_000]


def test_the_port_of_the_scene_arrives_at_the_bridge() -> None:
    tactile = {"driver": "spi", "port": "/dev/serial/by-id/mine", "sensors": ["th", "mf", "ff"]}
    scene = parse({"tactile": tactile}, Path("scene.toml"))
    (driver,) = assembly.build_drivers(scene)
    assert isinstance(driver, SpiBridgeDriver)
    assert driver.describe()["port"] == "/dev/serial/by-id/mine"
