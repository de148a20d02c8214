"""Examine counts, repair what contradicts, and ask the network for the probability of slip."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX, ELECTRODES, Finger, electrode_name
from graspd.daemon.judge.health import any_of, too_many
from graspd.daemon.judge.reasons import Reason
from graspd.models.contract import ModelError
from graspd.models.electrodes import Electrodes
from graspd.models.inputs import SPREAD_FLOOR_COUNTS, SessionBuilder
from graspd.models.runtime import TactileModel

if TYPE_CHECKING:
    from graspd.daemon.judge.calibration import Calibration

FLAT_SPREAD_COUNTS = 70.0
"""Smallest standard deviation over the electrodes of a finger that touches and works, counts.

It is half of 148, the smallest of 4682 real grasps.
"""
ONES = np.ones(ELECTRODES)
TINY = 1e-12  # for a probability of zero, which has no logarithm


class Examined(msgspec.Struct, frozen=True, eq=False, gc=False):
    """Counts of a grasp after repair, or reasons why the network must not judge them."""

    reasons: tuple[Reason, ...]
    """Reasons against judging; empty if the counts are sound or could be repaired."""
    counts: NDArray[np.generic]
    """Counts to judge, shape (fingers, 24): repaired, or as read if there are reasons."""
    repaired: tuple[str, ...] = ()
    """Electrodes that were repaired because they contradict the others, such as `ff_7`."""
    grasp: NDArray[np.generic] | None = None
    """Counts that the session may learn from, shape (fingers, 24). None: it must not.

    Only electrodes that are known to be broken are repaired in them. They may be unlike the
    training: drift begins so.
    """


class Opinion(msgspec.Struct, frozen=True, gc=False):
    """Answer of the network for a grasp, or reasons why there is none."""

    p_slip: float | None
    """Probability of slip, nearer to the threshold while the session is young; None: no answer."""
    reasons: tuple[Reason, ...]
    """Reasons why there is no answer; empty if there is one."""
    repaired: tuple[str, ...] = ()
    """`Examined.repaired` of the counts."""
    margin: float = 0.0
    """Log-odds of slip as the network gave them; 0 without an answer."""


NO_OPINION = Opinion(None, ())


class Plausibility:
    """Repairs counts where electrodes contradict the others; refuses those unlike the training."""

    def __init__(self, fingers: Sequence[Finger], electrodes: Electrodes) -> None:
        """`electrodes`: made from the model's description of its training counts."""
        self._fingers = tuple(fingers)
        self._electrodes = electrodes

    def examine(
        self,
        counts: NDArray[np.uint16],
        broken: NDArray[np.bool_] | None,
        session: Calibration | None = None,
    ) -> Examined:
        """Return the counts to judge, or reasons against judging them.

        `counts`: as read, shape (fingers, 24). `broken`: True for electrodes that are known to be
        broken, same shape; None: none. `session`: maps counts of today's sensors to those of the
        training; None: the model has no session.
        """
        values = counts.astype(np.float64)
        if _is_flat(values, broken):
            return Examined((Reason.FLAT,), counts)
        if session is not None:
            values = session.to_training(values)
        if broken is None:
            broken = np.zeros(counts.shape, dtype=np.bool_)
        grasp: NDArray[np.generic] = counts
        if any_of(broken):
            values = self._electrodes.repaired(values, broken)
            grasp = _as_read(counts, values, broken, session)
        found = self._electrodes.examine(values, broken, in_session=session is not None)
        seen, learned = found.seen, found.learned
        if too_many(found.implausible):
            seen = learned = False
        if session is not None and session.odd:
            seen = False
        if not seen:
            # A young session learns from all, for that is how drift begins; later on a sensor that
            # fails would slowly become its own standard.
            learned |= session is None or not session.calibrated
            return Examined((Reason.NEVER_SEEN,), counts, (), grasp if learned else None)
        if not any_of(found.implausible):
            return Examined((), counts, (), counts)
        repaired = _as_read(counts, found.values, found.implausible, session)
        return Examined((), repaired, self._names(found.implausible), grasp)

    def _names(self, which: NDArray[np.bool_]) -> tuple[str, ...]:
        places = np.argwhere(which).tolist()
        return tuple(electrode_name(self._fingers[finger], place) for finger, place in places)


class Network:
    """Runs one model. While its session is young, it moves probabilities to the threshold."""

    def __init__(self, model: TactileModel, slip_threshold: float) -> None:
        """`slip_threshold`: probability of slip, 0..1, that a moved probability never crosses."""
        self._model = model
        self._threshold = math.log(slip_threshold) - math.log1p(-slip_threshold)
        has_session = isinstance(model.inputs, SessionBuilder)
        self.features = model.input if has_session else np.empty(0, np.float32)
        """Last input of a session model, shape (inputs,), standardised; empty for other models."""

    def judge(self, examined: Examined, session: Calibration | None = None) -> Opinion:
        """Return the probability of slip of examined counts, or why there is none.

        `session`: statistics that standardise the input; None: the model has no session.
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


def _as_read(
    counts: NDArray[np.uint16],
    values: NDArray[np.float64],
    broken: NDArray[np.bool_],
    session: Calibration | None,
) -> NDArray[np.generic]:
    """Return counts with `broken` electrodes as today's sensors would read their `values`."""
    expected = values if session is None else session.from_training(values)
    return np.where(broken, np.clip(expected, 0.0, COUNT_MAX), counts)


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
