"""Tare and contact, on a real recording of untouched sensors and on streams with its noise."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.daemon.judge.contact import Contact
from graspd.daemon.judge.hand import FreshMedian

FF, MF, TH = 0, 1, 2
PERIOD_NS = 10_000_000
NOISE = 3.5
"""Counts, standard deviation of an untouched electrode (facts: 2.9 to 4.3)."""
PRESSED = np.where(np.arange(24) % 3 == 0, 1.0, 0.2)
"""Share of a touch's depth that each electrode feels: eight all of it, the others a fifth."""
ALL = np.ones((3, 24), dtype=np.bool_)
SLOPES = np.random.default_rng(5).normal(0.0, 0.2, (3, 24))
"""Counts/s by which the electrodes of a finger drift apart: 0.13 to 0.22 (standard deviation, over
the real recording of untouched sensors)."""

Counts = NDArray[np.uint16]


class Hand:
    """Feeds a hand's sweeps, 10 ms apart, to fresh values and contact."""

    def __init__(self) -> None:
        self.contact = Contact(3)
        self.fresh = FreshMedian((3, 24))
        self.t_ns = 10**12

    def feel(self, counts: Counts, usable: NDArray[np.bool_] = ALL) -> None:
        self.fresh.push(counts, usable)
        self.contact.observe(self.t_ns, counts, self.fresh.counts, usable)
        self.t_ns += PERIOD_NS

    def play(self, sweeps: Counts, usable: NDArray[np.bool_] = ALL) -> NDArray[np.bool_]:
        """Which fingers touched in each sweep, shape (sweeps, fingers)."""
        touching = np.zeros((len(sweeps), 3), dtype=np.bool_)
        for place, counts in enumerate(sweeps):
            self.feel(counts, usable)
            touching[place] = self.contact.touching
        return touching


def at_rest() -> NDArray[np.float64]:
    return np.random.default_rng(1).uniform(2400.0, 3400.0, (3, 24))


def noisy(mean: NDArray[np.float64], seed: int = 0) -> Counts:
    """Counts around `mean`, shape (sweeps, 3, 24), as an untouched sensor wavers."""
    noise = np.random.default_rng(seed).normal(0.0, NOISE, mean.shape)
    return np.clip(np.rint(mean + noise), 1, 4094).astype(np.uint16)


def still(seconds: float, seed: int = 0) -> Counts:
    return noisy(np.broadcast_to(at_rest(), (round(seconds * 100), 3, 24)), seed)


def touched(seconds: float, depth: float, seed: int = 0) -> Counts:
    """All fingers are pressed at once by `depth` counts."""
    mean = np.broadcast_to(at_rest() - depth * PRESSED, (round(seconds * 100), 3, 24))
    return noisy(mean, seed)


def as_sampled(recorded: Counts, changed: NDArray[np.int64]) -> Counts:
    """What a palm that held values where `recorded` repeats would have read of `changed`."""
    sampled = changed.copy()
    for sweep in range(1, len(sampled)):
        held = recorded[sweep] == recorded[sweep - 1]
        sampled[sweep][held] = sampled[sweep - 1][held]
    return sampled.astype(np.uint16)


@pytest.mark.parametrize("direction", [1, -1], ids=["forward", "backward"])
def test_a_real_untouched_recording_touches_nothing(untouched: Counts, direction: int) -> None:
    hand = Hand()
    played = np.tile(untouched[::direction], (5, 1, 1))
    assert not hand.play(played[:100]).any()
    assert all(hand.contact.tared), "one second is enough for a tare"
    falls = []
    for counts in played[100:]:
        hand.feel(counts)
        falls.append([touch.fall for touch in hand.contact.touches])
        assert not any(hand.contact.touching)
        assert all(hand.contact.tared)
    assert np.max(falls) < 11.0, "the third deepest fall leaves half of the threshold free"


