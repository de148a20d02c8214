"""The book of lifts: who may report an outcome, what is remembered, what is kept on the disk."""

from __future__ import annotations

import pytest

from graspd.daemon.trust.lift_book import LIFTS_MAX, NOT_ASSESSED, LiftBook, OutcomeStatus, Peer
from tests.daemon.trust.grasps import named

ROBOT, STRANGER = b"user 1000", b"user 1001"
CONTROLLER = Peer(b"controller-16byte1", ROBOT)
RESTARTED = Peer(b"another-16-bytes1", ROBOT)
FORGER = Peer(CONTROLLER.routing_id, STRANGER)


def book(*grasps: int) -> LiftBook:
    """One in which these grasps were called `stable`."""
    lifts = LiftBook()
    for grasp in grasps:
        lifts.note(named(grasp), bytes(8), stable=True)
    return lifts


def test_the_owner_alone_reports_a_grasp() -> None:
    lifts = book(1)
    assert lifts.claim(named(1), CONTROLLER)
    assert lifts.may_report(named(1), CONTROLLER._replace(routing_id=b"controller-16byte2"))
    assert not lifts.may_report(named(1), FORGER)
    assert not lifts.may_report(named(1), RESTARTED)


def test_another_user_cannot_claim_an_owned_grasp() -> None:
    lifts = book(1)
    assert lifts.claim(named(1), CONTROLLER)
    assert not lifts.claim(named(1), FORGER)
    assert lifts.lifter == CONTROLLER


def test_a_restarted_controller_reports_for_the_former_one() -> None:
    lifts = book(1, 2)
    lifts.claim(named(1), CONTROLLER)
    assert lifts.claim(named(2), RESTARTED)
    assert lifts.may_report(named(1), RESTARTED)
    assert lifts.may_report(named(1), CONTROLLER)
    assert not lifts.may_report(named(2), CONTROLLER)


def test_only_the_last_lifter_reports_grasps_without_an_owner() -> None:
    lifts = book(1, 2)
    assert not lifts.may_report(named(1), CONTROLLER)
    lifts.claim(named(2), CONTROLLER)
    assert lifts.may_report(named(1), CONTROLLER)
    assert not lifts.may_report(named(1), FORGER)


def test_a_told_or_unknown_grasp_has_no_new_owner() -> None:
    lifts = book(1)
    lifts.tell(named(1), slipped=False)
    assert not lifts.claim(named(1), CONTROLLER)
    assert not lifts.claim(named(2), CONTROLLER)


def test_owners_are_kept_between_two_starts() -> None:
    lifts, later = book(1), LiftBook()
    lifts.claim(named(1), CONTROLLER)
    later.restore(lifts.state(), 1)
    assert later.may_report(named(1), CONTROLLER)
    assert not later.may_report(named(1), FORGER)
    assert not later.may_report(named(1), RESTARTED)


def test_a_lift_that_is_taken_back_is_not_awaited() -> None:
    lifts, heard = book(1), list[bool]()
    lifts.on_announced = heard.append
    lifts.claim(named(1), CONTROLLER)
    assert lifts.offered(CONTROLLER) == named(1)
    assert lifts.offered(FORGER) is None
    lifts.announce()
    assert lifts.take_back(named(1))
    assert (lifts.announced, lifts.awaited, heard) == (0, 0, [True, False])
    lifts.announce()
    assert lifts.take_back(None)
    assert lifts.take_back(named(1)), "there is nothing to take back"
    lifts.tell(named(1), slipped=True)
    assert not lifts.take_back(named(1))
    assert heard == [True, False] * 2


@pytest.mark.parametrize("stable", [True, False])
def test_an_unassessed_grasp_is_told_and_teaches_nothing(stable: bool) -> None:
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


def test_a_restored_outcome_is_kept() -> None:
    lifts = LiftBook()
    lifts.note(named(1), bytes(8), stable=True)
    lifts.tell(named(1), slipped=False)
    other = LiftBook()
    other.restore(lifts.state(), 1)
    assert other.is_told(named(1))
    assert other.is_kept(named(1))
    assert other.tell(named(1), slipped=False)[0] is OutcomeStatus.REPEATED
    assert other.tell(named(1), slipped=True)[0] is OutcomeStatus.CONTRADICTS


def test_a_lift_is_announced_once_and_awaited_until_told() -> None:
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
