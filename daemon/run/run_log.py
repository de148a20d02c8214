"""One line in the log at the end of a run: how long it was, what was judged, why it ended."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable

from graspd.daemon.judge.reasons import Decision
from graspd.daemon.publish.companion import Companion, PublishedVerdict

log = logging.getLogger("graspd")


class RunLog(Companion):
    """Counts readings and judgements since the start, over all reloads."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock`: monotonic seconds."""
        self._clock = clock
        self._start_s = clock()
        self._readings = 0
        self._judgements: Counter[Decision] = Counter()

    def on_verdict(self, published: PublishedVerdict) -> None:
        """Count a verdict. With a gate only those that judge a grasp are judgements."""
        verdict = published.verdict
        self._readings += published.reading is not None
        if verdict.gate is None or verdict.judged:
            self._judgements[verdict.verdict] += 1

    def write(self, cause: str) -> None:
        """Log the line. `cause`: what ended the run."""
        counts = ", ".join(f"{self._judgements[decision]} {decision}" for decision in Decision)
        log.info(
            "ended by %s after %.1f s: %d readings, %d judgements: %s",
            *(cause, self._clock() - self._start_s),
            *(self._readings, self._judgements.total(), counts),
        )
