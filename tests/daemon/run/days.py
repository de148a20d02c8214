"""Days of a whole daemon in simulated time, with faults that a seed draws.

Only clocks, sensors, the thread of the disk and the process of the door are replaced.
`python -m tests.daemon.run.days 7` runs the day of seed 7, with `7 90` those from 7 to 89.
"""

from __future__ import annotations

import os
import sys
import tempfile
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from graspd.biotac import electrode_name
from graspd.daemon import scene as scenes
from graspd.daemon.assembly.parts import Parts
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.judge.reasons import Reason
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.process.sleep import Sleep
from graspd.daemon.publish import sockets
from graspd.daemon.publish.companion import Companion, PublishedVerdict
from graspd.daemon.publish.messages import Status
from graspd.daemon.publish.outbox import Outbox
from graspd.daemon.run.loop import LoopTiming
from graspd.daemon.run.runner import Runner
from graspd.daemon.run.systemd import Systemd
from graspd.daemon.session.keeper import SessionKeeper
from graspd.drivers.base import JointReading, Reading, TactileReading
from graspd.models import zoo
from graspd.models.runtime import TactileModel
from tests.daemon.fakes import FINGERS, MS
from tests.daemon.judge.necessity import AGE_MAX_MS, EARLY_MS, STILL_MS, Necessity
from tests.daemon.run.around import SLACK_NS, Disk, Door, KilledError, S, Selector, World
from tests.daemon.run.hands import FAULTS, Fault, Sensors
from tests.kit.messages import decode_status, decode_verdict

AGE_NS = AGE_MAX_MS * MS
MOVED_COUNTS = 40.0
"""Mean change of a finger's counts that is motion; different grasps differ by more."""
SAID_AFTER_NS = 1300 * MS
"""Longest time until a lasting fault is in the status, ns."""
ROUNDS_MAX = 1000
"""Most rounds of the loop at one simulated time: a flood of questions takes forty."""
TROUBLE_NS, CALM_NS = 12 * S, 9 * S
OPEN_MS = 100
"""Time for which the hand stays open after each verdict with the reason `not-tared`, ms."""
WITHHELD = {"low-confidence", "unproven", "risk-exceeded", "not-calibrated", "never-seen"}
"""Reasons, due to earlier outcomes or grasps, why a sound, settled grasp may be `unknown`."""


@cache
def model() -> TactileModel:
    return TactileModel(zoo.find("small-session"))


