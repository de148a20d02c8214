"""A session's calibration: what it learns from, and when it is dropped."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.daemon.judge.decision import HandLimits, Limits
from graspd.daemon.judge.pipeline import Judgement, Pipeline
from graspd.daemon.judge.reasons import Decision, GateState, Reason
from graspd.daemon.session.file import KeptSession
from graspd.daemon.session.folder import SessionFolder
from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.drivers.twins.grasps.grasp_script import Durations
from graspd.drivers.twins.grasps.whole_grasps import synthetic_grasps
from graspd.models import zoo
from graspd.models.runtime import TactileModel
from graspd.models.training.data.datasets import read_table
from tests.daemon.fakes import Clock
from tests.daemon.session.learning import (
    FINGERS,
    calibration,
    observe,
    read_once,
    sensors,
    session_keeper,
)


def test_a_new_session_begins_if_kept_statistics_have_another_size(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    session, driver = calibration(), sensors(ff="A")
    observe(session, 30)
    state = session.state()
    odd = msgspec.structs.replace(state, mean=state.mean[:-1], squares=state.squares[:-1])
    with SessionFolder(tmp_path / "right") as folder:
        other = KeptSession(odd, FINGERS, {"ff": "B"})
        folder.save([KeptSession(state, FINGERS, {"ff": "A"}), other])
        keeper = session_keeper(session, driver, folder, Clock())
        read_once(keeper)
        driver.known = {"ff": "B"}
        read_once(keeper)
        keeper.save()
    assert session.grasps == 0
    assert "a new session begins" in caplog.text


def session_pipeline(age_ns: int = 0, *, learns: bool = True) -> Pipeline:
    """Return a pipeline without a gate, for which readings made at time 0 are `age_ns` old.

    `learns` False: the session takes in no grasps.
    """
    model = TactileModel(zoo.find("small-session"))
    return Pipeline(model, FINGERS, Limits(max_age_ns=10**8), lambda: age_ns, learns=learns)


def judge(pipeline: Pipeline, rows: NDArray[np.generic], fault: int = 0) -> list[Judgement]:
    faults = np.full((3, 24), fault, dtype=np.uint8)
    return [
        pipeline.judge(TactileReading(0, number, row.astype(np.uint16), faults))
        for number, row in enumerate(rows)
    ]


@pytest.mark.parametrize(
    ("fault", "age_ns", "learns"),
    [
        (ElectrodeFault.HELD, 0, True),
        (ElectrodeFault.CUT_OFF, 0, True),
        (128, 0, True),
        (0, 10**10, True),
        (0, 0, False),
    ],
)
def test_a_session_learns_only_from_sound_fresh_readings_if_allowed(
    bts3_dir: Path, fault: int, age_ns: int, learns: bool
) -> None:
    pipeline = session_pipeline(age_ns, learns=learns)
    judge(pipeline, read_table(bts3_dir / "palm_down.csv").counts[:30], fault)
    assert pipeline.session is not None
    assert pipeline.session.grasps == 0


GARBAGE: dict[str, Callable[[np.random.Generator], NDArray[np.generic]]] = {
    "any counts": lambda random: random.integers(1, 4095, (300, 3, 24)),
    "an open hand": lambda random: 3000 + random.normal(0.0, 5.0, (300, 3, 24)),
}


@pytest.mark.parametrize("what", GARBAGE)
@pytest.mark.parametrize("grasps", [0, 100])
def test_garbage_readings_stay_unknown_however_many_are_seen(
    bts3_dir: Path, what: str, grasps: int
) -> None:
    """All verdicts are `unknown`, both from the start and after real grasps."""
    pipeline = session_pipeline()
    random = np.random.default_rng(1)
    rows = read_table(bts3_dir / "palm_down.csv").counts
    judge(pipeline, rows[random.permutation(len(rows))[:grasps]])
    judgements = judge(pipeline, GARBAGE[what](random))
    assert {judgement.decision for judgement in judgements} == {Decision.UNKNOWN}


@pytest.mark.parametrize("grasps", [0, 200])
def test_a_grasp_with_a_dead_finger_is_always_unknown(bts3_dir: Path, grasps: int) -> None:
    random = np.random.default_rng(3)
    rows = read_table(bts3_dir / "palm_down.csv").counts
    rows = rows[random.permutation(len(rows))].astype(np.int64)
    pipeline = session_pipeline()
    judge(pipeline, rows[:grasps])
    dead = rows[200:600].copy()
    dead[:, 2] = 2048 + np.rint(random.normal(0.0, 3.5, dead[:, 2].shape)).astype(np.int64)
    assert {judgement.decision for judgement in judge(pipeline, dead)} == {Decision.UNKNOWN}


@pytest.mark.parametrize("order", [[0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]])
def test_swapped_fingers_give_unknown_from_the_sixth_reading_on(
    bts3_dir: Path, order: list[int]
) -> None:
    rows = read_table(bts3_dir / "palm_side.csv").counts
    rows = rows[np.random.default_rng(6).permutation(len(rows))[:200]]
    pipeline = session_pipeline()
    decisions = [judgement.decision for judgement in judge(pipeline, rows[:, order])]
    assert set(decisions[5:]) == {Decision.UNKNOWN}
    assert pipeline.health()["session"] is Reason.NOT_CALIBRATED


def test_a_session_of_mostly_slips_makes_hardly_more_slips_stable(bts3_dir: Path) -> None:
    """After 900 slips hardly any more of a day's slips are called stable than without them."""
    table = read_table(bts3_dir / "palm_side.csv")
    random = np.random.default_rng(8)
    mixed = random.permutation(len(table.counts))
    first, test, rest = mixed[:100], mixed[100:400], mixed[400:]
    slips = np.resize(rest[table.slipped[rest]], 900)
    missed = []
    for poison in (first, np.concatenate((first, slips))):
        pipeline = session_pipeline()
        judge(pipeline, table.counts[poison])
        judgements = judge(pipeline, table.counts[test])
        said = [judgement.decision is Decision.STABLE for judgement in judgements]
        missed.append(np.mean(np.array(said)[table.slipped[test]]))
    assert missed[1] <= missed[0] + 0.02


