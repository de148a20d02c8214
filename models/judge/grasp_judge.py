"""Judge a held grasp by its counts alone: repair, refuse, standardise, and ask a network.

The live judge, the library, training and the reports all judge through `GraspJudge`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from itertools import combinations
from typing import TYPE_CHECKING, Protocol, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX, ELECTRODES, Finger, electrode_name
from graspd.models.contract import Input, ModelError, SeenCounts, SessionInput
from graspd.models.electrodes import ONES, Electrodes, any_of, too_many
from graspd.models.inputs import SPREAD_FLOOR_COUNTS, InputBuilder, SessionBuilder
from graspd.models.runtime import TactileModel

if TYPE_CHECKING:
    from graspd.models.judge.session import SessionCalibration

FLAT_SPREAD_COUNTS = 70.0
"""Smallest standard deviation over the electrodes of a finger that touches and works, counts.

It is about half of 148, the smallest of 4682 real grasps.
"""
TWINS_MIN = 20
"""Fewest equal counts, of 24, by which two fingers are one sensor that was read twice.

In 4682 real grasps at most two are equal.
"""
TINY = 1e-12  # for a probability of zero, which has no logarithm


class Network(Protocol):
    """Interface of a network that judges one input: a loaded model, or a trained system."""

    inputs: InputBuilder
    """Makes the input from counts."""
    input: NDArray[np.float32]
    """Buffer of the input, shape `inputs.shape`."""

    def run(self) -> tuple[float, float]:
        """Return the probabilities (stable, slip) for `input`. Raises `ModelError`."""


class Refusal(StrEnum):
    """Why a grasp has no probability."""

    FLAT = "flat"
    NEVER_SEEN = "never-seen"
    MODEL_FAILED = "model-failed"


class Examined(msgspec.Struct, frozen=True, eq=False, gc=False):
    """Counts of a grasp after repair, and whether a network may judge them."""

    counts: NDArray[np.generic]
    """Shape (fingers, 24): as read, or repaired for electrodes that are broken or contradict the
    others."""
    refusal: Refusal | None = None
    """Why they must not be judged; None: they are sound, or could be repaired."""
    repaired: tuple[str, ...] = ()
    """Electrodes repaired as they are broken or contradict the others, as `ff_7`; () if refused."""
    grasp: NDArray[np.generic] | None = None
    """Counts that the session may learn from, shape (fingers, 24). None: it must not.

    Only electrodes known to be broken are repaired in them. They may be unlike the training,
    because that is how drift begins.
    """


class Opinion(msgspec.Struct, frozen=True, gc=False):
    """Answer of the network for a grasp, or why there is none."""

    p_slip: float | None = None
    """Probability of slip, moved towards the threshold in a young session; None: no answer."""
    refusal: Refusal | None = None
    """Why there is no answer; None if there is one, or no grasp."""
    repaired: tuple[str, ...] = ()
    """`Examined.repaired` of the counts."""
    margin: float = 0.0
    """Log-odds of slip as the network gave them; 0 without an answer."""


NO_OPINION = Opinion()


class GraspJudge:
    """Judges held grasps with one network and, for a session model, today's session.

    It has no clock, and only `observe` changes its later answers.
    """

    def __init__(
        self,
        network: Network,
        takes: Input,
        fingers: Sequence[Finger],
        seen: SeenCounts,
        slip_threshold: float = 0.5,
    ) -> None:
        """`takes`: input of the network. `seen`: its training counts, of these fingers.

        `slip_threshold`: probability of slip, between 0 and 1, that a moved one never crosses.
        """
        self._network = network
        self._fingers = tuple(fingers)
        self._electrodes = Electrodes(seen)
        self._sound = np.zeros(self._electrodes.centre.shape, np.bool_)
        self._slip_threshold = slip_threshold
        self._log_threshold = math.log(slip_threshold) - math.log1p(-slip_threshold)
        self.session: SessionCalibration | None = None
        """Calibration of today's sensors; None: a model without a session."""
        self.features = np.empty(0, np.float32)
        """Last input of a session model, shape (inputs,), standardised; empty for other models."""
        if isinstance(takes, SessionInput):
            from graspd.models.judge.session import SessionCalibration  # only where it is needed

            electrodes = self._electrodes
            self.session = SessionCalibration(takes, electrodes.centre, electrodes.spread)
            self.features = network.input

    @classmethod
    def of(cls, model: TactileModel, slip_threshold: float = 0.5) -> Self:
        """Return the judge of a loaded model."""
        contract = model.contract
        return cls(model, contract.input, contract.fingers, contract.seen, slip_threshold)

    def examine(
        self, counts: NDArray[np.uint16], broken: NDArray[np.bool_] | None = None
    ) -> Examined:
        """Return the counts of a held grasp for `judge`: repaired, or refused.

        `counts`: as read, shape (fingers, 24). `broken`: True for electrodes that are known to be
        broken, same shape; None: none.
        """
        session = self.session
        values = counts.astype(np.float64)
        if _is_flat(values, broken):
            return Examined(counts, Refusal.FLAT)
        if _are_twins(counts):
            return Examined(counts, Refusal.NEVER_SEEN)
        if session is not None:
            values = session.to_training(values)
        if broken is None:
            broken = self._sound
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
        judged: NDArray[np.generic] = counts
        repaired: tuple[str, ...] = ()
        if any_of(found.implausible):
            judged = _as_read(counts, found.values, found.implausible, session)
            repaired = self._names(found.implausible)
        if not seen:
            # A young session learns from all grasps, as drift may have begun. Later on a sensor
            # that fails would slowly become its own standard.
            learned |= session is None or not session.calibrated
            return Examined(judged, Refusal.NEVER_SEEN, (), grasp if learned else None)
        return Examined(judged, None, repaired, grasp)

    def judge(self, examined: Examined) -> Opinion:
        """Return the network's opinion on examined counts, or why there is none."""
        network, repaired = self._network, examined.repaired
        if examined.refusal is not None:
            return Opinion(None, examined.refusal, repaired)
        spread = self.prepare(examined.counts)
        if not all(each >= SPREAD_FLOOR_COUNTS for each in spread.tolist()):  # also for NaN
            return Opinion(None, Refusal.FLAT, repaired)
        try:
            p_stable, p_slip = network.run()
        except ModelError:
            return Opinion(None, Refusal.MODEL_FAILED, repaired)
        sound = 0.0 <= p_slip <= 1.0 and 0.0 <= p_stable <= 1.0  # false for NaN
        if not (sound and abs(p_stable + p_slip - 1.0) < 1e-3):
            return Opinion(None, Refusal.MODEL_FAILED, repaired)
        margin = math.log(max(p_slip, TINY)) - math.log(max(p_stable, TINY))
        temperature = 1.0 if self.session is None else self.session.temperature
        if temperature != 1.0:
            # The temperature acts from the threshold on, so that the probability stays on its side.
            log_odds = self._log_threshold + (margin - self._log_threshold) / temperature
            p_slip = 1.0 / (1.0 + math.exp(-log_odds))
        return Opinion(p_slip, None, repaired, margin)

    def observe(self, examined: Examined, opinion: Opinion) -> None:
        """Let the session learn from a grasp and the opinion on it, unless `examined.grasp` is
        None or there is no session."""
        if self.session is None or examined.grasp is None:
            return
        p_slip = opinion.p_slip
        slip = None if p_slip is None else p_slip >= self._slip_threshold
        self.session.observe(examined.grasp, slip=slip)

    def prepare(self, counts: NDArray[np.generic]) -> NDArray[np.float64]:
        """Write the network's input for counts (fingers, 24) into its buffer; return the standard
        deviation of each finger's counts."""
        inputs, session = self._network.inputs, self.session
        if session is not None and isinstance(inputs, SessionBuilder):
            inputs.use(session.features_mean, session.features_spread)
        return inputs.build(counts, self._network.input)

    def _names(self, which: NDArray[np.bool_]) -> tuple[str, ...]:
        places = np.argwhere(which).tolist()
        return tuple(electrode_name(self._fingers[finger], place) for finger, place in places)


def _as_read(
    counts: NDArray[np.uint16],
    values: NDArray[np.float64],
    broken: NDArray[np.bool_],
    session: SessionCalibration | None,
) -> NDArray[np.generic]:
    """Return `counts`; `broken` electrodes have what today's sensors would read for `values`.

    `values`: counts as the training's sensors read them. `session`: None: today's read the same.
    """
    expected = values if session is None else session.from_training(values)
    return np.where(broken, np.clip(expected, 0.0, COUNT_MAX), counts)


def _are_twins(counts: NDArray[np.uint16]) -> bool:
    """Return True if two fingers of counts, shape (fingers, 24), have the same sensor's."""
    equals = (one == other for one, other in combinations(counts, 2))
    return any(np.count_nonzero(equal) >= TWINS_MIN for equal in equals)


def _is_flat(values: NDArray[np.float64], broken: NDArray[np.bool_] | None) -> bool:
    """Return True if in some finger the standard deviation of `values`, counts, over its sound
    electrodes is below `FLAT_SPREAD_COUNTS`. `broken`: None: all are sound."""
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