class Watch(Companion):
    """Checks the daemon's promises in each round; runs in place of the service manager."""

    def __init__(self, day: Day) -> None:
        self.day, self.world, self.sensors = day, day.world, day.sensors
        self._still_ms = EARLY_MS if day.scene.gate.early else STILL_MS
        self._see_sensors()
        self._said_ns = self._status_ns = self.world.worked_ns
        self._silence_ns = AGE_NS
        self._seq = self._round_ns = -1
        self._rounds = self._given = self._judged = self._waiting = 0
        self._began_ns = -S
        day.door.hear = self._hear

    def _see_sensors(self) -> None:
        self._rest = self.sensors.rest
        self.necessity = Necessity(
            self._rest,
            FINGERS,
            self.day.scene.gate.fingers or FINGERS,
            self._still_ms,
            moved_counts=MOVED_COUNTS,
        )

    def ready(self, _text: str) -> None:
        """Ignore the message that the daemon is ready."""

    def on_reading(self, reading: Reading) -> None:
        if self._rest is not self.sensors.rest:
            self._see_sensors()
        if reading.interrupted:
            self._began_ns = reading.t_ns
        if isinstance(reading, JointReading):
            self.necessity.observe_joints(reading)
        else:
            self._given += 1
            self._waiting += 1

    def on_verdict(self, published: PublishedVerdict) -> None:
        verdict, reading = published.verdict, published.reading
        self.day.said[verdict.verdict] += 1
        self.day.judged += verdict.judged
        if reading is not None:
            self._judged += 1
            self._waiting -= 1
            self.necessity.observe(reading)
            if Reason.NOT_TARED in verdict.reasons:
                self.sensors.rest_for(OPEN_MS)
            if self._waiting:  # some were skipped
                self._waiting, self._began_ns = 0, reading.t_ns
        unknown = verdict.verdict == "unknown"
        assert unknown is bool(verdict.reasons) is (verdict.p_slip is None) is not verdict.valid
        if set(verdict.reasons) <= WITHHELD:
            assert reading is not None, "a verdict on nothing"
            lacks = self._lacks(reading)
            if not unknown and published.lifts.is_told(published.grasp):
                lacks.append("a lift that is not over")
            if verdict.verdict == "stable":
                lacks += self._lacks_trust(published)
            assert not lacks, f"{verdict.verdict} {verdict.reasons} without {lacks}"
        self.world.stall(self.day.cost_ns)

    def _lacks(self, reading: TactileReading) -> list[str]:
        """Return what the hand lacks for a verdict other than `unknown`, as texts."""
        lacks = self.necessity.lacks()
        if not 0 <= self.world.now_ns - reading.t_ns <= AGE_NS:
            lacks.append("a reading that is not too old")
        if 0 <= reading.t_ns - self._began_ns < self._still_ms * MS:
            lacks.append("stillness without a gap")
        return lacks

    def _lacks_trust(self, published: PublishedVerdict) -> Iterator[str]:
        verdict, limits = published.verdict, self.day.scene.risk
        if verdict.p_slip is None or verdict.p_slip >= self.day.scene.model.slip_threshold:
            yield "a probability below the threshold"
        if limits is None or verdict.risk is None:
            return
        if verdict.risk.bound is None or verdict.risk.slips > verdict.risk.bound:
            yield "slips within the bound"
        lifts = published.lifts.state().records
        others = [lift for lift in lifts if lift.is_awaited and lift.id != published.grasp]
        if verdict.judged and len(others) >= limits.outstanding_max:
            yield "outcomes of the lifts before"

    def after_round(self) -> None:
        self._rounds = self._rounds + 1 if self._round_ns == self.world.now_ns else 0
        self._round_ns = self.world.now_ns
        assert self._rounds < ROUNDS_MAX, "it does not wait"
        self._check_time()
        for peer in self.day.door.all:
            peer.check_answered()

    def _check_time(self) -> None:
        silent_ns = self.world.worked_ns - self._said_ns
        assert silent_ns <= self._silence_ns + SLACK_NS, f"no verdict for {silent_ns / MS} ms"
        silent_ns = self.world.worked_ns - self._status_ns
        assert silent_ns <= S + SLACK_NS, f"no status for {silent_ns / MS} ms"

    def _hear(self, topic: bytes, payload: bytes) -> None:
        if topic.startswith(b"verdict."):
            self._check_time()
            verdict = decode_verdict(payload)
            assert verdict.seq == self._seq + 1, "a verdict was not sent"
            self._said_ns, self._seq = self.world.worked_ns, verdict.seq
            self._silence_ns = round(verdict.silence_ms * MS)
        elif topic.startswith(b"status."):
            self._check_time()
            self._status_ns = self.world.worked_ns
            self._check_health(decode_status(payload))

    def _check_health(self, status: Status) -> None:
        """Check that a status counts lost readings, and names faults that have lasted."""
        if status.state == "stopping":
            return
        lost = self._given - self._judged - status.skipped_readings
        assert not lost or self.day.slept_ns, f"{lost} readings are not judged"
        now_ns = self.world.now_ns
        if now_ns - self.sensors.handed_ns > self._silence_ns + SLACK_NS + self.day.cost_ns:
            assert (status.state, status.health.get("link")) == ("silent", "stale")
        if len(self.sensors.faults) != 1 or now_ns - self.sensors.since_ns < SAID_AFTER_NS:
            return
        fault = self.sensors.faults[0]
        if fault.kind == "dead":
            assert electrode_name(FINGERS[fault.finger], fault.electrode) in status.health
        if fault.kind in ("no joints", "joints frozen") and self.sensors.joints:
            assert "joints" in status.health


