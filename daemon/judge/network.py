"""Examine counts, repair what contradicts, and ask the network for the probability of slip."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from graspd.daemon.judge.health import too_many
from graspd.daemon.judge.reasons import Reason
from graspd.drivers.base import COUNT_MAX, ELECTRODES
from graspd.models.contract import Finger, ModelError, SeenCounts
from graspd.models.electrodes import CONTRADICTING_MAX, Electrodes, NoveltyCheck
from graspd.models.inputs import SPREAD_FLOOR_COUNTS, SessionBuilder
from graspd.models.runtime import TactileModel

if TYPE_CHECKING:
    from graspd.daemon.judge.calibration import Calibration

FLAT_SPREAD_COUNTS = 70.0
"""Standard deviation of a finger's electrodes below which it is not touching, or not working: half
of the smallest of 4682 real grasps, 148."""
ONES = np.ones(ELECTRODES)
TINY = 1e-12  # for a probability of zero, which has no logarithm


class Examined(msgspec.Struct, frozen=True, eq=False, gc=False):
    """Whether counts look like a grasp of the training, with what was broken repaired."""

    reasons: tuple[Reason, ...]
    """Against judging it; empty if it is sound, or has been repaired."""
    counts: NDArray[np.generic]
    """Shape (fingers, 24), with the broken electrodes repaired; as read where there are reasons."""
    repaired: tuple[str, ...] = ()
    """Electrodes that were replaced, such as `ff_7`."""
    grasp: NDArray[np.generic] | None = None
    """Shape (fingers, 24): what a session may take in, with only certainly broken electrodes
    repaired. It may be like nothing seen before, as drift begins so. None: nothing to take in."""


class Opinion(msgspec.Struct, frozen=True, gc=False):
    """Answer of the network for a grasp, or why it was not asked."""

    p_slip: float | None
    """Probability of slip by the network, softened while its session is young."""
    reasons: tuple[Reason, ...]
    repaired: tuple[str, ...] = ()
    margin: float = 0.0
    """The network's log-odds of slip, before softening; 0 where it was not asked."""


NO_OPINION = Opinion(None, ())


class Plausibility:
    """Compares counts with the training's."""

    def __init__(self, fingers: Sequence[Finger], seen: SeenCounts, electrodes: Electrodes) -> None:
        """`seen` is what the model was trained on, `electrodes` what follows from it."""
        self._fingers = tuple(fingers)
        self._novelty = NoveltyCheck(seen)
        self._electrodes = electrodes

    def examine(
        self,
        counts: NDArray[np.uint16],
        broken: NDArray[np.bool_] | None,
        session: Calibration | None = None,
    ) -> Examined:
        """Return reasons against judging these counts, or the counts to judge by.

        Shapes are (fingers, 24). `broken`: electrodes known to be so; None if all are sound.
        `session`: how today's sensors differ from the training's.
        """
        values = counts.astype(np.float64)
        if _is_flat(values, broken):
            return Examined((Reason.FLAT,), counts)
        if session is not None:
            values = session.to_training(values)
        if broken is None:
            broken = np.zeros(counts.shape, dtype=np.bool_)
        grasp, values = self._repair(counts, values, broken, session)
        known = int(np.count_nonzero(broken))
        at_most = known + CONTRADICTING_MAX + 1
        implausible = self._electrodes.implausible(values, broken, at_most)
        number = int(np.count_nonzero(implausible))
        # With more than that, the reading as a whole is like nothing in the training.
        seen = learned = number < at_most and not too_many(implausible)
        if seen:
            repaired, values = self._repair(counts, values, implausible, session)
            if session is None:
                seen = not self._novelty.never_seen(values[np.newaxis], number).any()
            elif self._electrodes.moved_finger(values):
                seen = learned = False
            else:
                square = self._novelty.square(values, number)
                learned = self._novelty.is_learned(square)
                seen = self._novelty.is_near(square, number - known) and not session.odd
        if not seen:
            # A young session learns from all, for that is how drift begins; later on a sensor that
            # fails would slowly become its own standard.
            learned |= session is None or not session.calibrated
            return Examined((Reason.NEVER_SEEN,), counts, (), grasp if learned else None)
        return Examined((), repaired, self._names(implausible) if number else (), grasp)

    def _repair(
        self,
        counts: NDArray[np.uint16],
        values: NDArray[np.float64],
        broken: NDArray[np.bool_],
        session: Calibration | None,
    ) -> tuple[NDArray[np.generic], NDArray[np.float64]]:
        """Return counts, and their values with the training's sensors, with `broken` repaired."""
        if not broken.any():
            return counts, values
        values = self._electrodes.repaired(values, broken)
        expected = values if session is None else session.from_training(values)
        return np.where(broken, np.clip(expected, 0.0, COUNT_MAX), counts), values

    def _names(self, which: NDArray[np.bool_]) -> tuple[str, ...]:
        places = np.argwhere(which).tolist()
        return tuple(electrode_name(self._fingers[finger], place) for finger, place in places)


