"""A touch that is none must end: after a long hold, an outage, a start with a closed hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.daemon.judge.test_contact import PRESSED, Hand, at_rest, noisy, still

SLOPES = np.random.default_rng(5).normal(0.0, 0.2, (3, 24))
"""Counts/s by which the electrodes of a finger drift apart: 0.13 to 0.22 (standard deviation, over
the real recording of untouched sensors)."""


def held(seconds: int, drift: float, depth: float = 300.0) -> NDArray[np.float64]:
    """Mean counts, shape (sweeps, 3, 24), of a hold while the sensors drift, in counts/s."""
    t_s = np.arange(0, seconds, 0.01)[:, None, None]
    return at_rest() - depth * PRESSED + (drift + SLOPES) * t_s


def opened(seconds: float, after_s: int, drift: float) -> NDArray[np.float64]:
    """Mean counts of an open hand after a hold of `after_s` seconds."""
    t_s = after_s + np.arange(0, seconds, 0.01)[:, None, None]
    return at_rest() + (drift + SLOPES) * t_s


@pytest.mark.parametrize("drift", [0.7, 0.0, -0.7])
@pytest.mark.parametrize("seconds", [30, 300])
def test_a_hand_that_opens_after_a_long_hold_touches_nothing(seconds: int, drift: float) -> None:
    hand = Hand()
    hand.play(still(1.5))
    assert hand.play(noisy(held(seconds, drift)))[10:].all()
    open_hand = hand.play(noisy(opened(4.0, seconds, drift), 1))
    assert not open_hand[10:].any()
    assert hand.contact.memory.tared.all()
    assert hand.play(noisy(held(2, 0.0) + (drift + SLOPES) * seconds, 2))[10:].all()


def test_a_hand_that_regrasps_at_once_after_a_short_hold_is_felt() -> None:
    hand = Hand()
    hand.play(still(1.5))
    hand.play(noisy(held(20, 0.7)))
    hand.play(noisy(opened(0.3, 20, 0.7), 1))
    assert hand.play(noisy(held(2, 0.0) + 0.7 * 20, 2))[10:].all()


@pytest.mark.parametrize("relaxed", [0.5, 0.2])
def test_a_grip_that_relaxes_and_tightens_without_opening_is_felt(relaxed: float) -> None:
    hand = Hand()
    hand.play(still(1.5))
    hand.play(noisy(held(5, 0.0)))
    hand.play(noisy(held(2, 0.0, 300.0 * relaxed), 1))
    assert hand.play(noisy(held(2, 0.0), 2))[10:].all()


@pytest.mark.parametrize("higher", [15.0, 30.0])
def test_a_hand_that_was_closed_at_the_start_is_tared_when_it_opens(higher: float) -> None:
    hand = Hand()
    bulge = np.where(np.arange(24) % 8 == 1, higher, 0.0)
    closed = at_rest() - 300.0 * PRESSED + bulge * (1.0 + 300.0 / 60.0)
    hand.play(noisy(np.broadcast_to(closed, (200, 3, 24))))
    hand.play(still(4.0, 1))
    assert hand.contact.memory.tared.all()
    assert not hand.contact.memory.touching.any()
    assert hand.play(noisy(held(2, 0.0), 2))[10:].all()