class Day:
    """One hand, its daemon in several lives, and what happens to them."""

    def __init__(self, seed: int, folder: Path) -> None:
        self.seed, self.world = seed, World(seed)
        self.sensors = Sensors(self.world, joints=self.world.random.random() < 0.6)
        self.scene = self._draw_scene(folder)
        self.disk, self.door = Disk(self.world), Door(self.world)
        self.cost_ns = self.slept_ns = 0
        self.said: Counter[str] = Counter()
        self.judged = self._judged_before = self.lives = 0
        self.is_over = False

    def _draw_scene(self, folder: Path) -> scenes.Scene:
        draw = self.world.random
        text: dict[str, dict[str, Any]] = {
            "tactile": {"driver": "spi", "port": "/nowhere"},
            "model": {"slip_threshold": draw.choice((0.5, 0.7, 0.9))},
            "gate": {"mode": draw.choice(("settled", "request")), "early": draw.random() < 0.3},
            "session": {"folder": str(folder / "right")},
            "publish": {"endpoint": f"ipc://{folder}/v", "tactile_hz": draw.choice((0, 25))},
            "ask": {"endpoint": f"ipc://{folder}/ask"},
        }
        if draw.random() < 0.6:
            text["risk"] = {
                "max_slip_when_stable": draw.choice((0.1, 0.3, 0.5)),
                "warm_up": draw.choice((0, 50)),
                "outstanding_max": draw.choice((1, 5)),
            }
        if self.sensors.joints:
            text["joints"] = {"driver": "stream", "source": "udp://127.0.0.1:5701"}
        if draw.random() < 0.3:
            text["ask"]["tell"] = ["root"]
        if draw.random() < 0.3:
            text["gate"]["fingers"] = ["ff", "th"]
        return scenes.parse(text, folder / "scene.toml")

    def run(self, shifts: int) -> None:
        """Run the daemon, again after each end, for `shifts` times of trouble, and check it."""
        self._plan(shifts)
        while not self.is_over:
            with self._replaced():
                self._live()
            away_ns = self.world.now_ns + self.world.random.choice((100, 800, 3000)) * MS
            while self.world.now_ns < away_ns:
                self.world.kill_ns = None
                self.world.wait(away_ns - self.world.now_ns)

    def _live(self) -> None:
        """Run the daemon from a start to its end, which may be a kill."""
        parts = Parts.of(Plan.of(self.scene), model(), self.sensors, self.world)
        no_signal = cast(StopSignal, SimpleNamespace(received=None, fileno=lambda: 0))
        self.lives += 1
        with closing(Runner(parts, no_signal, manager=cast(Systemd, Watch(self)))) as runner:
            try:
                runner.open()
                self.world.kill_ns = None
                self._check_kept(parts)
                runner.run()
            except KilledError:
                self.door.is_open = False
                self.disk.kill()
        self.door.shut()

    @contextmanager
    def _replaced(self) -> Iterator[None]:
        """Replace the daemon's clocks, waits, disk, sockets and random ids in the block."""
        world, ids = self.world, World(1000 * self.seed + self.lives).random
        timing = partial(
            LoopTiming,
            clock=world,
            sleep=Sleep(world, lambda: world.now_ns + self.slept_ns),
            rest=lambda seconds: world.stall(round(seconds * S)),
            selector=lambda: Selector(world, self.door),
        )
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("graspd.daemon.run.runner.LoopTiming", timing)
            outbox = partial(Outbox, clock=world, wall_clock=lambda: world.now_ns / S)
            patch.setattr("graspd.daemon.assembly.parts.Outbox", outbox)
            keeper = partial(SessionKeeper, clock=world)
            patch.setattr("graspd.daemon.session.keeper.SessionKeeper", keeper)
            patch.setattr("graspd.daemon.session.keeper.Worker", self.disk.plug)
            patch.setattr(sockets, "Sockets", partial(sockets.Sockets, clock=world))
            patch.setattr(sockets, "Door", self.door.plug)
            patch.setattr(sockets, "Listener", lambda *_: SimpleNamespace(close=lambda: None))
            patch.setattr(uuid, "uuid4", lambda: uuid.UUID(int=ids.getrandbits(128)))
            patch.setattr(os, "fsync", self.disk.fsync)
            yield

    def _check_kept(self, parts: Parts) -> None:
        """Check that a new start knows all acknowledged outcomes and offers of lifts."""
        lifts = parts.pipeline.lifts
        for peer in self.door.all:
            for grasp in peer.kept:
                assert lifts.is_told(grasp), f"the outcome of {grasp} was lost"
            for grasp in peer.offers:
                assert lifts.owns(grasp, peer.known), f"the offer of {grasp} was lost"

    def _plan(self, shifts: int) -> None:
        """Plan `shifts` times of trouble, and after each a calm time with a sound grasp."""
        for number in range(shifts):
            self.world.after(number * (TROUBLE_NS + CALM_NS), self._have_trouble)
            self.world.after(number * (TROUBLE_NS + CALM_NS) + TROUBLE_NS, self._be_calm)
        self.world.after(shifts * (TROUBLE_NS + CALM_NS), self._end)

    def _end(self) -> None:
        self.is_over = True
        self.sensors.stop()

    def _some(self, most: int, do: Callable[[], object]) -> None:
        draw = self.world.random
        for _ in range(draw.randrange(most + 1)):
            self.world.after(draw.randrange(TROUBLE_NS // MS) * MS, do)

    def _have_trouble(self) -> None:
        world, draw = self.world, self.world.random
        world.has_trouble, t_ns = True, 0
        while (close_ns := t_ns + draw.choice((400, 1300, 1300)) * MS) < TROUBLE_NS:
            world.after(t_ns, self._open)
            world.after(close_ns, self._grasp)
            world.after(close_ns + draw.choice((100, 400)) * MS, draw.choice(self.door.peers).ask)
            if draw.random() < 0.5:
                world.after(close_ns + draw.randrange(1200) * MS, self._break_sensors)
            t_ns = close_ns + draw.choice((300, 900, 1500, 2500)) * MS
        self._some(2, self._break_sensors)
        self._some(2, lambda: setattr(self.disk, draw.choice(("is_full", "is_slow")), True))
        self._some(1, world.kill_soon)
        self._some(1, self.sensors.stop)
        self._some(2, lambda: world.stall(draw.choice((30, 150, 700, 3000)) * MS))
        self._some(1, self.sensors.exchange)
        self._some(1, self.door.flood)
        self._some(1, lambda: setattr(self, "cost_ns", draw.choice((4, 12, 25)) * MS))
        self._some(1, lambda: setattr(self, "slept_ns", self.slept_ns + S * (draw.random() < 0.2)))
        for peer in self.door.peers:
            self._some(2, partial(peer.ask, lifts=draw.random() < 0.8))

    def _break_sensors(self) -> None:
        fault = Fault(self.world.random.choice(FAULTS), self.world)
        self.sensors.faults.append(fault)

    def _open(self) -> None:
        self.sensors.take(self.sensors.rest)

    def _grasp(self) -> None:
        """Grasp; now and then a finger does not touch."""
        draw = self.world.random
        grasp = draw.choice(self.sensors.grasps).copy()
        if draw.random() < 0.1:
            free = draw.randrange(3)
            grasp[free] = self.sensors.rest[free]
        self.sensors.take(grasp)

    def _grasp_well(self) -> None:
        self._judged_before = self.judged
        self.sensors.take(self.sensors.grasps[0])

    def _be_calm(self) -> None:
        """End all faults; switch the sensors off once, as a wrong tare would last half a minute.

        Plan a sound grasp, a question, and the check that it was judged.
        """
        self.world.has_trouble, self.world.kill_ns = False, None
        self.sensors.faults.clear()
        self.sensors.switch_off()
        self.disk.is_full = self.disk.is_slow = False
        self.cost_ns, close_ns = 0, 6 * S
        self.world.after(close_ns, self._grasp_well)
        self.world.after(close_ns + 600 * MS, self.door.evening.ask)
        self.world.after(CALM_NS - S, self._check_going)

    def _check_going(self) -> None:
        assert self.door.is_open, "the daemon has ended"
        assert self.judged > self._judged_before, "a sound grasp was not judged"
        said = self.door.evening.last
        assert set(said["reasons"]) <= WITHHELD, f"a sound grasp is {said['reasons']}"


def run(seed: int, shifts: int = 3) -> Day:
    """Run a day of `shifts` times of trouble. A failure names the command that repeats it."""
    with tempfile.TemporaryDirectory() as folder:
        day = Day(seed, Path(folder))
        try:
            day.run(shifts)
        except Exception as error:
            error.add_note(f"python -m tests.daemon.run.days {seed}")
            raise
        return day


def main() -> None:
    """Run the days of the given seeds and print the counts of each, up to the first failure."""
    first, *last = map(int, sys.argv[1:])
    for seed in range(first, last[0] if last else first + 1):
        day = run(seed)
        kept = sum(len(peer.kept) for peer in day.door.all)
        sys.stdout.write(f"{seed}: {day.lives} lives, {kept} outcomes, {dict(day.said)}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