@pytest.mark.parametrize("name", ["cnn1", "small-session"])
def test_readings_near_the_mean_of_training_grasps_are_unknown(name: str) -> None:
    model = TactileModel(zoo.find(name))
    random = np.random.default_rng(5)
    centre = np.array(model.contract.seen.centre)
    pipeline = Pipeline(model, FINGERS, Limits(max_age_ns=10**18), lambda: 0, learns=False)
    judgements = judge(pipeline, centre + random.normal(0.0, 2.0, (50, 3, 24)))
    assert {judgement.decision for judgement in judgements} == {Decision.UNKNOWN}


def test_an_exchange_of_sensors_makes_the_current_verdict_unknown() -> None:
    clock = Clock()
    model = TactileModel(zoo.find("cnn1"))
    pipeline = Pipeline(model, FINGERS, Limits(), clock, hand=HandLimits())
    held = Durations(first_rest_s=(1.5, 1.5), settle_s=(60.0, 60.0))
    judged = []
    for moment in itertools.islice(synthetic_grasps(1, durations=held, seed=1), 401):
        if moment.t_s == 4.0:
            pipeline.sensors_exchanged()
        clock.now_ns += 10_000_000
        faults = np.zeros((3, 24), dtype=np.uint8)
        judged.append(pipeline.judge(TactileReading(clock.now_ns, 0, moment.counts, faults)))
    before, after = judged[-2:]
    assert before.moment.state is GateState.JUDGED
    assert after.decision is Decision.UNKNOWN
    assert Reason.NOT_TARED in after.reasons
    assert after.moment.touching == ()
