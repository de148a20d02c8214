"""Notices by their serial numbers that the hand's sensors were exchanged."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from daemon.publish.companion import Companion
from drivers.base import Driver, Reading

if TYPE_CHECKING:
    from daemon.trust.learner import LearnerState
    from models.session_statistics import SessionState

OnExchange = Callable[["SessionState | None", "LearnerState | None"], None]
"""Takes what is known of the new sensors, or None."""

log = logging.getLogger("graspd")


class SensorWatch(Companion):
    """Has the judge forget exchanged sensors, before it judges the new ones."""

    def __init__(self, tactile: Driver, on_exchange: OnExchange) -> None:
        self._tactile = tactile
        self._on_exchange = on_exchange
        self._serials: dict[str, str] = {}
        """Last known, by finger."""

    def on_reading(self, reading: Reading) -> None:
        serials = self._tactile.serials
        if serials == self._serials:
            return
        changed = exchanged(self._serials, serials)
        if changed:
            self._exchange(changed, serials)
        self._serials.update(serials)

    def _exchange(self, changed: list[str], _serials: Mapping[str, str]) -> None:
        log.warning("new sensor on %s: the hand must be seen open first", ", ".join(changed))
        self._on_exchange(None, None)


def exchanged(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return the fingers whose sensor is known to be another one."""
    return [finger for finger in now if before.get(finger, now[finger]) != now[finger]]
