"""Tactile images: levels below the rest that was learned, marks, and motion."""

from __future__ import annotations

from typing import Any

import pytest

from graspd.daemon.judge.reasons import Decision, GateState, Reason
from graspd.daemon.watch.snapshot import FingerImage
from graspd.daemon.watch.view import View
from graspd.models.layout import D1
from tests.daemon.watch.watch_fakes import MS, RESTING, a_view, after, status, tactile, verdict

WIDTH = 11


def rested(readings: int = 30) -> View:
    """Return a view that has seen this number of readings of an open hand at rest."""
    view = after((b"status.right", status(0, health={})))
    for seq in range(readings):
        view.take(b"verdict.right", verdict(seq), 0)
        view.take(b"tactile.right", tactile(seq, RESTING, RESTING), 0)
    return view


def images(view: View, *counts: list[int], faulty: tuple[int, ...] = ()) -> list[FingerImage]:
    """Return the images of one more reading while the hand closes. Parameters: as in `tactile`."""
    view.take(b"verdict.right", verdict(98, gate=GateState.CLOSING), 0)
    view.take(b"tactile.right", tactile(99, *counts, faulty=faulty), 0)
    return view.snapshot(0).fingers


@pytest.mark.parametrize(
    ("fall", "level"), [(0, 0), (16, 10), (400, 50), (1600, 100), (3000, 100), (-400, -50)]
)
def test_a_pixels_level_is_the_root_of_the_electrodes_fall(fall: int, level: int) -> None:
    """Root of the share of 1600 counts, in %: 16 / 1600 = 0.1 squared. At most 100; below 0 for
    a rise."""
    first, second = images(rested(), [3000 - fall] * 24, RESTING)
    assert (first.name, first.from_rest, first.deepest) == ("ff", True, fall)
    assert first.levels == [level] * 132
    assert second.levels == [0] * 132


def test_an_electrode_is_drawn_where_the_layout_places_it() -> None:
    """E7 stands in row 8, column 1 of D1 (the paper's table)."""
    first, _ = images(rested(), [3000] * 6 + [1400] + [3000] * 17, RESTING)
    assert (D1.rows[6], D1.columns[6]) == (8, 1)
    assert first.levels[8 * WIDTH + 1] == 100


def test_a_rest_is_learned_only_while_idle_and_tared() -> None:
    view = rested(24)
    view.take(b"status.right", status(1, tared=["th"]), 0)
    for seq in range(50, 80):
        view.take(b"tactile.right", tactile(seq, RESTING, RESTING), 0)
    assert [finger.from_rest for finger in view.snapshot(0).fingers] == [False, True]
    view.take(b"verdict.right", verdict(90, gate=GateState.CLOSING, contact=["th"]), 0)
    for seq in range(90, 200):
        view.take(b"tactile.right", tactile(seq, RESTING, [1400] * 24), 0)
    assert view.snapshot(0).fingers[1].levels == [100] * 132


def test_an_electrode_that_becomes_well_later_is_not_drawn_as_risen() -> None:
    view = after((b"status.right", status(0, health={})))
    for seq in range(60):
        view.take(b"verdict.right", verdict(seq), 0)
        view.take(b"tactile.right", tactile(seq, RESTING, RESTING, faulty=(6,) * (seq < 30)), 0)
        assert view.snapshot(0).fingers[0].levels == [0] * 132
    first, _ = images(view, [3000] * 6 + [1400] + [3000] * 17, RESTING)
    assert (first.levels[8 * WIDTH + 1], first.marked) == (100, [])  # where E7 stands


def test_the_rest_of_a_finger_without_a_tare_is_forgotten() -> None:
    """Its sensor, which may be another one, then rests 400 counts lower."""
    view, untared = rested(), [Reason.NOT_TARED, Reason.NO_CONTACT]
    view.take(b"verdict.right", verdict(50, reasons=untared, fingers={"ff": None, "th": "free"}), 0)
    for seq in range(50, 75):
        view.take(b"tactile.right", tactile(seq, [2600] * 24, RESTING), 0)
    first, second = images(view, [2600] * 24, [2600] * 24)
    assert (first.from_rest, first.deepest, second.deepest) == (True, 0, 400)


