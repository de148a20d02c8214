"""The book of lifts: who may report an outcome, what is remembered, what is kept on the disk."""

from __future__ import annotations

import pytest

from graspd.daemon.trust.lift_book import LIFTS_MAX, NOT_ASSESSED, LiftBook, OutcomeStatus
from tests.daemon.trust.grasps import named

CONTROLLER, DASHBOARD = b"controller", b"dashboard"


def test_only_its_first_owner_reports_a_grasp_that_was_claimed() -> None:
    lifts = LiftBook()
    lifts.claim(named(1), CONTROLLER)
    lifts.claim(named(1), DASHBOARD)
    assert lifts.may_report(named(1), CONTROLLER)
    assert not lifts.may_report(named(1), DASHBOARD)


def test_a_grasp_that_nothing_claimed_is_reported_by_those_that_own_others() -> None:
    lifts = LiftBook()
    assert lifts.may_report(named(1), DASHBOARD), "there is no owner at all"
    lifts.claim(named(2), CONTROLLER)
    assert lifts.may_report(named(1), CONTROLLER)
    assert not lifts.may_report(named(1), DASHBOARD)


def test_as_many_owners_are_remembered_as_grasps() -> None:
    lifts = LiftBook()
    lifts.claim(named(0), DASHBOARD)
    for grasp in range(1, LIFTS_MAX + 1):
        lifts.claim(named(grasp), CONTROLLER)
    assert not lifts.may_report(named(LIFTS_MAX + 1), DASHBOARD), "its only claim was the oldest"
    assert lifts.may_report(named(1), CONTROLLER)


@pytest.mark.parametrize("stable", [True, False])
def test_a_grasp_that_was_not_assessed_is_told_and_teaches_nothing(stable: bool) -> None:
    lifts = LiftBook()
    lifts.note(named(1), NOT_ASSESSED, stable=stable)
    assert lifts.outstanding == stable
    status, lift = lifts.tell(named(1), slipped=True)
    assert status is OutcomeStatus.TAKEN
    assert lift is not None
    assert not lift.features
    assert lifts.outstanding == 0


def test_a_grasp_is_entered_again_once_it_is_assessed() -> None:
    lifts = LiftBook()
    lifts.note(named(1), NOT_ASSESSED, stable=False)
    lifts.note(named(1), b"features", stable=False)
    lifts.note(named(1), b"others", stable=False)  # the first verdict counts
    lifts.note(named(1), NOT_ASSESSED, stable=False)
    _, lift = lifts.tell(named(1), slipped=True)
    assert lift is not None
    assert lift.features == b"features"


def test_an_outcome_is_kept_once_the_disk_has_it() -> None:
    lifts = LiftBook()
    lifts.note(named(1), bytes(8), stable=True)
    assert lifts.is_kept(named(1)), "there is no outcome to keep"
    lifts.tell(named(1), slipped=False)
    assert not lifts.is_kept(named(1))
    lifts.keep(named(1))
    assert lifts.is_kept(named(1))


def test_a_restored_outcome_is_kept_and_its_owner_is_not() -> None:
    lifts = LiftBook()
    lifts.note(named(1), bytes(8), stable=True)
    lifts.claim(named(1), CONTROLLER)
    lifts.tell(named(1), slipped=False)
    other = LiftBook()
    other.restore(lifts.state(), 1)
    assert other.is_told(named(1))
    assert other.is_kept(named(1))
    assert other.may_report(named(1), DASHBOARD)
    assert other.tell(named(1), slipped=False)[0] is OutcomeStatus.REPEATED
    assert other.tell(named(1), slipped=True)[0] is OutcomeStatus.CONTRADICTS


def test_a_lift_is_announced_once_and_awaited_until_it_is_told() -> None:
    lifts = LiftBook()
    lifts.announce()  # of no grasp
    lifts.note(named(1), bytes(8), stable=False)
    lifts.announce()  # of one that was not stable
    lifts.note(named(2), bytes(8), stable=True)
    lifts.announce()
    lifts.announce()
    assert (lifts.announced, lifts.awaited) == (1, 1)
    other = LiftBook()
    other.restore(lifts.state(), 1)
    assert (other.announced, other.awaited) == (1, 1)
    other.tell(named(2), slipped=False)
    other.announce()  # of one that was told
    assert (other.announced, other.awaited) == (1, 0)
    lifts.withdraw()
    assert (lifts.announced, lifts.awaited, lifts.outstanding) == (0, 0, 1)


def test_an_announced_lift_that_is_forgotten_is_abandoned() -> None:
    lifts = LiftBook()
    for grasp in range(2):
        lifts.note(named(grasp), bytes(8), stable=True)
        lifts.announce()
    lifts.tell(named(0), slipped=False)
    abandoned = [
        lifts.note(named(grasp), bytes(8), stable=False) for grasp in range(2, LIFTS_MAX + 2)
    ]
    assert abandoned == [False] * (LIFTS_MAX - 1) + [True]
    assert (lifts.announced, lifts.awaited) == (2, 0)
