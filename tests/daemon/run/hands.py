"""The sensors of a hand in simulated time, with faults that last for many readings.

Faults of single sweeps are drawn in `tests/daemon/judge/felt_hand.py`.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from graspd.drivers.base import JointReading, Reading, TactileReading
from graspd.drivers.recordings.csv_player import DEMO_DAY
from tests.daemon.fakes import FINGERS, MS, FakeDriver
from tests.daemon.run.around import World

PERIOD_NS = 10 * MS
DEEP_COUNTS = 80
FAULTS = (
    *("lost", "outage", "twice", "late", "stuck", "dead", "time back", "began", "slide"),
    *("no joints", "joints frozen", "joints move"),
)
Counts = NDArray[np.int64]


@cache
def poses() -> tuple[Counts, list[Counts]]:
    """Return the counts of the open hand, shape (3, 24), and of grasps that all fingers touch."""
    with DEMO_DAY.open(newline="") as file:
        rows = [row for row in csv.reader(file) if row[1] == "0"][:9]
    grasps = [np.array(row[2:], dtype=np.int64).reshape(3, 24) for row in rows]
    rest = np.minimum(grasps[0] + 150 * (np.arange(72).reshape(3, 24) % 4), 4000)

    def touches(grasp: Counts) -> bool:
        below = np.sort(rest - grasp, axis=1)
        return bool((below[:, -3] - below[:, 12]).min() > DEEP_COUNTS)

    return rest, [grasp for grasp in grasps if touches(grasp)]


class Fault:
    """A fault of the sensors, of a `kind` in `FAULTS`, that lasts `ms` from now; None: drawn."""

    def __init__(self, kind: str, world: World, ms: int | None = None) -> None:
        draw = world.random
        self.kind = kind
        self.until_ns = world.now_ns + (ms or draw.choice((50, 120, 400, 1500, 2500))) * MS
        self.finger, self.electrode = draw.randrange(3), draw.randrange(24)
        self.count = draw.choice((0, 4095, 1234, 2000))
        self.share = draw.choice((0.1, 0.5, 1.0))
        self.delay_ns = draw.choice((20, 90, 150, 400)) * MS


class Sensors(FakeDriver):
    """The driver of a hand that rests, grasps and slides."""

    live = True

    def __init__(self, world: World, *, joints: bool) -> None:
        super().__init__([], world)
        self.world, self.joints = world, joints
        self.noise = np.random.default_rng(world.random.getrandbits(32))
        self.ends = False
        self.number = 1
        self.rest, self.grasps = poses()
        self.pose = self.rest
        self.faults: list[Fault] = []
        self._before: list[Fault] = []
        self.handed_ns = self.since_ns = 0
        """Times at which a reading was last taken, and the faults last changed, ns."""
        self._counts = self.rest.astype(np.uint16)
        self._seq = 0
        self._angle = 0.0
        self._open_until_ns = 0
        world.after(0, self._tick)

    @property
    def serials(self) -> dict[str, str]:
        return {finger: f"{finger}-{self.number}" for finger in FINGERS}

    def open(self) -> None:
        super().open()
        self.ends, self.queue = False, []
        self.handed_ns = self.since_ns = self.world.now_ns
        self.rest_for(2000)

    def rest_for(self, ms: int) -> None:
        """Open the hand for at least `ms`, so that its sensors can be tared."""
        self.pose = self.rest
        self._open_until_ns = max(self._open_until_ns, self.world.now_ns + ms * MS)

    def take(self, pose: Counts) -> None:
        if self.world.now_ns >= self._open_until_ns:
            self.pose = pose

    def switch_off(self, ms: int = 1500) -> None:
        self.faults.append(Fault("outage", self.world, ms))
        self.rest_for(ms + 2000)

    def stop(self) -> None:
        self.ends, self.queue = True, []

    def read_ready(self) -> Sequence[Reading]:
        self.world.pump()
        arrived = [each for each in self.queue if not isinstance(each, Exception)]
        self.queue = []
        if any(isinstance(each, TactileReading) for each in arrived):
            self.handed_ns = self.world.now_ns
        return arrived

    def exchange(self) -> None:
        """Put in one of three drawn sets of sensors; each rests differently, and may come back."""
        self.number = self.world.random.randrange(1, 4)
        steps = np.random.default_rng(self.number).choice((0, 140), (3, 24))
        self.rest = poses()[0] + steps * (self.number > 1)
        self.switch_off()

    def _tick(self) -> None:
        self.world.after(PERIOD_NS, self._tick)
        self._seq += 1
        faults = [each for each in self.faults if each.until_ns > self.world.now_ns]
        if faults != self._before:
            self.since_ns = self.world.now_ns
        self.faults, self._before = faults, [*faults]
        active = {each.kind: each for each in self.faults}
        if self.joints and "no joints" not in active:
            self._turn(active)
        if "slide" in active:
            self.pose = self.pose + 2 * (np.arange(24) % 3 - 1)
        counts = self.pose + self.noise.integers(-2, 3, (3, 24))
        if "stuck" not in active:
            self._counts = counts.clip(1, 4094).astype(np.uint16)
        lost, late = active.get("lost"), active.get("late")
        if "outage" in active or (lost and self.world.random.random() < lost.share):
            return
        reading = self._reading(active)
        for _ in range(1 + ("twice" in active)):
            self.world.after(late.delay_ns if late else 0, partial(self._arrive, reading))

    def _arrive(self, reading: Reading) -> None:
        if self.is_open:
            self.queue.append(reading)

    def _reading(self, active: dict[str, Fault]) -> TactileReading:
        counts, t_ns = self._counts.copy(), self.world.now_ns
        if dead := active.get("dead"):
            counts[dead.finger, dead.electrode] = dead.count
        if back := active.get("time back"):
            t_ns -= back.delay_ns
        began, no_faults = "began" in active, np.zeros((3, 24), dtype=np.uint8)
        return TactileReading(t_ns, self._seq, counts, no_faults, interrupted=began)

    def _turn(self, active: dict[str, Fault]) -> None:
        self._angle += 0.01 * ("joints move" in active)
        shake = 0.0 if "joints frozen" in active else self.noise.uniform(-0.0005, 0.0005)
        angles = np.array([0.5 + self._angle + shake, 0.7 + shake / 2])
        self._arrive(JointReading(self.world.now_ns, self._seq, ("FFJ3", "THJ5"), angles))
