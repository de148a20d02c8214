"""Exchanged sensors are noticed by their serial numbers, or by their rest."""

from __future__ import annotations

import itertools
import logging
from contextlib import ExitStack
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import Assembly, Parts
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.judge.reasons import Decision
from graspd.daemon.session.file import KeptSession
from graspd.daemon.session.folder import SessionFolder
from graspd.daemon.session.keeper import SessionKeeper
from graspd.daemon.session.sensors import FIT_GRASPS, LOOK_EVERY, moved_fingers
from graspd.daemon.trust.lift_book import GraspId
from graspd.daemon.trust.trust import Trust
from graspd.drivers.twins.grasps.whole_grasps import rest_above
from graspd.models.judge.session import SessionCalibration
from graspd.models.trust.risk import BUDGET_START
from tests.daemon.fakes import FINGERS, Clock, reading
from tests.daemon.session.learning import (
    BOOT,
    INPUTS,
    FakeJudge,
    calibration,
    judge,
    observe,
    read_once,
    sensor_watch,
    sensors,
    session_keeper,
    tell,
    trust,
)
from tests.daemon.session.robot import Day, Robot


def test_each_change_of_a_serial_number_is_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    driver, exchanges = sensors(), []
    watch = sensor_watch(driver, lambda: exchanges.append(dict(driver.known)))
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
def test_an_exchange_is_noticed_with_or_without_kept_sessions(
    tmp_path: Path, keep: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(
        f'[tactile]\ndriver = "palm"\nsource = "udp://127.0.0.1:9"\n[session]\nkeep = {keep}\n'
        f'folder = "{tmp_path}/session"\n'
    )
    forgotten: list[Pipeline] = []
    monkeypatch.setattr(
        Pipeline, "sensors_exchanged", lambda pipeline, *_: forgotten.append(pipeline)
    )
    wanted = scene.load(path)
    parts, driver = Parts.of(Plan.of(wanted), assembly.load_model(wanted)), sensors(ff="A")
    parts.drivers[:] = [driver]
    with ExitStack() as stack:
        around = Assembly(parts, stack)
        around.keep_session()
        (watch,) = around.companions
        assert isinstance(watch, SessionKeeper) is (keep == "true")
        read_once(watch)
        driver.known = {"ff": "B"}
        read_once(watch)
    assert forgotten == [parts.pipeline]


def test_rests_differ_between_published_days_not_halves_of_one(
    bts3_dir: Path,
) -> None:
    tables = [Day(name, bts3_dir).grasps for name in ("palm_45", "palm_down", "palm_side")]
    for grasps in tables:
        half = len(grasps) // 2
        assert moved_fingers(rest_above(grasps[:half]), rest_above(grasps[half:])) == []
    for one, other in itertools.combinations(tables, 2):
        assert moved_fingers(rest_above(one), rest_above(other)) == [0]


def test_drift_of_untouched_sensors_is_not_an_exchange(untouched: NDArray[np.uint16]) -> None:
    first, last = (np.median(part, axis=0) for part in (untouched[:100], untouched[-100:]))
    assert moved_fingers(first, last) == []
    assert moved_fingers(first, np.roll(last, 1, axis=0)) != []


def begin(day: Day, robot: Robot) -> None:
    """Calibrate the robot's session by a day, and let the hand be tared at the day's rest."""
    day.teach(robot.pipeline.session, 100)
    verdicts = list(robot.see(day.stream(0, 2)))
    assert len(verdicts) == 2
    assert all(calibrated for _, _, calibrated in verdicts)


def first_slips(robot: Robot, day: Day, number: int, grasps: int) -> list[Decision]:
    """Return the decisions on the first `number` slips among a day's first `grasps` grasps."""
    verdicts = robot.see(day.stream(0, grasps))
    slips = (decision for slipped, decision, _ in verdicts if slipped)
    return list(itertools.islice(slips, number))


def look(keeper: SessionKeeper, times: int = LOOK_EVERY) -> None:
    """Tell a keeper of readings until it has looked at the rest."""
    for _ in range(times):
        keeper.on_reading(reading(0))


PATTERN = np.full((3, 24), 2000.0)
HELD = PATTERN - np.linspace(0.0, 400.0, 24)


def taught() -> tuple[SessionCalibration, Trust]:
    """A calibrated session, and twelve outcomes, all of which count for the warm-up."""
    session, part = calibration(), trust()
    observe(session, 30)
    for grasp in range(12):
        judge(part, grasp)
        tell(part, grasp)
    return session, part


def test_a_hand_closed_at_start_continues_its_session_once_open(tmp_path: Path) -> None:
    now, (session, part) = [PATTERN], taught()
    with SessionFolder(tmp_path / "right") as folder:
        keeper = session_keeper(session, sensors(), folder, part=part, read_rest=lambda: now[0])
        look(keeper)
        keeper.save()
        learned = part.learner.state()
        again, later = calibration(), trust()
        now[0] = HELD
        keeper = session_keeper(again, sensors(), folder, part=later, read_rest=lambda: now[0])
        look(keeper)
        assert (again.grasps, later.learner.outcomes, later.risk.proven) == (0, 0, 0)
        keeper.save()
        now[0] = PATTERN
        look(keeper)
        keeper.save()
    assert (again.grasps, later.risk.proven) == (30, 12)
    assert later.learner.state() == learned


def test_exchanged_sensors_must_calibrate_after_a_restart_too(tmp_path: Path) -> None:
    needs = []
    with SessionFolder(tmp_path / "right") as folder:
        for rest, grasps in ((PATTERN, 30), (HELD, 5), (HELD, 25), (HELD, 0)):
            hand = FakeJudge(session := calibration(), read_rest=rest.copy)
            keeper = SessionKeeper(cast(Pipeline, hand), FINGERS, sensors(), folder, Clock())
            before = hand.needs_session
            look(keeper)
            needs.append((before, hand.needs_session))
            observe(session, grasps)
            keeper.save()
    assert needs == [(False, False), (False, True), (True, True), (False, False)]


def test_another_sending_port_alone_is_not_an_exchange_of_sensors(tmp_path: Path) -> None:
    """As when a program that forwards readings restarts: the sensors rest as before."""
    now, (session, part) = [PATTERN], taught()
    driver = sensors(**dict.fromkeys(FINGERS, "udp://192.0.2.1:4001"))
    with SessionFolder(tmp_path / "right") as folder:
        keeper = session_keeper(session, driver, folder, part=part, read_rest=lambda: now[0])
        look(keeper)
        driver.known = dict.fromkeys(FINGERS, "udp://192.0.2.1:4002")
        now[0] = np.zeros((3, 24))
        look(keeper)
        assert session.grasps == 0  # nothing is judged before the hand was seen open
        now[0] = PATTERN
        look(keeper)
        assert (session.grasps, part.learner.outcomes, part.risk.proven) == (30, 12, 12)
        driver.known = dict.fromkeys(FINGERS, "udp://192.0.2.1:4003")
        now[0] = np.zeros((3, 24))
        look(keeper)
        now[0] = HELD  # another hand
        look(keeper)
        keeper.save()
    assert (session.grasps, part.learner.outcomes, part.risk.proven) == (0, 0, 0)


def test_returning_sensors_get_their_slip_budget_and_outcomes_back(tmp_path: Path) -> None:
    """A session of other sensors, without outcomes, was the last one that ran."""
    former, now = trust(), trust()
    for grasp in (1, 2):
        named = GraspId(BOOT, grasp)
        former.lifts.note(named, bytes(8 * (INPUTS + 2)), stable=True)
        former.outcome(named, slipped=True)
    with SessionFolder(tmp_path / "right") as folder:
        between = KeptSession(calibration().state(), FINGERS, dict.fromkeys(FINGERS, "B"))
        first = KeptSession(
            calibration().state(), FINGERS, dict.fromkeys(FINGERS, "A"), former.state()
        )
        folder.save([between, first])
        driver = sensors(**dict.fromkeys(FINGERS, "B"))
        keeper = session_keeper(calibration(), driver, folder, part=now)
        look(keeper)
        assert now.risk.budget == BUDGET_START
        driver.known = dict.fromkeys(FINGERS, "A")
        look(keeper)
        keeper.save()
    assert now.risk.budget == pytest.approx(BUDGET_START - 2 * 0.9)
    assert now.learner.outcomes == 2


def test_each_set_of_sensors_without_serials_keeps_its_session(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Three hands in turn: the session of each is there when it is back, and the log says so."""
    hands = [PATTERN, HELD, PATTERN - np.linspace(400.0, 0.0, 24)]
    now, session = [hands[0]], calibration()
    with SessionFolder(tmp_path / "right") as folder:
        keeper = session_keeper(session, sensors(), folder, read_rest=lambda: now[0])
        found = []
        for number, rest in enumerate((*hands, *hands)):
            for now[0] in (np.zeros((3, 24)), rest):
                look(keeper)
            found.append(session.grasps)
            if number < 3:
                observe(session, 20 + number, seed=number)
        keeper.save()
    assert found == [0, 0, 0, 20, 21, 22]
    said = ["treated as other sensors", "these sensors were there before"]
    logged = [[text for text in said if text in line] for line in caplog.messages]
    assert logged == [said[:1]] * 2 + [said[1:]] * 3


def seed(robot: Robot, day: Day) -> None:
    """Restart the robot with a kept session of a day's grasps that does not name its sensors."""
    robot.stop()
    recorded = calibration_of(robot.pipeline)
    day.teach(recorded, 300)
    with SessionFolder(robot.folder / "right") as folder:
        folder.load()
        folder.save([KeptSession(recorded.state(), FINGERS, {})])
    robot.start()


def calibration_of(pipeline: Pipeline) -> SessionCalibration:
    if pipeline.session is None:
        raise ValueError("a model without a session")
    return pipeline.session


@pytest.mark.parametrize("other", ["palm_down", "palm_side"])
def test_a_seeded_session_of_other_sensors_is_not_used(
    bts3_dir: Path, tmp_path: Path, other: str
) -> None:
    """If the seeded session were used, 24 of 25 first slips would be called stable."""
    robot = Robot(tmp_path)
    seed(robot, Day("palm_45", bts3_dir))
    slips = first_slips(robot, Day(other, bts3_dir), 15, 40)
    grasps = calibration_of(robot.pipeline).grasps
    robot.stop()
    assert len(slips) == 15
    assert slips.count(Decision.STABLE) <= 2
    assert grasps < 60  # its own only


def test_a_seeded_session_is_used_once_live_grasps_fit_it(bts3_dir: Path, tmp_path: Path) -> None:
    robot, day = Robot(tmp_path), Day("palm_down", bts3_dir)
    seed(robot, day)
    calibrated = [known for _, _, known in robot.see(day.stream(0, 16))]
    assert not any(calibrated[:FIT_GRASPS])
    assert calibrated[-1]
    assert calibration_of(robot.pipeline).grasps >= 300
    robot.restart()  # it is that of these sensors from now on
    assert all(known for _, _, known in robot.see(day.stream(20, 2)))
    robot.stop()


def test_taring_one_finger_alone_is_not_an_exchange() -> None:
    """The finger may touch the table for half a minute and be tared there."""
    now, exchanges = np.full((3, 24), 2000.0), list[object]()
    watch = sensor_watch(sensors(), lambda: exchanges.append(None), now.copy)
    for rest in (2000.0, 0.0, np.linspace(1500.0, 2000.0, 24), 2000.0):
        now[1] = rest
        for _ in range(LOOK_EVERY):
            watch.on_reading(reading(0))
    assert exchanges == []


def test_an_outage_and_a_restart_end_no_session(
    bts3_dir: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    robot, day = Robot(tmp_path), Day("palm_45", bts3_dir)
    begin(day, robot)
    with caplog.at_level(logging.WARNING):
        for interrupt in (robot.outage, robot.restart, robot.outage):
            interrupt()
            assert all(calibrated for _, _, calibrated in robot.see(day.stream(2, 2)))
    assert "other sensors" not in caplog.text
    other = Day("palm_down", bts3_dir)
    for interrupt in (robot.restart, robot.outage):
        interrupt()
        assert not any(calibrated for _, _, calibrated in robot.see(other.stream(0, 2)))
        robot.restart()
        assert all(calibrated for _, _, calibrated in robot.see(day.stream(2, 2)))
    robot.stop()
