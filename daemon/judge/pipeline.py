"""Reading in, judgement out: health, image, network, decision, in this order."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.judge.decision import decide
from daemon.judge.health import Findings, Health
from daemon.judge.session import SessionCalibration
from daemon.judge.verdict import Outcome, Reason
from drivers.base import ELECTRODES, TactileReading
from models.contract import ModelError, SessionInput
from models.electrodes import Electrodes
from models.inputs import SessionBuilder
from models.runtime import TactileModel
from models.tactile_image import SPREAD_FLOOR_COUNTS

TINY = 1e-12
"""Stands for a probability of zero, whose logarithm there is not."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What a verdict other than `unknown` must keep to."""

    max_age_ns: int
    """Age of the reading at the end of judging, ns."""
    slip_threshold: float = 0.5
    """`p_slip` from here on is slip, in 0..1."""
    min_confidence: float = 0.0
    """max(p_slip, 1 - p_slip) must reach this, in 0..1."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """What was found about one reading, or about the lack of one."""

    t_ns: int
    """Monotonic time, ns, of the reading's last byte."""
    grasp: int
    outcome: Outcome
    p_slip: float | None
    """None exactly when the outcome is unknown."""
    reasons: tuple[Reason, ...]
    repaired: tuple[str, ...] = ()
    """Electrodes that were replaced before judging, such as `ff_7`."""
    session_calibrated: bool | None = None
    """Whether the session is known well enough; None for a model that needs none."""


class Pipeline:
    """Judges readings of one hand with one model."""

    def __init__(
        self,
        model: TactileModel,
        fingers: Sequence[str],
        limits: Limits,
        clock: Callable[[], int],
        *,
        learns: bool = True,
    ) -> None:
        """`clock` gives monotonic ns; with `learns` false the session stays what it is.

        Raises `ModelError` if the model is for other fingers.
        """
        if model.contract.fingers != tuple(fingers):
            raise ModelError(
                f"{model.path}: judges the fingers {', '.join(model.contract.fingers)} "
                f"in this order, the hand has {', '.join(fingers)}"
            )
        self._model = model
        self._limits = limits
        self._clock = clock
        self._learns = learns
        electrodes = range(1, ELECTRODES + 1)
        self._names = [f"{finger}_{electrode}" for finger in fingers for electrode in electrodes]
        self.session = _session(model)
        """None for a model that needs none."""
        self._health = Health(len(fingers), model.contract.seen, self.session)
        self._grasp = 0

    def judge(self, reading: TactileReading) -> Judgement:
        """Judge one reading as a grasp of its own. Never raises on bad data."""
        self._grasp += 1
        findings = self._health.examine(reading)
        reasons = list(findings.reasons)
        p_slip = None if reasons else self._infer(findings.counts, reasons)
        # The age is taken last, so that a slow inference counts too.
        age_ns = self._clock() - reading.t_ns
        if not 0 <= age_ns <= self._limits.max_age_ns:
            reasons.append(Reason.STALE)
        judgement = self._judgement(reading.t_ns, p_slip, reasons, self._repaired(findings))
        # Last, so that a grasp is judged by what came before it.
        if self._learns and Reason.STALE not in reasons:
            self._learn(findings)
        return judgement

    def silence(self, last_t_ns: int) -> Judgement:
        """Judgement when no reading came for too long; `last_t_ns` is the last one's time."""
        return self._judgement(last_t_ns, None, [Reason.STALE])

    def _learn(self, findings: Findings) -> None:
        if self.session is not None and findings.grasp is not None:
            self.session.observe(findings.grasp)

    def _infer(self, counts: NDArray[np.generic], reasons: list[Reason]) -> float | None:
        spread = self._model.inputs.build(counts, self._model.input)
        if not (spread >= SPREAD_FLOOR_COUNTS).all():
            reasons.append(Reason.FLAT)
            return None
        try:
            p_stable, p_slip = self._model.run()
        except ModelError:
            reasons.append(Reason.MODEL_FAILED)
            return None
        if not abs(p_stable + p_slip - 1.0) < 1e-3:  # also true for NaN
            reasons.append(Reason.MODEL_FAILED)
            return None
        if self.session is not None:
            threshold = self._limits.slip_threshold
            p_slip = _softened(p_stable, p_slip, self.session.temperature, threshold)
        confidence = p_slip if p_slip >= self._limits.slip_threshold else 1.0 - p_slip
        if confidence < self._limits.min_confidence:
            reasons.append(Reason.LOW_CONFIDENCE)
        return p_slip

    def _repaired(self, findings: Findings) -> tuple[str, ...]:
        if findings.repaired is None:
            return ()
        return tuple(self._names[index] for index in np.flatnonzero(findings.repaired))

    def _judgement(
        self, t_ns: int, p_slip: float | None, reasons: list[Reason], repaired: tuple[str, ...] = ()
    ) -> Judgement:
        outcome = decide(p_slip, reasons, self._limits.slip_threshold)
        if outcome is Outcome.UNKNOWN:
            p_slip = None
            reasons = reasons or [Reason.MODEL_FAILED]
        calibrated = None if self.session is None else self.session.calibrated
        return Judgement(t_ns, self._grasp, outcome, p_slip, tuple(reasons), repaired, calibrated)


def _session(model: TactileModel) -> SessionCalibration | None:
    wanted, inputs = model.contract.input, model.inputs
    if not (isinstance(wanted, SessionInput) and isinstance(inputs, SessionBuilder)):
        return None
    training = Electrodes(model.contract.seen)
    return SessionCalibration(wanted, inputs, training.centre, training.spread)


def _softened(p_stable: float, p_slip: float, temperature: float, threshold: float) -> float:
    """The slip probability with its log-odds, counted from the threshold, over the temperature.

    So it is less sure, and on the same side of the threshold as before.
    """
    if temperature == 1.0 or not (0.0 <= p_slip <= 1.0 and 0.0 <= p_stable <= 1.0):
        return p_slip
    margin = math.log(max(p_slip, TINY)) - math.log(max(p_stable, TINY))
    zero = math.log(threshold) - math.log1p(-threshold)
    return 1.0 / (1.0 + math.exp(-(zero + (margin - zero) / temperature)))
