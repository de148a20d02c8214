"""Counts in, probability of slip out: image or features, network, and how sharp it may be."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daemon.judge.findings import Examined, Opinion, all_of
from daemon.judge.reasons import Reason
from models.contract import ModelError
from models.inputs import SessionBuilder
from models.runtime import TactileModel
from models.tactile_image import SPREAD_FLOOR_COUNTS

if TYPE_CHECKING:
    from daemon.judge.calibration import Calibration

NO_FEATURES = np.empty(0, np.float32)
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
        against = examined.reasons
        if not against:
            found = self._ask(examined.counts, session)
            if isinstance(found, tuple):
                return Opinion(found[0], (), examined.repaired, found[1])
            against = (found,)
        return Opinion(None, against, examined.repaired)

    @property
    def features(self) -> NDArray[np.float32]:
        """What the network was asked about last, shape (inputs,), standardised by the session.

        None, shape (0,), for models without a session: what they take is not of unit size.
        """
        model = self._model
        return model.input if isinstance(model.inputs, SessionBuilder) else NO_FEATURES

    def _ask(
        self, counts: NDArray[np.generic], session: Calibration | None
    ) -> tuple[float, float] | Reason:
        """Probability of slip and margin, or why there are none."""
        model = self._model
        if session is not None and isinstance(model.inputs, SessionBuilder):
            model.inputs.use(session.features_mean, session.features_spread)
        spread = model.inputs.build(counts, model.input)
        if not all_of(spread >= SPREAD_FLOOR_COUNTS):
            return Reason.FLAT
        try:
            p_stable, p_slip = model.run()
        except ModelError:
            return Reason.MODEL_FAILED
        sound = 0.0 <= p_slip <= 1.0 and 0.0 <= p_stable <= 1.0  # false for NaN
        if not (sound and abs(p_stable + p_slip - 1.0) < 1e-3):
            return Reason.MODEL_FAILED
        margin = math.log(max(p_slip, TINY)) - math.log(max(p_stable, TINY))
        if session is not None and session.temperature != 1.0:
            p_slip = _softened(margin, session.temperature, self._threshold)
        return p_slip, margin


def _softened(margin: float, temperature: float, threshold: float) -> float:
    """The slip probability with its log-odds, counted from the threshold, over the temperature.

    So it is less sure, and on the same side of the threshold as before.
    """
    zero = math.log(threshold) - math.log1p(-threshold)
    return 1.0 / (1.0 + math.exp(-(zero + (margin - zero) / temperature)))
