"""What a soak must come to: what is counted while it runs, and its limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import theilslopes

from graspd.daemon.publish.messages import Verdict
from tests.bench.live import Usage

SLOPE_MAX_KIB_PER_H = 1024.0
"""3 bytes per reading at 100 Hz, less than any object that could be kept of each."""
GRAIN_KIB = 512
"""Growth below this is not a leak yet: an allocator takes pages as it likes. In the second minute
of two at 100 Hz it is 87 bytes per reading; the smallest array has 112."""
SPAN_MIN_S = 45.0
"""What the daemon holds is shown and not judged in a shorter span, s."""
MOST_SHARE = 0.9
WARM_UP_S, WARM_UP_SHARE = 60.0, 0.5
"""Memory and descriptors are not judged in the first minute: caches fill, the first outages come.
They grew 1.8 MiB in the first 20 s, 0.4 MiB in the next 40 s, and 0.2 MiB in the minute after.
A run of less than two minutes warms up for this share of it."""
SLOPE_SAMPLES = 500
"""Most samples of an hour's 7200: all pairs of them are looked at."""


@dataclass(slots=True)
class Heard:
    """What a subscriber makes of the stream."""

    messages: int = 0
    readings: int = 0
    """Verdicts of another time than the one before; the others say that no reading came."""
    gaps: int = 0
    boots: set[str] = field(default_factory=set)
    _last: Verdict | None = None

    def add(self, verdict: Verdict) -> None:
        """Take in a message."""
        former, self._last = self._last, verdict
        self.messages += 1
        if verdict.boot_id not in self.boots:
            self.boots.add(verdict.boot_id)
        elif former is not None:
            self.gaps += abs(verdict.seq - former.seq - 1)
            self.readings += verdict.t_mono_ns != former.t_mono_ns


@dataclass(frozen=True, slots=True)
class Found:
    """What is known when a soak is over."""

    samples: Sequence[Usage]
    """What the daemon used, sample by sample."""
    heard: Heard
    outages: int
    """Twins that were killed, and subscribers that were stopped."""
    exit_code: int
    planned: float = 0.0
    """Readings that would have come without faults and outages."""
    ended_early: bool = False
    """Whether the daemon was gone before it was told to stop."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the result."""

    name: str
    value: float
    limit: float | None = None
    unit: str = ""

    @property
    def broken(self) -> bool:
        """Whether the value is beyond its limit."""
        return self.limit is not None and self.value > self.limit

    def cells(self) -> tuple[str, str, str]:
        """Name, value and limit as in the table."""
        limit = "" if self.limit is None else f"{self.limit:g}"
        value = f"{self.value:,.2f}".rstrip("0").rstrip(".")
        return self.name, f"{value} {self.unit}{' !' if self.broken else ''}".strip(), limit


FEW = 0.2
"""Share of the planned readings that must have come: with fewer nothing has been tried."""


def judge(found: Found) -> list[Row]:
    """Everything that was found, beside its limit."""
    heard = found.heard
    return [
        Row("readings", heard.readings),
        Row("missing of a fifth of the plan's", max(FEW * found.planned - heard.readings, 0), 0),
        Row("ended before it was told to", found.ended_early, 0),
        Row("outages", found.outages),
        *_resources(found.samples),
        Row("gaps in seq", heard.gaps, 0),
        Row("restarts", max(len(heard.boots) - 1, 0) + (not heard.boots), 0),
        Row("exit code", abs(found.exit_code), 0),
    ]


def _resources(samples: Sequence[Usage]) -> list[Row]:
    """What the daemon holds, from the end of its warm-up on."""
    began_s, ended_s = samples[0].t_s, samples[-1].t_s
    warm_s = began_s + min(WARM_UP_SHARE * (ended_s - began_s), WARM_UP_S)
    judged = [sample for sample in samples if sample.t_s >= warm_s]
    few = judged[:: -(-len(judged) // SLOPE_SAMPLES)]
    hours = np.array([sample.t_s for sample in few]) / 3600
    # The median of the slopes between all pairs of points: one jump does not count.
    per_h = float(theilslopes([sample.rss_kib for sample in few], hours).slope)
    span_h = float(hours[-1] - hours[0])
    long_enough = span_h >= SPAN_MIN_S / 3600
    third = max(len(judged) // 3, 1)
    slope_max = max(SLOPE_MAX_KIB_PER_H, GRAIN_KIB / max(span_h, 1e-6)) if long_enough else None
    rows = [
        Row("memory", judged[-1].rss_kib / 1024, None, "MiB"),
        Row("memory slope", per_h, slope_max, "KiB/h"),
    ]
    for name in ("descriptors", "threads"):
        first, last = (most(name, part) for part in (judged[:third], judged[-third:]))
        rows.append(Row(f"{name} more at the end", last - first, 0 if long_enough else None))
    return rows


def most(name: str, samples: Sequence[Usage]) -> float:
    """How many are held nine times in ten: the link comes and goes, a file is open for a moment."""
    held = [getattr(sample, name) for sample in samples]
    return float(np.quantile(held, MOST_SHARE, method="lower"))
