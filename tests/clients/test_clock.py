"""When a client asks another computer's daemon for its clock, and when it connects again."""

from __future__ import annotations

import pytest

from tests.clients.messages import MS, frames, verdict
from tests.clients.test_lift import START_NS, World, client

TOLD = b'{"v":1,"t_mono_ns":77000000000}'


def heard() -> World:
    """A daemon of which a message comes every 100 ms."""
    times = [START_NS + step * 100 * MS for step in range(120)]
    return World([(at_ns, frames(verdict(seq, at_ns))) for seq, at_ns in enumerate(times)])


def asked_at_ms(world: World, *, same: bool = False) -> list[int]:
    """Times of the questions, by looking every 100 ms for 12 s."""
    times: list[int] = []
    with client(world, ask=True, same=same) as graspd:
        for step in range(120):
            world.now_ns = START_NS + step * 100 * MS
            graspd.verdict()
            if len(world.timing.said) > len(times):
                times.append(step * 100)
    assert set(world.timing.said) <= {b"clock"}
    return times


def test_a_client_asks_for_the_clock_once_a_second_while_it_is_answered() -> None:
    world = heard()
    world.timing.answers.extend([(5 * MS, TOLD)] * 20)
    assert asked_at_ms(world) == pytest.approx(list(range(0, 12_000, 1000)), abs=200)


def test_a_client_that_is_not_answered_asks_again_after_ten_seconds() -> None:
    assert asked_at_ms(heard()) == [0, 10_000]


def test_a_client_on_the_same_computer_does_not_ask_for_the_clock() -> None:
    assert asked_at_ms(heard(), same=True) == []


@pytest.mark.parametrize(
    "answer",
    [b"", b"{}", b'{"v":2,"t_mono_ns":1}', b'{"v":1,"t_mono_ns":-1}', b'{"v":1,"ok":true}'],
)
def test_a_clock_that_is_not_understood_is_malformed(answer: bytes) -> None:
    world = World([])
    world.timing.answers.append((MS, answer))
    with client(world, ask=True, same=False) as graspd:
        graspd.verdict(0.01)
        assert graspd.counts.malformed == 1


def test_who_hears_nothing_at_all_connects_anew_ever_more_seldom() -> None:
    world = World([])
    times_s = []
    with client(world) as graspd:
        for _ in range(400):
            before = world.renewed
            graspd.verdict(0.1)
            if world.renewed > before:
                times_s.append((world.now_ns - START_NS) / 1e9)
    gaps = [after - before for before, after in zip([0.0, *times_s], times_s, strict=False)]
    assert gaps == pytest.approx([1.0, 2.0, 4.0, 8.0, 10.0, 10.0], abs=0.15)
