"""The course of one grasp: its times, and what fingers and joints do at each time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Range = tuple[float, float]
"""Lower and upper end of a uniform distribution."""

FINGER_LEAD_S = 0.05
"""Longest time, s, by which a finger stops closing before the last one."""
CREEP_SHARE: Range = (0.05, 0.07)
"""Share of the final deviation from rest that is missing when closing ends, due to creep."""
CREEP_TAU_S: Range = (0.10, 0.14)
"""Time constant of the creep after closing, s."""
LOAD_COUNTS: Range = (20.0, 60.0)
"""Fall of a finger's most pressed electrode under load, counts; a grasp causes far more."""
LOAD_S = 0.15
"""Time within which the load rises, s."""
SLIPPING_ELECTRODES = 0.5
"""Share of the electrodes that lose contact in a slip, because the object tilts."""
SLIP_LOSS: Range = (0.3, 0.6)
"""Share of its deviation from rest that an electrode loses in a slip."""
SLIP_STEPS = (2, 4)
"""Fewest and most slips of an object that slides; each is over within a sweep."""
SLIP_WINDOW: Range = (0.1, 0.7)
"""Time of the slips, as a share of the lift."""

JOINT_NAMES = ("FFJ3", "MFJ3", "THJ5", "FFJ2", "MFJ2", "THJ2")
OPEN_RAD = 0.2
CLOSED_RAD: Range = (0.8, 1.0)
"""Joint angle at the end of closing, rad; drawn for each grasp and joint."""


@dataclass(frozen=True, slots=True)
class Durations:
    """Lengths of a grasp's phases, s; each is drawn between two limits."""

    first_rest_s: Range = (1.5, 2.0)
    """Rest before the first grasp; long enough to learn the resting level."""
    approach_s: Range = (0.4, 0.7)
    """Time in which the joints move and touch nothing."""
    touch_s: Range = (0.03, 0.15)
    """Time from the first finger's touch to the last finger's."""
    close_s: Range = (0.25, 0.5)
    """Time from the last touch to the end of closing."""
    settle_s: Range = (0.6, 1.0)
    """Time from the end of closing to the lift: five time constants of creep, and time to judge."""
    lift_s: Range = (0.4, 0.6)
    """Time from the start of the lift to the release."""
    release_s: Range = (0.2, 0.3)
    """Time from the start of opening to no contact; faster than closing."""
    rest_s: Range = (0.8, 1.5)
    """Time from the end of opening to the next approach."""


@dataclass(frozen=True, slots=True, eq=False)
class EndPoint:
    """Counts of a settled grasp, and how its lift ends."""

    counts: NDArray[np.uint16]
    """Shape (fingers, 24)."""
    slipped: bool
    object_name: str


@dataclass(frozen=True, slots=True)
class Timetable:
    """True times of one grasp, seconds since the stream's first sweep."""

    grasp: int
    """Number of the grasp, from 1."""
    slipped: bool
    object_name: str
    approach_s: float
    """Start of the grasp: the joints begin to move."""
    touched_s: tuple[float, ...]
    """Time when each finger touches; its counts begin to change smoothly."""
    closed_s: float
    """End of closing; the joints stand still from here to the release."""
    lift_s: float
    release_s: float
    open_s: float
    """End of opening: no contact."""
    end_s: float
    creep_tau_s: float
    creep_counts_per_s: float
    """Mean speed of creep of all electrodes at `closed_s`, counts/s."""