class Network:
    """Runs one model, softened while its session is young."""

    def __init__(self, model: TactileModel, slip_threshold: float) -> None:
        """`slip_threshold`: probability, 0..1, that softening must not cross."""
        self._model = model
        self._threshold = math.log(slip_threshold) - math.log1p(-slip_threshold)
        has_session = isinstance(model.inputs, SessionBuilder)
        self.features = model.input if has_session else np.empty(0, np.float32)
        """The network's last input, shape (inputs,), standardised by the session; else empty."""

    def judge(self, examined: Examined, session: Calibration | None = None) -> Opinion:
        """Return the probability of slip of examined counts, or why there is none.

        `session` is what is known of it, for a model that needs one.
        """
        model, repaired = self._model, examined.repaired
        if examined.reasons:
            return Opinion(None, examined.reasons, repaired)
        if session is not None and isinstance(model.inputs, SessionBuilder):
            model.inputs.use(session.features_mean, session.features_spread)
        spread = model.inputs.build(examined.counts, model.input)
        if not (spread >= SPREAD_FLOOR_COUNTS).all():  # also for NaN
            return Opinion(None, (Reason.FLAT,), repaired)
        try:
            p_stable, p_slip = model.run()
        except ModelError:
            return Opinion(None, (Reason.MODEL_FAILED,), repaired)
        sound = 0.0 <= p_slip <= 1.0 and 0.0 <= p_stable <= 1.0  # false for NaN
        if not (sound and abs(p_stable + p_slip - 1.0) < 1e-3):
            return Opinion(None, (Reason.MODEL_FAILED,), repaired)
        margin = math.log(max(p_slip, TINY)) - math.log(max(p_stable, TINY))
        if session is not None and session.temperature != 1.0:
            # Counted from the threshold, so that it stays on the same side.
            log_odds = self._threshold + (margin - self._threshold) / session.temperature
            p_slip = 1.0 / (1.0 + math.exp(-log_odds))
        return Opinion(p_slip, (), repaired, margin)


def electrode_name(finger: Finger, place: int) -> str:
    """Return the name, such as `ff_7`, of the electrode at place 6 of 0..23."""
    return f"{finger}_{place + 1}"


def _is_flat(values: NDArray[np.float64], broken: NDArray[np.bool_] | None) -> bool:
    """Return True if the sound electrodes of a finger read about the same; `values` are counts."""
    numbers = [ELECTRODES] * len(values)
    if broken is not None:
        values = np.where(broken, 0.0, values)
        numbers = (~broken).sum(axis=1).tolist()
    sums = values.dot(ONES).tolist()
    squares = np.square(values).dot(ONES).tolist()
    for number, total, square in zip(numbers, sums, squares, strict=True):
        # Sums of whole numbers are exact, so nothing is lost when they cancel.
        if number * square - total * total < (number * FLAT_SPREAD_COUNTS) ** 2:
            return True
    return False
