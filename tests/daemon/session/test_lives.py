"""Sessions over many starts: kills, exchanges, models, a full disk, unreadable files."""

from __future__ import annotations

import os
import threading
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from tempfile import mkdtemp

import msgspec
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
    run_state_machine_as_test,
)

from graspd.daemon.publish.companion import KEPT, Reply, Told
from graspd.daemon.session.file import KeptSession, SessionFileError
from graspd.daemon.session.folder import SessionFolder, look
from graspd.daemon.session.keeper import SAVE_PERIOD_NS
from graspd.daemon.trust.lift_book import GraspId
from tests.daemon.fakes import Clock
from tests.daemon.session.learning import (
    BOOT,
    calibration,
    go_round,
    judge,
    observe,
    read_once,
    sealed,
    sensors,
    session_keeper,
    tell,
    trust,
)
from tests.kit.waiting import wait_until

MODELS, SENSORS = st.sampled_from("ab"), st.sampled_from("AAABBBCDEFG")
UNREADABLE = st.sampled_from((b"", b"?" * 99, sealed(msgspec.msgpack.encode({"version": 4}))))
"""Contents of unreadable session files: empty, damaged, of a newer graspd."""


@dataclass
class Session:
    """Expected session of a sensor and a model: its numbers of grasps and of outcomes."""

    model: str
    sensor: str
    grasps: int = 0
    outcomes: int = 0

    @property
    def is_empty(self) -> bool:
        return not (self.grasps or self.outcomes)


class Model:
    """Expected state: the session that runs, the others, and the sessions on the disk."""

    def __init__(self) -> None:
        self.running = Session("a", "")
        self.others: list[Session] = []  # the last used first
        self.disk: list[Session] = []  # the same, with the running one before them
        self.known: list[Session] = []  # what there was at the start, or at the last save

    def save(self) -> None:
        """Expect a save: five sessions stay, and a running empty one; other empty ones go first."""
        now = [copy(each) for each in (self.running, *self.others)]
        if now == self.known:
            return  # nothing is written where nothing is new
        self.known = now
        others = sorted(self.others, key=lambda each: each.is_empty)
        most = 5 - (not self.running.is_empty)
        self.disk = [copy(each) for each in (self.running, *others[:most])]

    def newest_of_each(self, sessions: list[Session]) -> list[Session]:
        newest: dict[tuple[str, str], Session] = {}
        for each in sessions:
            key = each.model, each.sensor
            if key not in newest or (newest[key].is_empty and not each.is_empty):
                newest[key] = copy(each)  # in the place of the empty one
        return list(newest.values())

    def start(self, model: str, *, is_spoiled: bool) -> None:
        """Expect that the last session continues, with what the model last learned with its sensor.

        `is_spoiled`: the last file is unreadable, maybe of another sensor, so nothing continues.
        """
        kept = self.newest_of_each(self.disk)
        self.running, self.others = Session(model, ""), kept
        if kept:
            running, learned = self.with_sensor(kept[0].sensor)
            self.running, self.others = running, [each for each in kept if each is not learned]
        if is_spoiled and kept:
            self.leave()
            self.running = Session(model, self.running.sensor)
        self.known = [copy(each) for each in (self.running, *self.others)]

    def with_sensor(self, sensor: str) -> tuple[Session, Session | None]:
        """Return the session to run with a sensor, and the kept one with its learning, or None."""
        model = self.running.model
        of_it = [each for each in self.others if each.sensor == sensor]
        learned = next((each for each in of_it if each.model == model), None)
        grasps = of_it[0].grasps if of_it else 0
        return Session(model, sensor, grasps, learned.outcomes if learned else 0), learned

    def leave(self) -> None:
        if not self.running.is_empty:
            self.others = self.newest_of_each([self.running, *self.others])[:5]

    def see(self, sensor: str) -> None:
        """Expect another session if the sensor is another one: its own if it was there before."""
        if self.running.sensor in ("", sensor):
            self.running.sensor = sensor
            return
        running, learned = self.with_sensor(sensor)
        self.others = [each for each in self.others if each is not learned]
        self.leave()
        self.running = running


