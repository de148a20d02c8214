"""Counts in, probability of slip out: image or features, network, and how sharp it may be."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daemon.judge.findings import Examined, Opinion
from daemon.judge.reasons import Reason
from models.contract import ModelError
from models.inputs import SessionBuilder
from models.runtime import TactileModel
from models.tactile_image import SPREAD_FLOOR_COUNTS

if TYPE_CHECKING:
    from daemon.judge.calibration import Calibration

TINY = 1e-12
"""Stands for a probability of zero, whose logarithm there is not."""


class Network:
    """Runs one model, softened as far as its session is known."""

    def __init__(self, model: TactileModel, slip_threshold: float) -> None:
        """`slip_threshold` is the probability, 0..1, that softening must not cross."""
        self._model = model
        self._threshold = slip_threshold

    def judge(self, examined: Examined, session: Calibration | None = None) -> Opinion:
        """Probability of slip of what was examined, or None and why there is none.

        `session` is what is known of it, for a model that needs one.
        """
        if examined.reasons:
            return Opinion(None, examined.reasons, examined.repaired)
        p_slip, reasons = self._ask(examined.counts, session)
        return Opinion(p_slip, reasons, examined.repaired)

    def _ask(
        self, counts: NDArray[np.generic], session: Calibration | None
    ) -> tuple[float | None, tuple[Reason, ...]]:
        model = self._model
        if session is not None and isinstance(model.inputs, SessionBuilder):
            model.inputs.use(session.features_mean, session.features_spread)
        spread = model.inputs.build(counts, model.input)
        if np.count_nonzero(spread >= SPREAD_FLOOR_COUNTS) < len(spread):
            return None, (Reason.FLAT,)
        try:
            p_stable, p_slip = model.run()
        except ModelError:
            return None, (Reason.MODEL_FAILED,)
        if not abs(p_stable + p_slip - 1.0) < 1e-3:  # also true for NaN
            return None, (Reason.MODEL_FAILED,)
        if session is not None:
            p_slip = _softened(p_stable, p_slip, session.temperature, self._threshold)
        return p_slip, ()


def _softened(p_stable: float, p_slip: float, temperature: float, threshold: float) -> float:
    """The slip probability with its log-odds, counted from the threshold, over the temperature.

    So it is less sure, and on the same side of the threshold as before.
    """
    if temperature == 1.0 or not (0.0 <= p_slip <= 1.0 and 0.0 <= p_stable <= 1.0):
        return p_slip
    margin = math.log(max(p_slip, TINY)) - math.log(max(p_stable, TINY))
    zero = math.log(threshold) - math.log1p(-threshold)
    return 1.0 / (1.0 + math.exp(-(zero + (margin - zero) / temperature)))
