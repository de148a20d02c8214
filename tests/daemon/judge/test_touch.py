"""One finger's touch and tare, number by number: each limit from both sides.

The numbers are those of the rule as `graspd.daemon.judge.contact` states it: a touch takes 20
counts, 0.6 of that or a quarter of how deep it was held keeps it, half of that after a minute.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.daemon.judge.contact import Contact, Rest, Touch, Window

THRESHOLD = 20.0
S = 1_000_000_000
MS = 1_000_000
ALL = np.ones((1, 24), dtype=np.bool_)


def held(depth: float, since_ns: int = 0) -> Touch:
    """A finger that has touched since `since_ns`, `depth` counts deep."""
    touch = Touch(THRESHOLD)
    touch.follow(since_ns, 0.0, depth, depth)
    assert touch.touching
    return touch


@pytest.mark.parametrize(
    ("depth", "after_ns", "fall", "kept"),
    [
        (20.0, MS, 12.0, True),  # 0.6 of a touch, more than a quarter of 20
        (20.0, MS, 11.99, False),
        (100.0, MS, 25.0, True),  # a quarter of 100
        (100.0, MS, 24.99, False),
        (100.0, 60 * S, 25.0, True),  # a minute is not long yet
        (100.0, 60 * S + 1, 50.0, True),  # half of 100
        (100.0, 60 * S + 1, 49.99, False),
    ],
)
def test_a_finger_lets_go_below_its_share(
    depth: float, after_ns: int, fall: float, kept: bool
) -> None:
    touch = held(depth, since_ns=S)
    touch.follow(S + after_ns, 0.0, -99.0, fall)
    assert (touch.touching, touch.fall) == (kept, fall), "only the relative fall counts in a hold"
    assert touch.held_long == (not kept and after_ns > 60 * S)


@pytest.mark.parametrize(
    ("deep", "relative", "touches"),
    [(20.0, 20.0, True), (19.99, 99.0, False), (99.0, 19.99, False)],
)
def test_a_touch_falls_below_baseline_and_finger(
    deep: float, relative: float, touches: bool
) -> None:
    touch = Touch(THRESHOLD)
    touch.follow(0, 0.0, deep, relative)
    assert (touch.touching, touch.fall) == (touches, min(deep, relative))
    assert touch.since_ns == (0 if touches else None)


def test_a_hold_fades_five_counts_a_second_to_its_fall() -> None:
    touch = held(100.0)
    depths = []
    for elapsed_s, fall in ((1.0, 60.0), (0.1, 60.0), (99.0, 60.0), (0.0, 70.0)):
        touch.follow(MS, elapsed_s, fall, fall)
        depths.append(touch.depth)
    assert depths == pytest.approx([95.0, 94.5, 60.0, 70.0])
    touch.follow(MS, 0.0, 0.0, 0.0)
    assert (touch.touching, touch.depth, touch.since_ns) == (False, 0.0, None)


def test_a_holds_depth_fades_by_time() -> None:
    contact, rest = Contact(1), np.full((1, 24), 3000, dtype=np.uint16)
    for place in range(100):
        contact.observe(place * 10 * MS, rest, rest, None)
    for t_ns, fall in ((1 * S, 200), (2 * S, 100)):
        pressed = rest.copy()
        pressed[0, :6] -= np.uint16(fall)
        contact.observe(t_ns, pressed, pressed, None)
    assert contact.touches[0].depth == 195.0


@pytest.mark.parametrize(
    ("after_ns", "touches"),
    [(50 * MS - 1, False), (50 * MS, True), (0, False), (-1, True)],
    ids=["too soon", "after 50 ms", "at once", "time went back"],
)
def test_a_finger_that_let_go_touches_again_after_fifty_milliseconds(
    after_ns: int, touches: bool
) -> None:
    touch = held(100.0)
    touch.follow(S, 0.0, 0.0, 0.0)
    assert (touch.touching, touch.let_go_ns) == (False, S)
    touch.follow(S + after_ns, 0.0, 100.0, 100.0)
    assert touch.touching == touches
    assert touch.let_go_ns == S


@pytest.mark.parametrize(
    ("falls", "again"),
    [
        ((10.0,), 30.0),  # from where it let go, not from zero
        ((10.0, 4.0, 8.0), 24.0),  # the smallest since
        ((10.0, -3.0), 20.0),  # never less than a touch
    ],
)
def test_a_new_touch_falls_from_its_smallest_fall(falls: tuple[float, ...], again: float) -> None:
    for fall, touches in ((again - 0.01, False), (again, True)):
        touch = held(40.0)
        for place, rest in enumerate(falls):
            touch.follow(S * (place + 1), 0.0, rest, rest)
        touch.follow(9 * S, 0.0, fall, fall)
        assert touch.touching == touches
    assert touch.lowest == 0.0


@pytest.mark.parametrize(
    ("after_ns", "is_lost"),
    [(0, False), (30 * S, False), (30 * S + 1, True)],
)
def test_a_finger_alone_for_half_a_minute_is_tared(after_ns: int, is_lost: bool) -> None:
    touch = held(100.0)
    assert not touch.has_lost_rest(S, 0.0)
    assert touch.has_lost_rest(S + after_ns, 0.0) == is_lost


@pytest.mark.parametrize(("middle", "is_lost"), [(-20.0, False), (-20.01, True), (99.0, False)])
def test_a_finger_that_rests_a_touch_higher_is_tared_again(middle: float, is_lost: bool) -> None:
    assert Touch(THRESHOLD).has_lost_rest(S, middle) == is_lost


Sweeps = list[NDArray[np.uint16]]


def sweeps_of(values: Iterable[float]) -> Sweeps:
    """Sweeps in which all 24 electrodes read the same."""
    return [np.full(24, round(value), dtype=np.uint16) for value in values]


def wavering(step: float, number: int = 100) -> Sweeps:
    """Up and down around 3000 by `step`, so that the standard deviation is 1.4826 times that."""
    return sweeps_of(3000 + step * (-1) ** sweep for sweep in range(number))


def stepping(step: float) -> Sweeps:
    """At 3000, and half a second later `step` away from it."""
    return sweeps_of([3000.0] * 50 + [3000.0 + step] * 50)


def rest_of(sweeps: Sweeps, usable: int = 24) -> Rest | None:
    window = Window.of(1)
    for counts in sweeps:
        window.add(counts[None], np.arange(24)[None] < usable)
    (rest,) = window.rests([0])
    return rest


def test_a_window_is_checked_after_100_sweeps_then_every_25() -> None:
    contact = Contact(1)
    rest = np.full((1, 24), 3000, dtype=np.uint16)
    looks = []
    for place in range(1, 320):
        counts = rest.copy()
        counts[0, :6] -= np.uint16(100 if place == 160 else 0)
        contact.observe(place * 10 * MS, counts, counts, ALL)
        if contact.touches[0].tared_ns == place * 10 * MS:
            looks.append(place)
    assert looks == [100, 125, 150, 260, 285, 310], "a hundred sweeps after what looked as a touch"


def test_a_finger_that_touches_with_others_is_not_alone() -> None:
    contact = Contact(2)
    rest = np.full((2, 24), 3000, dtype=np.uint16)
    for place in range(100):
        contact.observe(place * 10 * MS, rest, rest, None)
    one, both = rest.copy(), rest.copy()
    one[0, :6] -= np.uint16(200)
    both[:, :6] -= np.uint16(200)
    for at_s, counts in ((1, one), (20, both), (21, one), (50, one)):
        contact.observe(at_s * S, counts, counts, None)
        assert contact.tared == [True, True]
    contact.observe(51 * S + 1, one, one, None)
    assert contact.tared == [False, True], "half a minute since it was left alone"


def test_the_baseline_is_the_median_of_100_sweeps() -> None:
    old, new = [np.full(24, 9, dtype=np.uint16)] * 50, wavering(0)
    rest = rest_of([*old, *new])
    assert rest is not None
    assert rest[0].tolist() == [3000.0] * 24


@pytest.mark.parametrize(
    ("sweeps", "sigma"),
    [
        (wavering(0), 1.5),  # whole numbers hide what is smaller
        (wavering(1), 1.5),  # 1.4826
        (wavering(4), 4 * 1.4826),
        (wavering(6), 6 * 1.4826),  # 8.9
        (wavering(7), None),  # 10.4, more than 10 is not a rest
        (stepping(5), 2.5 * 1.4826),
        (stepping(-5), 2.5 * 1.4826),
        (stepping(6), None),
        (stepping(-6), None),
        (sweeps_of(3000 + 0.12 * sweep for sweep in range(125)), None),  # 6 from half to half
    ],
)
def test_a_finger_rests_that_neither_wavers_nor_rises(sweeps: Sweeps, sigma: float | None) -> None:
    rest = rest_of(sweeps)
    assert (rest is None) == (sigma is None)
    if rest is not None and sigma is not None:
        assert rest[1] == pytest.approx(sigma, rel=1e-9)


@pytest.mark.parametrize(("usable", "known"), [(24, 24), (12, 12), (11, None)])
def test_twelve_electrodes_make_a_tare(usable: int, known: int | None) -> None:
    rest = rest_of(wavering(2), usable)
    assert (None if rest is None else int(rest[2].sum())) == known


@pytest.mark.parametrize(
    ("place", "value", "known"),
    [(3, 0, False), (3, 4095, False), (3, 1, True), (3, 4094, True)],
)
def test_an_electrode_at_a_rail_has_no_rest(place: int, value: int, known: bool) -> None:
    sweeps = wavering(2)
    for sweep in sweeps:
        sweep[place] = value
    rest = rest_of(sweeps)
    assert rest is not None
    assert rest[2].tolist() == [electrode != place or known for electrode in range(24)]


@pytest.mark.parametrize(("step", "known"), [(20, True), (21, False)])
def test_an_electrode_far_noisier_than_its_finger_has_no_rest(step: int, known: bool) -> None:
    sweeps = wavering(2)
    for place, sweep in enumerate(sweeps):
        sweep[5] = 3000 + step * (-1) ** place  # sigma 29.7 or 31.1, the limit is 30
    rest = rest_of(sweeps)
    assert rest is not None
    assert rest[2][5] == known


@pytest.mark.parametrize(
    ("step", "threshold"),
    [(2, 20.0), (4, 5 * 4 * 1.4826)],  # 5 sigmas are 14.8, and 29.7
)
def test_a_touch_takes_five_sigmas_or_twenty_counts(step: int, threshold: float) -> None:
    contact = Contact(1)
    for place, counts in enumerate(wavering(step)):
        assert not any(contact.tared)
        contact.observe(place * 10 * MS, counts[None], counts[None], ALL)
    assert all(contact.tared)
    assert contact.touches[0].threshold == pytest.approx(threshold)


@pytest.mark.parametrize(
    ("step", "followed"),
    [(1.0, 1.0), (9.0, 1.25), (-0.3, -0.3), (-9.0, -0.375)],
    ids=["rises slowly", "rises", "sinks slowly", "sinks"],
)
def test_a_baseline_rises_faster_than_it_sinks(step: float, followed: float) -> None:
    contact = Contact(1)
    for place in range(100):
        counts = np.full((1, 24), 3000, dtype=np.uint16)
        contact.observe(place * 10 * MS, counts, counts, ALL)
    contact.window.counts[:] = 3000
    contact.baseline[:] = 3000.0 - step
    for place in range(100, 125):
        contact.observe(place * 10 * MS, counts, counts, ALL)
    assert contact.baseline[0, 0] == pytest.approx(3000.0 - step + followed)


def test_the_third_deepest_electrode_makes_the_touch() -> None:
    contact = Contact(1)
    rest = np.full((1, 24), 3000, dtype=np.uint16)
    for place in range(100):
        contact.observe(place * 10 * MS, rest, rest, ALL)
    for fallen, touches in ((2, False), (3, True)):
        pressed = rest.copy()
        pressed[0, :fallen] -= np.arange(50, 50 + fallen, dtype=np.uint16)
        contact.observe(S, pressed, pressed, ALL)
        assert contact.touching == [touches]
    assert contact.touches[0].fall == 50.0
