"""Calibration of a session by its own grasps, with a training of round numbers."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.models.contract import SessionInput, Sharpness
from graspd.models.judge.session import SessionCalibration

MEAN, SPREAD = 2000.0, 100.0
"""Mean and spread of every electrode in the training, counts."""
SHAPE = (3, 24)


def new_session() -> SessionCalibration:
    wanted = SessionInput(
        mean=(0.0,) * 78,
        spread=(1.0,) * 78,
        clip=5.0,
        prior_grasps=1.0,
        calibrated_from=3.0,
        sharpness=(
            *(Sharpness(0.0, 2.5), Sharpness(1.0, 2.0)),
            *(Sharpness(2.0, 1.5), Sharpness(4.0, 1.0)),
        ),
    )
    return SessionCalibration(wanted, np.full(SHAPE, MEAN), np.full(SHAPE, SPREAD))


def grasps(number: int, mean: float = MEAN, spread: float = SPREAD) -> NDArray[np.float64]:
    """Drawn counts, shape (number, 3, 24)."""
    return np.random.default_rng(3).normal(mean, spread, (number, *SHAPE))


@pytest.mark.parametrize(
    ("number", "calibrated", "temperature"),
    [(0, False, 2.5), (1, False, 2.0), (2, False, 1.5), (3, True, 1.5), (4, True, 1.0)],
)
def test_a_session_is_calibrated_from_the_number_of_grasps_configured(
    number: int, calibrated: bool, temperature: float
) -> None:
    session = new_session()
    for counts in grasps(number):
        session.observe(counts)
    assert session.grasps == number
    assert (session.calibrated, session.odd) == (calibrated, False)
    assert session.temperature == temperature
    session.reset()
    assert (session.grasps, session.calibrated, session.temperature) == (0, False, 2.5)


@pytest.mark.parametrize("spread", [SPREAD, 1.0], ids=["far away", "standing still"])
def test_impossible_grasps_never_calibrate_a_session_nor_lower_its_temperature(
    spread: float,
) -> None:
    session = new_session()
    for counts in grasps(50, 3200.0 if spread == SPREAD else MEAN, spread):
        session.observe(counts)
    assert session.grasps > 40, "a reading that stands still is no new grasp"
    assert (session.odd, session.calibrated) == (True, False)
    assert session.temperature == 2.5


def test_a_count_is_mapped_by_its_distance_in_spreads() -> None:
    session = new_session()
    session.counts_mean = np.full(SHAPE, 1500.0)
    session.scale = np.full(SHAPE, SPREAD / 50.0)
    counts = np.full(SHAPE, 1600.0)  # two spreads of 50 above 1500
    assert (session.to_training(counts) == MEAN + 2 * SPREAD).all()
    assert (session.from_training(session.to_training(counts)) == counts).all()


def test_the_training_weighs_as_much_as_one_session_grasp() -> None:
    session, seen = new_session(), grasps(200, mean=2300.0, spread=60.0)
    for counts in seen:
        session.observe(counts)
    assert session.counts_mean.shape == SHAPE
    np.testing.assert_allclose(session.counts_mean, (seen.sum(axis=0) + MEAN) / 201)
    np.testing.assert_allclose(SPREAD / session.scale, 60.0, rtol=0.5)
    assert session.features_mean.shape == session.features_spread.shape == (78,)
    means = seen.mean(axis=2)  # the features after the 72 z-values
    np.testing.assert_allclose(session.features_mean[72:75], means.sum(axis=0) / 201)


@pytest.mark.parametrize(
    ("mean", "possible"), [(0.0, True), (4095.0, True), (-0.1, False), (4095.1, False)]
)
@pytest.mark.parametrize("place", [78, 78 + 71])
def test_saved_means_outside_0_to_4095_are_refused(mean: float, possible: bool, place: int) -> None:
    session = new_session()
    for counts in grasps(5):
        session.observe(counts)
    state = session.state()
    means = list(state.mean)
    means[place] = mean
    kept, other = msgspec.structs.replace(state, mean=tuple(means)), new_session()
    if not possible:
        with pytest.raises(ValueError, match="means that no counts have"):
            other.restore(kept)
        assert other.grasps == 0
    else:
        other.restore(kept)
        assert (other.grasps, other.temperature) == (5, 1.0)
