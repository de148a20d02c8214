"""Reading in, judgement out: health, image, network, decision, in this order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from daemon.judge.decision import decide
from daemon.judge.health import Health
from daemon.judge.verdict import Outcome, Reason
from drivers.base import TactileReading
from models.contract import ModelError
from models.runtime import TactileModel
from models.tactile_image import SPREAD_FLOOR_COUNTS


@dataclass(frozen=True, slots=True)
class Limits:
    """What a verdict other than `unknown` must keep to."""

    max_age_ns: int
    """Age of the reading at the end of judging, ns."""
    slip_threshold: float = 0.5
    """`p_slip` from here on is slip, in 0..1."""


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


class Pipeline:
    """Judges readings of one hand with one model."""

    def __init__(
        self,
        model: TactileModel,
        fingers: Sequence[str],
        limits: Limits,
        clock: Callable[[], int],
    ) -> None:
        """`clock` gives monotonic ns. Raises `ModelError` if the model is for other fingers."""
        if model.contract.fingers != tuple(fingers):
            raise ModelError(
                f"{model.path}: judges the fingers {', '.join(model.contract.fingers)} "
                f"in this order, the hand has {', '.join(fingers)}"
            )
        self._model = model
        self._limits = limits
        self._clock = clock
        self._health = Health(len(fingers), model.contract.seen)
        self._grasp = 0

    def judge(self, reading: TactileReading) -> Judgement:
        """Judge one reading as a grasp of its own. Never raises on bad data."""
        self._grasp += 1
        reasons = self._health.examine(reading)
        p_slip = None if reasons else self._infer(reading, reasons)
        # The age is taken last, so that a slow inference counts too.
        age_ns = self._clock() - reading.t_ns
        if not 0 <= age_ns <= self._limits.max_age_ns:
            reasons.append(Reason.STALE)
        return self._judgement(reading.t_ns, p_slip, reasons)

    def silence(self, last_t_ns: int) -> Judgement:
        """Judgement when no reading came for too long; `last_t_ns` is the last one's time."""
        return self._judgement(last_t_ns, None, [Reason.STALE])

    def _infer(self, reading: TactileReading, reasons: list[Reason]) -> float | None:
        spread = self._model.imager.build(reading.counts, self._model.image)
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
        return p_slip

    def _judgement(self, t_ns: int, p_slip: float | None, reasons: list[Reason]) -> Judgement:
        outcome = decide(p_slip, reasons, self._limits.slip_threshold)
        if outcome is Outcome.UNKNOWN:
            p_slip = None
            reasons = reasons or [Reason.MODEL_FAILED]
        return Judgement(t_ns, self._grasp, outcome, p_slip, tuple(reasons))
