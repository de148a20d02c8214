"""An exchange of sensors, and what is known of the new ones."""

from __future__ import annotations

from typing import Final

import msgspec

from graspd.models.session_statistics import SessionState
from graspd.models.trust.learner import LearnerState
from graspd.models.trust.risk import Count


class Exchanged(msgspec.Struct, frozen=True, omit_defaults=True):
    """An exchange of sensors, with what is known of the new ones."""

    session: SessionState | None = None
    learned: LearnerState | None = None
    proven: Count = 0
    """Number of known outcomes with the new sensors that count for the warm-up of the risk."""
    budget: float | None = None
    """Number of slips that the configured risk still allowed with them; None: not known."""
    tared: bool = False
    """True if the current tare was made with the new sensors."""


NOTHING_KNOWN: Final = Exchanged()