def test_without_a_rest_an_image_shows_how_electrodes_differ() -> None:
    first, flat = images(a_view(), [3000] * 12 + [2000] * 12, RESTING)
    # The median is 2500, and 500 counts are one standard deviation, of two and a half.
    assert not first.from_rest
    assert (min(first.levels), max(first.levels)) == (-40, 40)
    assert flat.levels == [0] * 132


def test_faulty_and_repaired_electrodes_are_marked_and_show_no_touch() -> None:
    view = rested()
    counts = [3000] * 24
    counts[6] = 0
    view.take(b"tactile.right", tactile(99, counts, RESTING, faulty=(6,)), 0)
    view.take(b"verdict.right", verdict(99, Decision.STABLE, repaired=["ff_1", "th_24"]), 0)
    first, second = view.snapshot(0).fingers
    assert (first.levels, first.deepest) == ([0] * 132, 0)
    assert (first.broken, second.broken) == ("1 repaired; 7 broken", "24 repaired")
    assert first.marked == [1, 8 * WIDTH + 1]  # E1 stands in row 0, column 1
    assert second.marked == [5 * WIDTH + 5]  # E24 in row 5, column 5
    nothing, _ = images(a_view(), [0] * 24, RESTING, faulty=tuple(range(24)))
    assert (nothing.levels, len(nothing.marked)) == ([0] * 132, 24)


def test_a_broken_electrode_is_marked_in_an_open_hand_too() -> None:
    """Electrode 7 stays at 0 counts without a fault flag; only the status names it."""
    view = rested()
    view.take(b"status.right", status(1, health={"ff_7": Reason.ELECTRODE_DEAD}), 0)
    view.take(b"tactile.right", tactile(99, [3000] * 6 + [0] + [3000] * 17, RESTING), 0)
    first, second = view.snapshot(0).fingers
    assert (first.levels, first.deepest) == ([0] * 132, 0)
    assert (first.marked, first.broken, second.broken) == ([8 * WIDTH + 1], "7 broken", "")


@pytest.mark.parametrize("counts", [[], [1] * 23])
def test_a_reading_of_fewer_electrodes_has_no_image(counts: list[int]) -> None:
    assert images(a_view(), counts, RESTING) == []


def test_images_and_angles_go_when_readings_no_longer_come() -> None:
    view = after((b"tactile.right", tactile(0, RESTING, RESTING)))
    view.take(b"verdict.right", verdict(0), 1001 * MS)
    seen = view.snapshot(1001 * MS)
    assert (seen.fingers, seen.joints) == ([], {})


def told_of(**told: Any) -> list[FingerImage]:  # noqa: ANN401
    """Return the images after a verdict that has the fields `told`."""
    reading = b"tactile.right", tactile(0, RESTING, RESTING)
    return after(reading, (b"verdict.right", verdict(0, **told))).snapshot(0).fingers


@pytest.mark.parametrize(
    ("limits", "ff", "th"),
    [
        ({"ff": 1.5, "th": 1.0}, (1.2, 1.5), (None, 1.0)),
        ({}, (None, 0.0), (None, 0.0)),
        ({"ff": 0.0}, (None, 0.0), (None, 0.0)),
    ],
)
def test_unknown_motion_of_a_finger_is_not_zero(
    limits: dict[str, float], ff: tuple[float | None, float], th: tuple[float | None, float]
) -> None:
    shown = told_of(still_ms=130.0, motion={"ff": 1.2, "th": None}, motion_limits=limits)
    assert [each.motion and (each.motion.now, each.motion.limit) for each in shown] == [ff, th]
    assert [each.motion for each in told_of()] == [None, None]


@pytest.mark.parametrize("told", [{"ff": "slide", "th": None}, {"ff": "slide"}, None])
def test_a_finger_has_the_state_in_the_verdict_or_none(told: dict[str, Any] | None) -> None:
    assert [each.state for each in told_of(fingers=told)] == [told and "slide", None]
