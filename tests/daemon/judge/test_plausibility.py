"""How many electrodes may contradict the others, on a grasp like those of a model's training."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.judge.plausibility import Plausibility
from daemon.judge.reasons import Reason
from drivers.twins.grasps import synthetic
from models import zoo
from models.electrodes import Electrodes
from models.runtime import TactileModel

NOTHING = np.zeros((3, 24), dtype=np.bool_)
# Of different fingers and apart, so that none explains another.
WRONG = ((0, 3), (1, 9), (2, 20))
BROKEN = ((0, 14), (1, 20))


@pytest.fixture(scope="module")
def plausibility() -> Plausibility:
    contract = TactileModel(zoo.find("cnn1")).contract
    return Plausibility(contract.fingers, contract.seen, Electrodes(contract.seen))


@pytest.fixture(scope="module")
def grasp(plausibility: Plausibility) -> NDArray[np.uint16]:
    """One that is judged as it is: shape (3, 24)."""
    drawn = synthetic.draw(synthetic.read_model(), np.random.default_rng(1), 50)
    for counts in drawn.counts.reshape(50, 3, 24):
        found = plausibility.examine(counts, NOTHING)
        if not found.reasons and not found.repaired:
            return np.asarray(counts, dtype=np.uint16)
    raise AssertionError("no grasp is like those of the training")


@pytest.mark.parametrize("known", [0, 1, 2])
@pytest.mark.parametrize(("wrong", "judged"), [(0, True), (1, True), (2, True), (3, False)])
def test_two_electrodes_may_contradict_besides_those_known_to_be_broken(
    plausibility: Plausibility, grasp: NDArray[np.uint16], known: int, wrong: int, judged: bool
) -> None:
    counts, broken = grasp.copy(), NOTHING.copy()
    for place in WRONG[:wrong]:
        counts[place] = counts[place] + 1500 if counts[place] < 2000 else counts[place] - 1500
    for place in BROKEN[:known]:
        counts[place] = 0
        broken[place] = True
    found = plausibility.examine(counts, broken)
    assert found.reasons == (() if judged else (Reason.NEVER_SEEN,))
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
