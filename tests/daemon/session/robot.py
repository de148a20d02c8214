"""A hand with its daemon's judge and session, and the published days to replay to it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from graspd.daemon.judge.decision import HandLimits, Limits
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.judge.reasons import Decision, GateState, Reason
from graspd.daemon.session.folder import SessionFolder
from graspd.daemon.session.keeper import SessionKeeper
from graspd.drivers.base import TactileReading
from graspd.drivers.twins.grasps.grasp_script import EndPoint
from graspd.drivers.twins.grasps.grasps import recorded_counts
from graspd.drivers.twins.grasps.whole_grasps import RATE_HZ, WholeGrasps, rest_above
from graspd.models import zoo
from graspd.models.judge.session import SessionCalibration
from graspd.models.runtime import TactileModel
from tests.daemon.fakes import FINGERS, MS, Clock
from tests.daemon.session.learning import NOBODY, SHORT, sensors

OUTAGE_NS = 2_000_000_000
"""Duration of an outage, ns: longer than the second after which tares are forgotten."""


class Robot:
    """A hand and its daemon's judge and session, without serial numbers."""

    def __init__(self, folder: Path) -> None:
        self.clock = Clock(1_000 * MS)
        self.folder = folder
        self.seq = 0
        self.start()

    def start(self) -> None:
        self.pipeline = Pipeline(
            TactileModel(zoo.find("small-session")),
            FINGERS,
            Limits(),
            self.clock,
            hand=HandLimits(),
        )
        self.kept = SessionFolder(self.folder / "right")
        self.keeper = SessionKeeper(self.pipeline, FINGERS, sensors(), self.kept, self.clock)

    def stop(self) -> None:
        self.keeper.save()
        self.kept.close()

    def restart(self) -> None:
        self.stop()
        self.start()

    def outage(self) -> None:
        self.clock.now_ns += OUTAGE_NS

    def see(self, grasps: WholeGrasps) -> Iterator[tuple[bool | None, Decision, bool]]:
        """Yield per grasp if it slips, its first decision, and if the session is calibrated."""
        judged = 0
        begin_ns = self.clock.now_ns
        for row in grasps:
            self.clock.now_ns = begin_ns + round(row.t_s * 1e9)
            faults = np.zeros((3, 24), dtype=np.uint8)
            made = TactileReading(self.clock.now_ns, self.seq, row.counts, faults)
            self.seq += 1
            self.keeper.on_reading(made)
            self.keeper.before_wait(NOBODY)
            found = self.pipeline.judge(made)
            if found.moment.state is GateState.JUDGED and found.moment.grasp != judged:
                judged = found.moment.grasp
                yield row.slipped, found.decision, Reason.NOT_CALIBRATED not in found.reasons


class Day:
    """Grasps of one published day; the rest is estimated from the upper tail of the counts."""

    def __init__(self, name: str, folder: Path) -> None:
        path = folder / f"{name}.csv"
        self.grasps = np.stack(list(recorded_counts(path)))
        self.slipped = np.loadtxt(path, delimiter=",", skiprows=1, usecols=1).astype(bool)
        self._order = np.random.default_rng(0).permutation(len(self.grasps))

    def stream(self, start: int, number: int) -> WholeGrasps:
        """Return `number` grasps from `start` on of a fixed random order, with noise and rests."""
        chosen = self._order[start : start + number].tolist()
        ends = [EndPoint(self.grasps[row], bool(self.slipped[row]), "object") for row in chosen]
        return WholeGrasps(rest_above(self.grasps), ends, rate_hz=RATE_HZ, durations=SHORT)

    def teach(self, session: SessionCalibration | None, number: int) -> None:
        """Let a session take in the last `number` grasps of the order that `stream` uses."""
        assert session is not None
        for row in self._order[-number:].tolist():
            session.observe(self.grasps[row])