class Lives(RuleBasedStateMachine):
    """A daemon that starts and ends in random steps, each compared with the simulation `Model`."""

    full: list[bool]
    """One item: True if the disk refuses to write."""

    @initialize()
    def begin(self) -> None:
        self.threads = threading.active_count()
        self.path = Path(mkdtemp()) / "right"
        self.clock, self.driver, self.model = Clock(), sensors(ff="A"), Model()
        self.number = self.seed = 0
        self.spoiled = dict[Path, bytes]()
        self.acknowledged: list[int] = []
        self.replies, self.expected = list[Reply](), list[bool]()
        self.full[0] = False
        self.start("a", is_spoiled=False)

    def start(self, model: str, *, is_spoiled: bool) -> None:
        self.session, self.part = calibration(), trust(model)
        self.folder = SessionFolder(self.path)
        self.keeper = session_keeper(
            self.session, self.driver, self.folder, self.clock, part=self.part
        )
        if model != self.model.running.model:
            self.acknowledged = []
        self.model.start(model, is_spoiled=is_spoiled)
        for grasp in self.acknowledged:
            assert self.part.lifts.is_told(GraspId(BOOT, grasp))
        self.agree()
        self.see(self.driver.known["ff"])

    def may_be_saved(self) -> None:
        go_round(self.keeper)
        if not self.full[0]:
            self.model.save()

    @rule(number=st.integers(1, 3))
    def grasp(self, number: int) -> None:
        self.seed += 1
        observe(self.session, number, seed=self.seed)
        self.model.running.grasps += number

    @rule(times=st.sampled_from((1, 1, 3)))
    def lift(self, times: int) -> None:
        """Judge grasps and report outcomes, which are answered once they are on the disk."""
        for _ in range(times):
            self.number += 1
            judge(self.part, self.number)
            tell(self.part, self.number)
            self.model.running.outcomes += 1
            self.keeper.keep(self.replies.append)
            self.expected.append(not self.full[0])
            self.may_be_saved()
            self.acknowledged += [] if self.full[0] else [self.number]

    @rule(sensor=SENSORS)
    def see(self, sensor: str) -> None:
        is_exchanged = self.model.running.sensor not in ("", sensor)
        counted = self.counted
        self.driver.known = {"ff": sensor}
        read_once(self.keeper)
        self.model.see(sensor)
        assert self.counted == counted, "slips that were counted stay counted"
        go_round(self.keeper)
        if is_exchanged and not self.full[0]:
            self.model.save()

    @rule()
    def wait(self) -> None:
        """Let ten seconds pass, after which all is on the disk unless it is full."""
        self.clock.now_ns += SAVE_PERIOD_NS
        read_once(self.keeper)
        self.may_be_saved()

    @rule(is_full=st.booleans())
    def fill_the_disk(self, is_full: bool) -> None:
        self.full[0] = is_full

    @property
    def counted(self) -> tuple[int, int]:
        return self.part.risk.lifts, self.part.risk.slips

    def stop(self) -> None:
        self.clock.now_ns += SAVE_PERIOD_NS
        go_round(self.keeper)  # the last save waits for the disk, and not for long
        self.keeper.save()
        wait_until(lambda: threading.active_count() <= self.threads)
        self.folder.close()

    @rule(model=MODELS, spoils=st.none() | st.none() | UNREADABLE, is_killed=st.booleans())
    def restart(self, model: str, spoils: bytes | None, is_killed: bool) -> None:
        """End the daemon and start it with `model`; a kill is an end at which nothing is written.

        `spoils`: content of an unreadable newest file; None: no such file.
        """
        self.full[0] = is_killed or self.full[0]
        self.stop()
        counted = None if self.full[0] or model != self.model.running.model else self.counted
        if not self.full[0]:
            self.model.save()
        self.full[0] = False
        if spoils is not None:
            path = self.path / f"{max(look(self.path), default=0) + 1}.session"
            path.write_bytes(spoils)
            self.spoiled[path] = spoils
        last = next(iter(look(self.path).values()), None)
        self.start(model, is_spoiled=isinstance(last, SessionFileError))
        assert counted in (None, self.counted)

    @invariant()
    def agree(self) -> None:
        running = self.model.running
        assert self.session.grasps == running.grasps
        assert self.part.learner.outcomes == running.outcomes
        assert [reply == KEPT for reply in self.replies] == self.expected
        assert {reply.told for reply in self.replies} <= {Told.KEPT, Told.NOT_KEPT}
        found = [
            Session(each.model, each.serials.get("ff", ""), each.grasps, outcomes_in(each))
            for each in look(self.path).values()
            if isinstance(each, KeptSession)
        ]
        assert found[:1] == self.model.disk[:1]
        assert sorted(found, key=repr) == sorted(self.model.disk, key=repr)
        self.model.disk = found  # the others are in the order of their files
        for path, data in self.spoiled.items():
            assert path.read_bytes() == data

    def teardown(self) -> None:
        if hasattr(self, "keeper"):
            self.stop()


def outcomes_in(kept: KeptSession) -> int:
    return 0 if kept.trust is None else kept.trust.learner.outcomes


@pytest.mark.slow
def test_sessions_after_many_restarts_equal_those_of_a_simulation(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    full = [False]

    def fsync(_descriptor: int) -> None:
        if full[0]:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(Lives, "full", full, raising=False)
    run_state_machine_as_test(
        Lives, settings=settings(derandomize=True, max_examples=40, stateful_step_count=30)
    )
