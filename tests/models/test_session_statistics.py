"""Session statistics against plain numpy over all grasps, and against what could spoil them."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from graspd.models.session_statistics import SessionState, SessionStatistics, is_odd

WIDTH = 5


def statistics(prior_grasps: float = 1.0) -> SessionStatistics:
    return SessionStatistics(np.full(WIDTH, 10.0), np.full(WIDTH, 2.0), prior_grasps)


def grasps(number: int, seed: int = 0, mean: float = 500.0) -> NDArray[np.float64]:
    return np.random.default_rng(seed).normal(mean, 30.0, (number, WIDTH))


def observe(session: SessionStatistics, rows: NDArray[np.float64]) -> None:
    for row in rows:
        assert session.observe(row)


@pytest.mark.parametrize(("number", "prior_grasps"), [(0, 0.5), (1, 5.0), (100, 0.5)])
def test_running_statistics_are_those_of_all_grasps_and_the_prior(
    number: int, prior_grasps: float
) -> None:
    session = statistics(prior_grasps)
    rows = grasps(number)
    observe(session, rows)
    total = number + prior_grasps
    mean = (rows.sum(axis=0) + prior_grasps * 10.0) / total
    off = rows - rows.mean(axis=0) if number else rows
    variance = ((off**2).sum(axis=0) + prior_grasps * 4.0) / total
    np.testing.assert_allclose(session.mean, mean, rtol=1e-12)
    np.testing.assert_allclose(session.spread, np.sqrt(variance), rtol=1e-12)


def test_a_grasp_that_is_not_finite_leaves_the_mean_unchanged() -> None:
    session = statistics()
    observe(session, grasps(3))
    mean = session.mean.copy()
    for bad in (np.nan, np.inf, -np.inf):
        row = np.full(WIDTH, 100.0)
        row[2] = bad
        assert not session.observe(row)
    np.testing.assert_array_equal(session.mean, mean)


def test_a_state_of_wrong_shape_values_or_weight_is_refused() -> None:
    session, ones = statistics(), (1.0,) * WIDTH
    observe(session, grasps(4))
    for state in (
        SessionState(1.0, 1, (1.0,), (1.0,)),
        SessionState(1.0, 1, ones, (1.0,) * (WIDTH + 1)),
        SessionState(1.0, 1, (float("nan"),) * WIDTH, ones),
        SessionState(0.0, 30, ones, ones),
        SessionState(30.0, 1000, ones, ones),
    ):
        with pytest.raises(ValueError, match=r"is of|not finite|grasps weigh"):
            session.restore(state)
    assert session.grasps == 4


@settings(max_examples=50)
@given(
    st.lists(st.lists(st.floats(-1e6, 1e6, width=32), min_size=WIDTH, max_size=WIDTH), max_size=40)
)
def test_the_prior_keeps_the_spread_above_zero_for_any_grasps(rows: list[list[float]]) -> None:
    session = statistics()
    for row in rows:
        session.observe(np.array(row))
    assert np.isfinite(session.mean).all()
    # The prior alone leaves a share of its own spread: 2 * sqrt(1 / (n + 1)).
    assert (session.spread >= 2.0 * np.sqrt(1.0 / (len(rows) + 1)) - 1e-9).all()


def test_the_same_grasp_again_and_again_counts_once() -> None:
    session = SessionStatistics(np.full(WIDTH, 500.0), np.full(WIDTH, 30.0))
    random = np.random.default_rng(2)
    again = [session.observe(520.0 + random.normal(0.0, 1.0, WIDTH)) for _ in range(50)]
    assert again == [True] + [False] * 49
    np.testing.assert_allclose(session.mean, 510.0, atol=3.0)


def halves(slips: int) -> SessionStatistics:
    """Return a session after 100 grasps, every other one a slip, then `slips` slips.

    Values are near 600 in a slip and 400 in others."""
    session, random = statistics(), np.random.default_rng(3)
    for number in range(100 + slips):
        slip = number >= 100 or number % 2 == 0
        assert session.observe(random.normal(600.0 if slip else 400.0, 30.0, WIDTH), slip=slip)
    return session


def test_many_slips_in_a_row_hardly_move_the_mean() -> None:
    np.testing.assert_allclose(halves(0).mean, 500.0, atol=10.0)
    assert (halves(900).mean < 530.0).all()


def test_a_wrong_first_mean_fades_though_later_grasps_are_slips() -> None:
    """The first 20 grasps read 900. All later ones read 500 and are called slips."""
    session, random = statistics(), np.random.default_rng(4)
    observe(session, grasps(20, mean=900.0))
    for _ in range(5000):
        session.observe(random.normal(500.0, 30.0, WIDTH), slip=True)
    np.testing.assert_allclose(session.mean, 500.0, atol=60.0)


def test_a_session_of_mostly_slips_is_restored_exactly() -> None:
    session = halves(300)
    other = statistics()
    other.restore(msgspec.json.decode(msgspec.json.encode(session.state()), type=SessionState))
    row = np.full(WIDTH, 610.0)
    assert session.observe(row, slip=True)
    assert other.observe(row, slip=True)
    assert other.state() == session.state()


MEAN = np.array([[1000.0] * 24, [1800.0] * 24, [2600.0] * 24])
SPREAD = np.full((3, 24), 100.0)


@pytest.mark.parametrize(
    ("mean", "spread", "enough", "odd"),
    [
        (MEAN, SPREAD, True, False),
        (MEAN + 700.0, SPREAD, True, False),  # all sensors drifted alike: no order fits better
        (MEAN + 900.0, SPREAD, False, True),
        (MEAN[[1, 0, 2]], SPREAD, False, True),
        (MEAN[[2, 0, 1]] + 100.0, SPREAD, False, True),
        (MEAN, SPREAD * 0.1, True, True),
        (MEAN, SPREAD * 0.1, False, False),
        (MEAN, SPREAD * 4.0, True, True),
    ],
)
def test_sessions_with_impossible_mean_or_spread_are_odd(
    mean: NDArray[np.float64], spread: NDArray[np.float64], enough: bool, odd: bool
) -> None:
    assert is_odd(mean, spread, MEAN, SPREAD, enough=enough) is odd


def test_fingers_with_the_same_means_never_count_as_swapped() -> None:
    alike = np.full((3, 24), 2000.0)
    random = np.random.default_rng(5)
    for _ in range(50):
        mean = alike + random.normal(0.0, 50.0, (3, 24))
        assert not is_odd(mean, SPREAD, alike, SPREAD, enough=True)
    # One finger alone cannot be exchanged.
    assert not is_odd(MEAN[:1] + 700.0, SPREAD[:1], MEAN[:1], SPREAD[:1], enough=True)
