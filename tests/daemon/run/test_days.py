"""Days of the whole daemon under faults: its promises hold, and it works when they are over.

A day of three shifts is a simulated minute. `tests/daemon/run/days.py` says what is checked.
"""

from __future__ import annotations

import pytest

from tests.daemon.run import days


@pytest.mark.parametrize("seed", [3, 5])
def test_the_daemons_promises_hold_on_a_day_of_faults(seed: int) -> None:
    day = days.run(seed)
    assert day.said["stable"] > 0
    assert day.lives > 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, 6, *range(100, 110)])
def test_the_daemons_promises_hold_on_many_days_of_faults(seed: int) -> None:
    days.run(seed)
