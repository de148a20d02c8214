"""What outcomes taught is saved with the session; each outcome is answered once it is saved."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.judge.reasons import Reason
from graspd.daemon.publish.companion import KEPT, Reply, Told
from graspd.daemon.session.file import KeptSession
from graspd.daemon.session.folder import SessionFolder
from graspd.daemon.session.keeper import BUSY, HANGS, WAIT_S, WAITING_MAX, SessionKeeper
from graspd.daemon.session.sensors import LOOK_EVERY
from graspd.daemon.trust.lift_book import OutcomeStatus
from graspd.daemon.trust.trust import Trust
from tests.daemon.fakes import Clock
from tests.daemon.session.learning import (
    FINGERS,
    NOBODY,
    FakeJudge,
    calibration,
    go_round,
    judge,
    kept_in,
    kept_trust,
    observe,
    read_once,
    sensors,
    session_keeper,
    tell,
    trust,
)
from tests.kit.disk import Disk

KeeperOf = Callable[..., SessionKeeper]


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch, "fsync")


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[SessionFolder]:
    with SessionFolder(tmp_path / "right") as folder:
        yield folder


@pytest.fixture
def keeper_of(folder: SessionFolder) -> Iterator[Callable[..., SessionKeeper]]:
    """Yield a function that makes keepers, which end after the test."""
    made: list[SessionKeeper] = []

    def make(part: Trust, clock: Clock | None = None) -> SessionKeeper:
        made.append(session_keeper(None, sensors(), folder, clock or Clock(), part=part))
        return made[-1]

    yield make
    for keeper in made:
        keeper.save()


def outcomes(folder: SessionFolder) -> int:
    kept = kept_trust(folder)
    return 0 if kept is None else kept.learner.outcomes


def test_a_disk_that_hangs_does_not_hold_up_the_loop(
    folder: SessionFolder, disk: Disk, keeper_of: KeeperOf
) -> None:
    part = trust()
    found: list[tuple[int, Reply, int]] = []
    keeper = keeper_of(part)

    def answer(grasp: int, reply: Reply) -> None:
        found.append((grasp, reply, outcomes(folder)))

    disk.goes_on.clear()
    told = WAITING_MAX + 6
    for grasp in range(told):
        judge(part, grasp)
        tell(part, grasp)
        keeper.keep(partial(answer, grasp))
        keeper.before_wait(NOBODY)
    assert found == [(grasp, BUSY, 0) for grasp in range(6)]
    disk.goes_on.set()
    go_round(keeper)
    assert [(grasp, reply) for grasp, reply, _ in found[6:]] == [
        (grasp, KEPT) for grasp in range(6, told)
    ]
    # Each outcome is on the disk before its answer; those during the first save share the next.
    assert {on_disk for _, _, on_disk in found[7:]} == {told}
    assert disk.written == 2
    assert kept_trust(folder) == part.state()


def test_a_disk_that_hangs_does_not_hold_up_the_shutdown(
    folder: SessionFolder, disk: Disk, keeper_of: KeeperOf
) -> None:
    part: Trust = trust()
    found: list[Reply] = []
    keeper = keeper_of(part)
    disk.goes_on.clear()
    for grasp in range(3):
        judge(part, grasp)
        tell(part, grasp)
        keeper.keep(found.append)
    keeper.save()  # the disk answers only afterwards
    assert found == [HANGS] * 3
    disk.goes_on.set()
    go_round(keeper)
    assert found[3:] == []


def test_a_start_with_other_fingers_keeps_the_former_session(folder: SessionFolder) -> None:
    session, part = calibration(), trust()
    keeper = session_keeper(session, sensors(), folder, part=part)
    observe(session, 30)
    judge(part, 1)
    tell(part, 1)
    keeper.save()
    other = trust("of two fingers", inputs=52)
    judged = cast(Pipeline, FakeJudge(None, other))
    for grasp in range(5):
        keeper = SessionKeeper(judged, ("ff", "th"), sensors(), folder, Clock())
        judge(other, grasp)
        tell(other, grasp)
        keeper.save()
    again, back = calibration(), trust()
    session_keeper(again, sensors(), folder, part=back).save()
    assert (again.state(), back.state()) == (session.state(), part.state())
    third = trust("of two fingers", inputs=52)
    SessionKeeper(cast(Pipeline, FakeJudge(None, third)), ("ff", "th"), sensors(), folder, Clock())
    assert third.state() == other.state()


def test_the_session_of_a_start_without_readings_continues(
    folder: SessionFolder, caplog: pytest.LogCaptureFixture
) -> None:
    """It was only told an outcome that it did not know, so it has neither grasps nor a rest."""
    part, later, exchanges = trust(), trust(), list[None]()
    keeper = session_keeper(calibration(), sensors(), folder, part=part)
    assert tell(part, 7) is OutcomeStatus.UNKNOWN
    keeper.save()
    assert len(kept_in(folder.path)) == 1
    rest = np.full((3, 24), 2000.0)
    hears = FakeJudge(calibration(), later, lambda: rest, lambda: exchanges.append(None))
    keeper = SessionKeeper(cast(Pipeline, hears), FINGERS, sensors(), folder, Clock())
    for _ in range(LOOK_EVERY):
        read_once(keeper)
    keeper.save()
    assert (exchanges, caplog.messages) == ([], [])
    assert later.state() == part.state()


@pytest.mark.parametrize(("sensor", "continued"), [("A", 30), ("B", 0)])
def test_an_empty_session_continues_only_without_another_of_its_sensors(
    folder: SessionFolder, sensor: str, continued: int
) -> None:
    """The session of sensor A cannot be read at one start, with `sensor`, and can at the next."""
    path, session, again = folder.path / "1.session", calibration(), calibration()
    keeper = session_keeper(session, sensors(ff="A"), folder, part=trust())
    read_once(keeper)
    observe(session, 30)
    keeper.save()
    kept = path.read_bytes()
    path.write_bytes(b"?")
    keeper = session_keeper(calibration(), sensors(ff=sensor), folder, part=trust())
    read_once(keeper)
    keeper.save()
    path.write_bytes(kept)
    keeper = session_keeper(again, sensors(ff=sensor), folder, part=trust())
    assert again.grasps == continued
    read_once(keeper)
    keeper.save()
    assert max(each.grasps for each in kept_in(folder.path)) == 30


def test_a_folder_that_cannot_be_made_is_tried_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The folder that shall contain it is missing until the second try."""
    gone = tmp_path / "gone"
    folder, part, found = SessionFolder(gone / "right"), trust(), list[Reply]()
    keeper = session_keeper(None, sensors(), folder, part=part)
    judge(part, 1)
    tell(part, 1)
    keeper.keep(found.append)
    go_round(keeper)
    where = f"{gone}/right: cannot keep the session: No such file or directory"
    assert found == [Reply(Told.NOT_KEPT, where)]
    assert caplog.text.count(where) == 1
    assert keeper.health == {"session": Reason.NOT_KEPT}
    gone.mkdir()
    keeper.keep(found.append)
    go_round(keeper)
    assert (found[1:], keeper.health) == ([KEPT], {})
    assert kept_trust(folder) == part.state()
    keeper.save()
    folder.close()


