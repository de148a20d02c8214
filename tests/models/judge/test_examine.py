"""How many electrodes may contradict the others, on a grasp like those of a model's training."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.drivers.twins.grasps import synthetic
from graspd.models import zoo
from graspd.models.contract import SeenCounts
from graspd.models.judge.grasp_judge import GraspJudge, Refusal
from graspd.models.runtime import TactileModel

NOTHING = np.zeros((3, 24), dtype=np.bool_)
# Of different fingers and apart, so that none explains another.
WRONG = ((0, 3), (1, 9), (2, 20))
BROKEN = ((0, 14), (1, 20))


@pytest.fixture(scope="module")
def cnn1() -> GraspJudge:
    return GraspJudge.of(TactileModel(zoo.find("cnn1")))


@pytest.fixture(scope="module")
def grasp(cnn1: GraspJudge) -> NDArray[np.uint16]:
    """One that is judged as it is: shape (3, 24)."""
    drawn = synthetic.draw(synthetic.read_model(), np.random.default_rng(1), 50)
    for counts in drawn.counts.reshape(50, 3, 24):
        found = cnn1.examine(counts, NOTHING)
        if found.refusal is None and not found.repaired:
            return np.asarray(counts, dtype=np.uint16)
    raise AssertionError("no grasp is like those of the training")


@pytest.mark.parametrize("known", [0, 1, 2])
@pytest.mark.parametrize(("wrong", "judged"), [(0, True), (1, True), (2, True), (3, False)])
def test_two_electrodes_may_contradict_besides_those_known_to_be_broken(
    cnn1: GraspJudge, grasp: NDArray[np.uint16], known: int, wrong: int, judged: bool
) -> None:
    counts, broken = grasp.copy(), NOTHING.copy()
    for place in WRONG[:wrong]:
        counts[place] = counts[place] + 1500 if counts[place] < 2000 else counts[place] - 1500
    for place in BROKEN[:known]:
        counts[place] = 0
        broken[place] = True
    found = cnn1.examine(counts, broken)
    assert found.refusal == (None if judged else Refusal.NEVER_SEEN)
    if judged:
        names = {f"{('ff', 'mf', 'th')[f]}_{e + 1}" for f, e in (*WRONG[:wrong], *BROKEN[:known])}
        assert set(found.repaired) == names
        repaired = np.zeros((3, 24), dtype=np.bool_)
        for place in (*WRONG[:wrong], *BROKEN[:known]):
            repaired[place] = True
        assert (found.counts[~repaired] == grasp[~repaired]).all()
        errors = np.abs(found.counts[repaired].astype(float) - grasp[repaired])
        assert (errors < 400).all(), "what the others let expect is near what was there"
        assert found.grasp is not None


@cache
def seen_by_sessions() -> SeenCounts:
    return TactileModel(zoo.find("small-session")).contract.seen


@pytest.fixture(scope="module")
def of_sessions() -> GraspJudge:
    return GraspJudge.of(TactileModel(zoo.find("small-session")))


@pytest.mark.parametrize(
    ("stretched", "known", "judged", "learned"),
    [
        (1.0, {}, True, True),
        (1.0, {"odd": True}, False, True),  # near the training, in a session that is none
        (1.6, {}, False, True),  # up to twice as far a session learns from what it cannot judge
        (4.0, {}, False, False),
        (4.0, {"calibrated": False}, False, True),  # a young one learns from all
    ],
)
def test_a_session_learns_at_twice_the_distance_it_judges(
    of_sessions: GraspJudge,
    stretched: float,
    known: dict[str, bool],
    judged: bool,
    learned: bool,
) -> None:
    seen = seen_by_sessions()
    centre = np.array(seen.centre)
    # One deviation of the training, of 0.9 of the distance up to which it is judged.
    spread = np.linalg.inv(seen.whitening_matrix()).T
    direction = np.random.default_rng(2).normal(size=72)
    direction *= 0.9 * seen.distance_max * np.sqrt(72) / np.linalg.norm(direction)
    counts = np.clip(centre + stretched * (direction @ spread.T).reshape(3, 24), 1, 4094)
    session = of_sessions.session
    assert session is not None
    session.calibrated, session.odd = known.get("calibrated", True), known.get("odd", False)
    found = of_sessions.examine(np.rint(counts).astype(np.uint16), NOTHING)
    assert found.refusal == (None if judged else Refusal.NEVER_SEEN)
    assert (found.grasp is not None) == learned