def test_three_electrodes_24_counts_lower_are_a_touch(untouched: Counts) -> None:
    random, lowered = np.random.default_rng(5), untouched.astype(np.int64)
    for finger in range(3):
        lowered[500:, finger, random.choice(24, 3, replace=False)] -= 24
    touching = Hand().play(as_sampled(untouched, lowered))
    assert not touching[:500].any()
    assert touching[500:550].any(axis=0).all()


@pytest.mark.parametrize(("electrodes", "sweeps"), [(1, 50), (2, 2)])
def test_spikes_of_one_or_two_electrodes_never_make_a_touch(
    untouched: Counts, electrodes: int, sweeps: int
) -> None:
    random = np.random.default_rng(7)
    spiked = untouched.astype(np.int64)
    for start in range(100, 900, sweeps + 10):
        for finger in range(3):
            where = random.choice(24, electrodes, replace=False)
            spiked[start : start + sweeps, finger, where] -= 150
    assert not Hand().play(as_sampled(untouched, spiked)).any()


MOTIONS = {
    "rising": lambda t: 30.0 * t,
    "sinking": lambda t: -30.0 * t,
    "shaking": lambda t: 20.0 * np.sin(2 * np.pi * 3.1 * t),
}


@pytest.mark.parametrize("motion", list(MOTIONS))
def test_a_finger_that_moves_is_not_tared_until_it_rests(motion: str) -> None:
    hand = Hand()
    t_s = np.arange(300) / 100
    moved = MOTIONS[motion](t_s)[:, None, None]
    for counts in noisy(at_rest() + moved):
        hand.feel(counts)
        assert not any(hand.contact.tared)
        assert not any(hand.contact.touching)
    hand.play(noisy(np.broadcast_to(at_rest() + moved[-1], (150, 3, 24)), 1))
    assert all(hand.contact.tared)


def test_a_hand_that_never_opened_touches_nothing_until_it_opens() -> None:
    hand = Hand()
    assert not hand.play(touched(3.0, 500.0)).any()
    assert not hand.play(still(2.0))[5:].any()
    assert hand.play(touched(0.5, 40.0))[5:].all()


@pytest.mark.parametrize("usable_electrodes", [11, 12])
def test_fewer_than_twelve_usable_electrodes_never_touch(usable_electrodes: int) -> None:
    hand, usable = Hand(), ALL.copy()
    usable[FF, usable_electrodes:] = False
    hand.play(still(1.5))
    touching = hand.play(touched(0.5, 500.0), usable)
    enough = usable_electrodes == 12
    assert (touching[5:, FF] == enough).all()
    assert touching[5:, [MF, TH]].all()
    never_more = Hand()
    never_more.play(still(1.5), usable)
    assert never_more.contact.tared == [enough, True, True]
    assert never_more.play(touched(0.5, 500.0), usable)[:, FF].any() == enough


def held(seconds: int, drift: float, depth: float = 300.0) -> NDArray[np.float64]:
    """Mean counts, shape (sweeps, 3, 24), of a hold while the sensors drift, in counts/s."""
    t_s = np.arange(0, seconds, 0.01)[:, None, None]
    return at_rest() - depth * PRESSED + (drift + SLOPES) * t_s


def opened(seconds: float, after_s: int, drift: float) -> NDArray[np.float64]:
    """Mean counts of an open hand after a hold of `after_s` seconds."""
    t_s = after_s + np.arange(0, seconds, 0.01)[:, None, None]
    return at_rest() + (drift + SLOPES) * t_s


@pytest.mark.parametrize(("seconds", "drift"), [(30, 0.0), (300, 0.7)])
def test_a_hand_that_opens_after_a_long_hold_touches_nothing(seconds: int, drift: float) -> None:
    hand = Hand()
    hand.play(still(1.5))
    assert hand.play(noisy(held(seconds, drift)))[10:].all()
    open_hand = hand.play(noisy(opened(4.0, seconds, drift), 1))
    assert not open_hand[10:].any()
    assert all(hand.contact.tared)
    assert hand.play(noisy(held(2, 0.0) + (drift + SLOPES) * seconds, 2))[10:].all()