@pytest.mark.parametrize("writes", [False, True])
def test_a_file_changed_by_another_graspd_is_never_replaced(tmp_path: Path, writes: bool) -> None:
    path, mine, theirs, found = tmp_path / "right", trust(), trust(), list[Reply]()
    with SessionFolder(path) as other:
        other.save([KeptSession(None, FINGERS, {}, theirs.state())])
        folder = SessionFolder(path)
        keeper = session_keeper(None, sensors(), folder, part=mine)
        judge(mine, 1)
        tell(mine, 1)
        keeper.keep(found.append)
        go_round(keeper)
        judge(theirs, 2)
        if writes:
            other.save([KeptSession(None, FINGERS, {}, theirs.state())])
    for _ in range(2):
        keeper.keep(found.append)
        go_round(keeper)
    keeper.save()
    folder.close()
    in_use = f"{path}: in use by another graspd, stop that one first"
    changed = Reply(Told.NOT_KEPT, f"{path}: changed since the start, start graspd again")
    assert found == [Reply(Told.NOT_KEPT, in_use), *[changed if writes else KEPT] * 2]
    assert kept_trust(folder) == (theirs if writes else mine).state()


def test_an_unexpected_error_of_a_save_is_answered_not_kept(
    folder: SessionFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    part, found = trust(), list[Reply]()
    keeper = session_keeper(None, sensors(), folder, part=part)
    save = folder.save
    monkeypatch.setattr(folder, "save", lambda *_: 1 // 0)
    judge(part, 0)
    keeper.keep(found.append)
    keeper.wait(WAIT_S)
    assert found == [Reply(Told.NOT_KEPT, "it could not be written")]
    monkeypatch.setattr(folder, "save", save)
    keeper.keep(found.append)
    keeper.save()
    assert found[1:] == [KEPT]


def test_kept_state_that_a_run_does_not_use_stays_kept(folder: SessionFolder) -> None:
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