class GraspScript:
    """One grasp as functions of time: deviation of the counts, angles of the joints."""

    def __init__(
        self,
        end_point: EndPoint,
        rest: NDArray[np.float64],
        grasp: int,
        start_s: float,
        durations: Durations,
        rng: np.random.Generator,
    ) -> None:
        """`rest`: counts of the untouched fingers, shape (fingers, 24). `grasp`: its number.
        `start_s`: time when the hand begins to approach."""
        self._deviation = end_point.counts - rest
        fingers = len(rest)
        touched = _touches(fingers, start_s + rng.uniform(*durations.approach_s), durations, rng)
        closed_s = float(touched.max()) + rng.uniform(*durations.close_s)
        lead = rng.uniform(0.0, FINGER_LEAD_S, fingers)
        closed = closed_s - (lead - lead.min())
        self._touched, self._closed = touched[:, np.newaxis], closed[:, np.newaxis]
        self._creep_share = rng.uniform(*CREEP_SHARE)
        self._tau_s = rng.uniform(*CREEP_TAU_S)
        lift_s = closed_s + rng.uniform(*durations.settle_s)
        release_s = lift_s + rng.uniform(*durations.lift_s)
        open_s = release_s + rng.uniform(*durations.release_s)
        self._load, self._loss = self._lift_changes(end_point.slipped, rng)
        steps = int(rng.integers(SLIP_STEPS[0], SLIP_STEPS[1] + 1))
        self._slips_s = lift_s + (release_s - lift_s) * np.sort(rng.uniform(*SLIP_WINDOW, steps))
        self._closed_rad = rng.uniform(*CLOSED_RAD, len(JOINT_NAMES))
        self.timetable = Timetable(
            grasp=grasp,
            slipped=end_point.slipped,
            object_name=end_point.object_name,
            approach_s=start_s,
            touched_s=tuple(touched.tolist()),
            closed_s=closed_s,
            lift_s=lift_s,
            release_s=release_s,
            open_s=open_s,
            end_s=open_s + rng.uniform(*durations.rest_s),
            creep_tau_s=self._tau_s,
            creep_counts_per_s=self._creep_counts_per_s(closed_s),
        )

    def deviation(self, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return counts minus those at rest, shape (fingers, 24). `t_s`: times, s, shape () for
        all, or (24,) for one of each electrode."""
        timetable = self.timetable
        if t_s.max() <= min(timetable.touched_s) or t_s.min() >= timetable.open_s:
            return np.zeros_like(self._deviation)
        ramp = _minimum_jerk((t_s - self._touched) / (self._closed - self._touched))
        since_s = np.maximum(t_s - self._closed, 0.0)
        creep = 1.0 - np.exp(-since_s / self._tau_s)
        pressed = (1.0 - self._creep_share) * ramp + self._creep_share * creep
        deviation: NDArray[np.float64] = pressed * self._deviation
        if t_s.max() <= timetable.lift_s:
            return deviation
        deviation += _minimum_jerk((t_s - timetable.lift_s) / LOAD_S) * self._load
        slips = (t_s >= self._slips_s.reshape(-1, *[1] * t_s.ndim)).mean(axis=0)
        deviation *= 1.0 - slips * self._loss
        opening_s = timetable.open_s - timetable.release_s
        deviation *= 1.0 - _minimum_jerk((t_s - timetable.release_s) / opening_s)
        return deviation

    def position_rad(self, t_s: float) -> NDArray[np.float64]:
        """Return the angles of `JOINT_NAMES` at `t_s`, rad."""
        timetable = self.timetable
        if t_s < timetable.release_s:
            share = (t_s - timetable.approach_s) / (timetable.closed_s - timetable.approach_s)
        else:
            share = (timetable.open_s - t_s) / (timetable.open_s - timetable.release_s)
        return OPEN_RAD + (self._closed_rad - OPEN_RAD) * _minimum_jerk(np.asarray(share))

    def _lift_changes(
        self, slipped: bool, rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return load, counts, and lost share of the deviation, shape (fingers, 24) each.

        The load is 0 if the object slipped, the lost share if it did not.
        """
        nothing = np.zeros_like(self._deviation)
        if slipped:
            losing = rng.random(nothing.shape) < SLIPPING_ELECTRODES
            return nothing, losing * rng.uniform(*SLIP_LOSS, nothing.shape)
        deepest = np.abs(self._deviation).max(axis=1, keepdims=True)
        load = rng.uniform(*LOAD_COUNTS, deepest.shape)
        # The load on a finger is at most its own pressure, and 0 without contact.
        scale = np.divide(load, deepest, out=np.zeros_like(deepest), where=deepest >= load)
        return scale * self._deviation, nothing

    def _creep_counts_per_s(self, t_s: float) -> float:
        rate = self._creep_share / self._tau_s * np.exp((self._closed - t_s) / self._tau_s)
        return float((rate * np.abs(self._deviation)).mean())


def _touches(
    fingers: int, first_s: float, durations: Durations, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return the time, s, when each finger touches; the first is `first_s`."""
    order = rng.random(fingers)
    span_s = rng.uniform(*durations.touch_s)
    order -= order.min()
    if fingers > 1:
        order *= span_s / order.max()
    return first_s + order


def _minimum_jerk(share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the share of a motion that is done after a share of its time (Flash, Hogan 1985)."""
    share = np.minimum(np.maximum(share, 0.0), 1.0)
    return share * share * share * (10.0 + share * (6.0 * share - 15.0))
