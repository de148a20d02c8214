"""Lifts that were announced: bounded whatever is told of them, and when."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.daemon.trust.lift_book import OutcomeStatus
from graspd.daemon.trust.trust import decode, encode
from graspd.models.trust.risk import RiskLimits
from tests.daemon.trust.grasps import RULE, judge, named, trust

OUTSTANDING = (1, 2, 5, 9)


@pytest.mark.parametrize("first", range(0, 300, 100))
def test_announced_lifts_never_slip_beyond_the_bound(
    first: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 300 controllers some tell late, in any order, or never, and let slip what is stable."""
    decode(encode(trust().state()))  # so that no later test reads states with this bound
    monkeypatch.setattr("graspd.daemon.trust.lift_book.LIFTS_MAX", 12)  # lifts are soon forgotten
    for seed in range(first, first + 100):
        Protocol(seed).run(60)


class Protocol:
    """One controller, and what became of its lifts."""

    def __init__(self, seed: int) -> None:
        self.random = random = np.random.default_rng(seed)
        self.alpha = float(random.choice((0.001, 0.05, 0.1, 0.5)))
        self.limits = RiskLimits(self.alpha, outstanding_max=int(random.choice(OUTSTANDING)))
        self.announces, self.tells, self.slips = random.random(3) ** (0.3, 0.5, 0.2)
        self.part = trust(self.limits)
        self.waiting: list[int] = []
        """Announced, and not told yet."""
        self.abandoned = self.told = self.slipped = 0
        """Announced lifts that were never told; told lifts, and slips among these."""

    def run(self, grasps: int) -> None:
        allowed = 5.0 + self.limits.outstanding_max * (1.0 - self.alpha)
        for grasp in range(grasps):
            self.lift(grasp)
            assert self.part.lifts.awaited == len(self.waiting) <= self.limits.outstanding_max
            untold = self.abandoned + len(self.waiting)
            # At worst all that was not told has slipped.
            assert self.slipped + untold <= self.alpha * (self.told + untold) + allowed + 1e-6
            if self.random.random() < 0.03:
                kept, self.part = encode(self.part.state()), trust(self.limits)
                self.part.restore(decode(kept))

    def lift(self, grasp: int) -> None:
        """Judge a grasp, and tell its outcome and others or not."""
        stable = judge(self.part, grasp, -9.0)
        known = [each for each in self.waiting if named(each) in self.part.lifts]
        self.abandoned += len(self.waiting) - len(known)
        self.waiting = known
        if stable and self.random.random() < self.announces:
            self.part.lifts.announce()
            self.waiting.append(grasp)
        elif stable and self.random.random() < self.tells:
            self.tell(grasp)
        while self.waiting and self.random.random() < self.tells:
            self.tell(self.waiting.pop(int(self.random.integers(len(self.waiting)))))

    def tell(self, grasp: int) -> None:
        slipped = bool(self.random.random() < self.slips)
        assert self.part.outcome(named(grasp), slipped=slipped) is OutcomeStatus.TAKEN
        self.told, self.slipped = self.told + 1, self.slipped + slipped


def test_unannounced_lifts_neither_block_nor_count_until_they_are_told() -> None:
    part = trust(RiskLimits(0.1, outstanding_max=1))
    assert all(judge(part, grasp, -9.0) for grasp in range(20))
    assert (part.report().announced, part.report().awaited, part.report().slips) == (0, 0, 0)
    part.lifts.announce()
    assert part.report().awaited == 1
    assert not judge(part, 20, -9.0)
    part.outcome(named(19), slipped=False)
    assert judge(part, 21, -9.0)


def test_another_risk_forgets_what_was_announced_under_the_former_one() -> None:
    part, other = trust(RiskLimits()), trust(RULE)
    for grasp in range(9):
        judge(part, grasp, -9.0)
        part.lifts.announce()
    other.restore(part.state())
    assert (other.report().announced, other.report().awaited) == (0, 0)
    assert judge(other, 10, -9.0)
