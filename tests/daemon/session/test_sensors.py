"""Sensors that are others than before are noticed with and without a session that is kept."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from pathlib import Path

import pytest

from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import Assembly, Parts
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.session.sensors import SensorWatch
from tests.daemon.session.learning import read_once, sensors


def test_another_sensor_is_told_once_and_before_its_readings(
    caplog: pytest.LogCaptureFixture,
) -> None:
    driver, exchanges = sensors(), []
    watch = SensorWatch(driver, lambda *_: exchanges.append(dict(driver.known)))
    steps: list[dict[str, str]] = [
        {},
        {"ff": "A", "mf": "B"},
        {"ff": "A"},  # one does not answer
        {"ff": "A", "mf": "B"},
        {"ff": "A", "mf": "C"},
        {"ff": "A", "mf": "C"},
        {"ff": "A", "mf": "B"},  # and the former one is back
    ]
    with caplog.at_level(logging.WARNING):
        for known in steps:
            driver.known = known
            read_once(watch)
    assert exchanges == [steps[4], steps[6]]
    assert caplog.text.count("new sensor on mf") == 2


@pytest.mark.parametrize("keep", ["true", "false"])
def test_tare_and_grasp_are_forgotten_whether_or_not_a_session_is_kept(
    tmp_path: Path, keep: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(
        f'[tactile]\ndriver = "palm"\nsource = "udp://127.0.0.1:9"\n[session]\nkeep = {keep}\n'
        f'file = "{tmp_path}/session.json"\n'
    )
    forgotten: list[Pipeline] = []
    monkeypatch.setattr(
        Pipeline, "sensors_exchanged", lambda pipeline, *_: forgotten.append(pipeline)
    )
    wanted = scene.load(path)
    parts, driver = Parts.of(wanted, assembly.load_model(wanted)), sensors(ff="A")
    parts.drivers[:] = [driver]
    with ExitStack() as stack:
        around = Assembly(parts, stack)
        assert around.keep_session() is (keep == "true")
        (watch,) = around.companions
        read_once(watch)
        driver.known = {"ff": "B"}
        read_once(watch)
    assert forgotten == [parts.pipeline]
