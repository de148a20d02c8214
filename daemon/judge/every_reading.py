"""The hand of a grasp table: each reading is a grasp of its own, which all fingers hold still."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import Finger
from graspd.daemon.judge.health import Checked
from graspd.daemon.judge.reasons import GateState, Moment, Reason
from graspd.drivers.base import JointReading


class EveryReading:
    """Has every usable reading judged; used for a table in place of `HandTracker`."""

    on_request = False
    state: GateState | None = None
    tared: tuple[Finger, ...] | None = None
    read_rest: Callable[[], NDArray[np.float64]] | None = None
    """None, like `state` and `tared`: a table has no gate, no tare and no resting counts."""

    def __init__(self) -> None:
        self.grasp = 0
        """Readings until now; the number of the current grasp."""

    def step(
        self,
        _t_ns: int,
        counts: NDArray[np.uint16],
        checked: Checked,
        *,
        in_time: bool = True,
    ) -> tuple[Moment, NDArray[np.uint16] | None]:
        """Return the state of the grasp, and the counts, shape (fingers, 24), to be judged.

        The counts are None if the reading cannot be used. A reading that is not `in_time` is
        judged too, and refused as stale.
        """
        self.grasp += 1
        if checked.reasons:
            return Moment(self.grasp, judges=False), None
        return Moment(self.grasp), counts

    def silent(self) -> Moment:
        """Return the state of the grasp when no reading comes."""
        return Moment(self.grasp, judges=False, judged=False)

    def count_from(self, grasp: int) -> None:
        """Give the next grasp the number `grasp` + 1."""
        self.grasp = grasp

    def health(self) -> dict[str, Reason]:
        """Return an empty dictionary: there is neither tare nor joints."""
        return {}

    def observe_joints(self, reading: JointReading) -> None:
        """Ignore joint angles."""

    def ask(self) -> None:
        """Ignore a request for a judgement: every reading is judged."""

    def interrupt(self) -> None:
        """Ignore missing readings: no grasp continues the one before."""

    def restart(self) -> None:
        """Ignore a restart: no grasp continues the one before."""

    def forget(self) -> None:
        """Ignore an exchange of sensors: nothing is remembered of them."""
