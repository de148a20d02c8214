"""What a start finds of the sessions, and of what outcomes taught, before it."""

from __future__ import annotations

import pytest

from graspd.daemon.session.file import KeptSession
from graspd.daemon.session.folder import SessionFolder
from graspd.daemon.trust.lift_book import OutcomeStatus
from tests.daemon.session.learning import (
    FINGERS,
    calibration,
    judge,
    kept_in,
    kept_trust,
    observe,
    read_once,
    sensors,
    session_keeper,
    taught,
    tell,
    trust,
)


def test_session_and_what_was_learned_are_restored_together(folder: SessionFolder) -> None:
    session, part, keeper = taught(folder)
    judge(part, 20)
    keeper.save()
    again, other = calibration(), trust()
    session_keeper(again, sensors(), folder, part=other)
    assert (again.state(), other.state()) == (session.state(), part.state())
    assert tell(other, 20) is OutcomeStatus.TAKEN  # of a grasp of the former start
    assert tell(other, 3) is OutcomeStatus.REPEATED


def test_another_model_continues_the_session_and_learns_again(
    folder: SessionFolder, caplog: pytest.LogCaptureFixture
) -> None:
    session, part = calibration(), trust("a")
    observe(session, 30)
    judge(part, 1)
    tell(part, 1)
    folder.save([KeptSession(session.state(), FINGERS, {"ff": "A"}, part.state())])
    again, other = calibration(), trust("b")
    session_keeper(again, sensors(), folder, part=other)
    assert again.state() == session.state()
    assert other.state() == trust("b").state()
    said = "what was learned is of another model; learning and the count of the risk begin again"
    assert caplog.text.count(said) == 1


def test_state_that_a_run_does_not_use_stays(folder: SessionFolder) -> None:
    session, part = calibration(), trust()
    observe(session, 30)
    judge(part, 1)
    tell(part, 1)
    folder.save([KeptSession(session.state(), FINGERS, {"ff": "A"}, part.state())])
    image = trust("of images", inputs=0)
    keeper = session_keeper(None, sensors(), folder, part=image)  # a model without session
    judge(image, 2)
    tell(image, 2)
    keeper.save()
    assert [kept.statistics for kept in kept_in(folder.path)] == [None, session.state()]
    assert kept_trust(folder) == image.state()
    off = calibration()
    keeper = session_keeper(off, sensors(), folder)  # learning is switched off
    observe(off, 1, seed=5)
    keeper.save()
    assert kept_trust(folder) == part.state()
    keeper = session_keeper(off, sensors(ff="B"), folder)
    read_once(keeper)  # it has another sensor: what was learned must go
    keeper.save()
    assert (off.grasps, kept_trust(folder)) == (0, None)


def test_an_exchanged_sensor_ends_what_was_learned(folder: SessionFolder) -> None:
    session, part, driver = calibration(), trust(), sensors(ff="A")
    keeper = session_keeper(session, driver, folder, part=part)
    read_once(keeper)
    observe(session, 30)
    for grasp in range(20):
        judge(part, grasp)
        tell(part, grasp)
    lifts = part.risk.lifts
    driver.known = {"ff": "B"}
    read_once(keeper)
    keeper.save()
    again, other = calibration(), trust()
    session_keeper(again, driver, folder, part=other)
    assert (again.grasps, other.learner.outcomes, other.risk.proven) == (0, 0, 0)
    assert other.risk.lifts == lifts > 0  # slips that were counted stay counted


def test_sensors_that_return_bring_learning_and_forget_no_slip(
    folder: SessionFolder,
) -> None:
    driver, part = sensors(ff="A"), trust()
    keeper = session_keeper(None, driver, folder, part=part)
    read_once(keeper)
    for first, sensor in ((0, "B"), (20, "A")):
        for grasp in range(first, first + 20):
            judge(part, grasp)
            tell(part, grasp)
        learned, counted = part.learner.state(), part.risk.state()
        if first == 0:
            taught = learned
        driver.known = {"ff": sensor}
        read_once(keeper)
        lifts = part.risk.state().lifts, part.risk.state().slips
        assert lifts == (counted.lifts, counted.slips)
        assert part.risk.proven == 0
    keeper.save()
    assert part.learner.state() == taught != learned
    assert part.risk.lifts > 0


def test_sensors_that_return_after_another_model_bring_learning(folder: SessionFolder) -> None:
    """Five outcomes with each set of sensors."""
    learned: list[int] = []
    for model, sensor_sets in (("a", "X"), ("b", "XY"), ("a", "YX"), ("a", "X")):
        session, part, driver = calibration(), trust(model), sensors()
        keeper = session_keeper(session, driver, folder, part=part)
        for sensor in sensor_sets:
            driver.known = {"ff": sensor}
            read_once(keeper)
            learned.append(part.learner.outcomes)
            for grasp in range(5 * len(learned), 5 * len(learned) + 5):
                observe(session, 1, seed=grasp)
                judge(part, grasp)
                tell(part, grasp)
        keeper.save()
    assert learned == [0, 0, 0, 0, 5, 10]
