"""Sensors that take the place of others, and the knowledge of them."""

from __future__ import annotations

from typing import Final

import msgspec

from graspd.models.session_statistics import SessionState
from graspd.models.trust.learner import LearnerState
from graspd.models.trust.risk import Count


class Exchanged(msgspec.Struct, frozen=True, omit_defaults=True):
    """An exchange of sensors, with what is known of those that are there now."""

    session: SessionState | None = None
    learned: LearnerState | None = None
    proven: Count = 0
    """Outcomes that count for their warm-up."""
    budget: float | None = None
    """Slips that were affordable with them, under the risk that is set; None: not known."""
    tared: bool = False
    """True if the tare that is known is theirs."""


NOTHING_KNOWN: Final = Exchanged()
