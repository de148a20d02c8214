"""The final word: from a probability and the reasons against it to a verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence

from daemon.judge.verdict import Outcome, Reason


def decide(p_slip: float | None, reasons: Sequence[Reason], slip_threshold: float) -> Outcome:
    """Outcome of one reading; anything but a clean reading with a sound probability is unknown.

    `p_slip` at or above `slip_threshold` (both in 0..1) is slip.
    """
    if reasons or p_slip is None:
        return Outcome.UNKNOWN
    if not (math.isfinite(p_slip) and 0.0 <= p_slip <= 1.0):
        return Outcome.UNKNOWN
    return Outcome.SLIP if p_slip >= slip_threshold else Outcome.STABLE
