"""When recorded items are due and played, by a clock that only tests move."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import numpy as np
import pytest

from graspd.drivers.base import JointReading, RecordingError
from graspd.drivers.recordings.player import RecordedDriver
from tests.drivers.palm.palm_stream import MS
from tests.kit.clock import Clock

RECORDED_NS = (500 * MS, 510 * MS, 530 * MS)


class Player(RecordedDriver[str]):
    def __init__(self, speed: float | None, clock: Clock, delay_ns: int = 0) -> None:
        super().__init__([Path("x.csv")], speed, clock, delay_ns=delay_ns)

    def open(self) -> None:
        self.start(items())


def items() -> Generator[tuple[int, str], None, None]:
    yield from ((at_ns, f"at {at_ns // MS}") for at_ns in RECORDED_NS)


@pytest.mark.parametrize(("speed", "steps_ms"), [(1.0, [0, 10, 30]), (2.0, [0, 5, 15])])
@pytest.mark.parametrize("delay_ms", [0, 7])
def test_items_are_due_as_recorded_over_the_speed(
    speed: float, steps_ms: list[int], delay_ms: int
) -> None:
    clock = Clock()
    player = Player(speed, clock, delay_ms * MS)
    player.open()
    assert player.due_ns() == clock.now_ns, "the first one begins the run"
    began_ns = clock.now_ns
    assert (player.take() is None) == (delay_ms > 0)
    for at_ns, step_ms in list(zip(RECORDED_NS, steps_ms, strict=True))[0 if delay_ms else 1 :]:
        due_ns = began_ns + (step_ms + delay_ms) * MS
        assert player.due_ns() == due_ns
        clock.now_ns = due_ns - 1
        assert player.take() is None
        clock.now_ns = due_ns + 2
        assert player.take() == (at_ns, f"at {at_ns // MS}", 2)
        assert player.played_ns(at_ns) == began_ns + step_ms * MS
    assert player.exhausted
    assert player.due_ns() is None


def test_without_a_speed_all_is_due_at_once_and_keeps_its_recorded_times() -> None:
    clock = Clock()
    player = Player(None, clock)
    player.open()
    taken = [player.take() for _ in RECORDED_NS]
    assert [at_ns for at_ns, _, _ in filter(None, taken)] == list(RECORDED_NS)
    assert [player.played_ns(at_ns) - clock.now_ns for at_ns in RECORDED_NS] == [
        *(0, 10 * MS, 30 * MS),
    ]
    assert player.exhausted


def test_a_reading_is_handed_over_as_old_as_it_was() -> None:
    clock = Clock()
    player = Player(None, clock)
    clock.now_ns += 5 * MS
    made = JointReading(480 * MS, 3, (), np.zeros(0))
    given = player.hand_over(made, 500 * MS, 100 * MS)
    assert (given.t_ns, given.recorded_ns) == (clock.now_ns - 20 * MS, 380 * MS)
    assert player.hand_over(made, 500 * MS).recorded_ns == 480 * MS
    assert player.handed_over_ns == clock.now_ns


def test_an_error_waits_until_what_is_before_it_was_taken() -> None:
    def broken() -> Generator[tuple[int, str], None, None]:
        yield 0, "first"
        raise RecordingError("x.csv", "no more")  # type: ignore[arg-type]

    player = Player(None, Clock())
    with pytest.raises(RuntimeError, match="not open"):
        player.take()
    player.start(broken())
    assert player.take() == (0, "first", 0)
    assert not player.exhausted
    with pytest.raises(RecordingError, match="no more"):
        player.take()
    assert player.exhausted
