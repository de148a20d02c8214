"""Small sessions and learners with synthetic grasps, and stand-ins for what is around them."""

from __future__ import annotations

import hashlib
import select
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import Finger
from graspd.daemon.judge.exchange import NOTHING_KNOWN, Exchanged
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.publish.companion import Companion, Requests
from graspd.daemon.session.file import KeptSession
from graspd.daemon.session.folder import SessionFolder, look
from graspd.daemon.session.keeper import SessionKeeper
from graspd.daemon.session.sensors import SensorWatch
from graspd.daemon.trust.lift_book import GraspId, OutcomeStatus
from graspd.daemon.trust.trust import Trust, TrustState
from graspd.drivers.base import Driver
from graspd.drivers.twins.grasps.grasp_script import Durations
from graspd.models.contract import SessionInput, Sharpness
from graspd.models.judge.session import SessionCalibration
from graspd.models.trust.learner import sigmoid
from graspd.models.trust.risk import Permission, RiskLimits
from tests.daemon.fakes import Clock, FakeDriver, reading

FINGERS: tuple[Finger, ...] = ("ff", "mf", "th")
SHARPNESS = (Sharpness(0.0, 3.0), Sharpness(5.0, 2.0), Sharpness(20.0, 1.0))
BOOT = "0123456789abcdef" * 2
INPUTS = 78
NOBODY = cast(Requests, None)
"""Placeholder for the loop's `Requests` where no request is made."""
SHORT = Durations(
    approach_s=(0.3, 0.3),
    settle_s=(0.5, 0.6),
    lift_s=(0.2, 0.2),
    release_s=(0.2, 0.2),
    rest_s=(0.4, 0.5),
)
"""Durations that make a grasp about two seconds long."""


def counts(number: int, seed: int = 0) -> NDArray[np.uint16]:
    return np.random.default_rng(seed).integers(500, 3500, (number, 3, 24), dtype=np.uint16)


def calibration() -> SessionCalibration:
    wanted = SessionInput((0.0,) * 78, (1.0,) * 78, 3.0, 1.0, 20.0, SHARPNESS)
    return SessionCalibration(wanted, np.full((3, 24), 2000.0), np.full((3, 24), 300.0))


def observe(session: SessionCalibration, number: int, seed: int = 0) -> None:
    for row in counts(number, seed):
        session.observe(row)


def trust(model: str = "model", inputs: int = INPUTS) -> Trust:
    return Trust(model, inputs, RiskLimits(0.1))


def judge(part: Trust, grasp: int, boot: str = BOOT) -> None:
    """Have `part` judge and note a grasp, drawn by its number; about half are likely to hold."""
    draw = np.random.default_rng(grasp)
    inputs = np.clip(draw.normal(0.0, 1.0, part.learner.inputs), -3.0, 3.0).astype(np.float32)
    margin = float(draw.normal(0.0, 4.0))
    name = GraspId(boot, grasp)
    found = part.judge(name, sigmoid(margin), margin, inputs)
    holds = found.p_slip is not None and found.p_slip < 0.5
    part.note(name, found, stable=holds and found.permission is Permission.ALLOWED)


def tell(part: Trust, grasp: int, boot: str = BOOT) -> OutcomeStatus:
    """Report the outcome of a grasp: a slip if its number is a multiple of 3."""
    return part.outcome(GraspId(boot, grasp), slipped=grasp % 3 == 0)


def kept_in(folder: Path) -> list[KeptSession]:
    """The sessions in a folder, the last used first."""
    return [each for each in look(folder).values() if isinstance(each, KeptSession)]


def last_kept(folder: Path) -> KeptSession:
    return kept_in(folder)[0]


def sensors(**serials: str) -> FakeDriver:
    driver = FakeDriver([], Clock())
    driver.known = serials
    return driver


def read_once(companion: Companion) -> None:
    """Tell a companion of one reading and of the next wait, as the loop does."""
    companion.on_reading(reading(0))
    companion.before_wait(NOBODY)


def go_round(keeper: SessionKeeper) -> None:
    """Go round as the loop does, until all is written."""
    keeper.before_wait(NOBODY)
    while keeper.filenos:
        ready, _, _ = select.select(keeper.filenos, [], [], 60.0)
        assert ready
        keeper.before_wait(NOBODY)


def sealed(plain: bytes) -> bytes:
    """Return the bytes of a session file with this content and a right checksum."""
    content = zlib.compress(plain)
    return hashlib.sha256(content).digest() + content


class FakeJudge:
    """Stands for the pipeline of a `SensorWatch`; at an exchange it forgets the sensors."""

    def __init__(
        self,
        session: SessionCalibration | None = None,
        part: Trust | None = None,
        read_rest: Callable[[], NDArray[np.float64]] | None = None,
        hear: Callable[[], object] = list,
    ) -> None:
        """`part`: what learns; None: nothing. `read_rest`: returns the resting counts of the open
        hand. `hear`: called at each exchange."""
        self.session, self.trust, self.read_rest, self.hear = session, part, read_rest, hear
        self.needs_session = False

    def sensors_exchanged(self, known: Exchanged = NOTHING_KNOWN) -> None:
        self.hear()
        self.needs_session = True
        if self.session is not None:
            self.session.reset()
            if known.session is not None:
                self.session.restore(known.session)
        if self.trust is not None:
            self.trust.sensors_exchanged(known.learned, known.proven, known.budget)


def session_keeper(
    session: SessionCalibration | None,
    tactile: Driver,
    folder: SessionFolder,
    clock: Clock | None = None,
    part: Trust | None = None,
    read_rest: Callable[[], NDArray[np.float64]] | None = None,
) -> SessionKeeper:
    judge = cast(Pipeline, FakeJudge(session, part, read_rest))
    return SessionKeeper(judge, FINGERS, tactile, folder, clock or Clock())


def sensor_watch(
    tactile: Driver,
    hear: Callable[[], object],
    read_rest: Callable[[], NDArray[np.float64]] | None = None,
) -> SensorWatch:
    return SensorWatch(cast(Pipeline, FakeJudge(None, None, read_rest, hear)), tactile)


def kept_trust(folder: SessionFolder) -> TrustState | None:
    found = kept_in(folder.path)
    return found[0].trust if found else None
