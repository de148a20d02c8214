"""What a soak must come to: what is counted while it runs, and its limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.stats import theilslopes

from graspd.daemon.judge.reasons import Reason
from graspd.daemon.publish.messages import Status, Verdict
from tests.bench.live import TALLIED, Usage
from tests.kit.messages import decode_status, decode_verdict

SLOPE_MAX_KIB_PER_H = 1024.0
"""3 bytes per reading at 100 Hz, less than any object that could be kept of each."""
GRAIN_KIB = 512
"""Growth below this is no leak yet: an allocator takes pages as it likes. In the second minute of
two at 100 Hz it is 87 bytes per reading; the smallest array has 112."""
SPAN_MIN_S = 45.0
"""What the daemon holds is shown and not judged in a shorter span, s."""
MOST_SHARE = 0.9
LOST_PER_BREAK = 1
"""What ends as the link breaks may be counted twice or not at all: a twin that is killed may not
have told of its last sweep."""
PAUSE_NS = 45_000_000
"""A link that was lost gives no reading for longer: so long alone it waits to try again. Of the
pauses, the longest are the outages, as many as the daemon says that there were."""
PERIOD_SHARE = 0.5
"""The time of a reading is known better than to half a period."""
LATE_MAX_SHARE = 0.02
"""Verdicts that come when the next reading is due already. Twin, daemon and subscribers share the
cores, and the twin has no priority over the others: some of its sweeps are late when it sends."""
LATE_MS = 10.0
"""A period at 100 Hz."""
SILENT_MS = 50.0
"""Half the time after which the daemon says that nothing came."""
WORST_MAX_MS = 500.0
"""Longest from a last byte to its verdict; a shared machine stalls for some tenths of a second."""
STOP_MAX_S = 2.0
"""From SIGTERM to the end: promised is 1 s, on a machine that does nothing else."""

WARM_UP_S, WARM_UP_SHARE = 60.0, 0.5
"""Memory and descriptors are not judged in the first minute: caches fill, the first outages come.
They grew 1.8 MiB in the first 20 s, 0.4 MiB in the next 40 s, and 0.2 MiB in the minute after.
A run of less than two minutes warms up for this share of it."""
SLOPE_SAMPLES = 500
"""Of an hour's 7200: all pairs of them are looked at."""


@dataclass(slots=True)
class Heard:
    """What a subscriber makes of the stream."""

    messages: int = 0
    readings: int = 0
    """Verdicts of readings; the others say that none came."""
    gaps: int = 0
    boots: set[str] = field(default_factory=set)
    late: int = 0
    worst_ms: float = 0.0
    status: Status | None = None
    pauses_ns: list[tuple[int, int]] = field(default_factory=list)
    """Times of two readings in a row with `PAUSE_NS` between them."""
    _last: Verdict | None = None

    def add(self, topic: bytes, payload: bytes, received_ns: int) -> None:
        """Take in a message."""
        if topic.startswith(b"status."):
            self.status = decode_status(payload)
        else:
            self._verdict(decode_verdict(payload), received_ns)

    def _verdict(self, verdict: Verdict, received_ns: int) -> None:
        if verdict.boot_id not in self.boots:
            self.boots.add(verdict.boot_id)
        elif self._last is not None:
            self.gaps += abs(verdict.seq - self._last.seq - 1)
        self.messages += 1
        former, self._last = self._last, verdict
        if former is None or says_nothing_came(verdict, former):
            return
        self.readings += 1
        took_ms = (received_ns - verdict.t_mono_ns) / 1e6
        self.late += took_ms > LATE_MS
        self.worst_ms = max(self.worst_ms, took_ms)
        if verdict.t_mono_ns - former.t_mono_ns > PAUSE_NS:
            self.pauses_ns.append((former.t_mono_ns, verdict.t_mono_ns))


def says_nothing_came(verdict: Verdict, former: Verdict) -> bool:
    """Whether it is about the same reading as the former.

    Readings that were read together may have one time, but the daemon took them at one time too.
    """
    if verdict.t_mono_ns != former.t_mono_ns or Reason.STALE not in verdict.reasons:
        return False
    taken_ms, before_ms = (one.age_ms - one.latency_us / 1e3 for one in (verdict, former))
    return taken_ms - before_ms > SILENT_MS


@dataclass(frozen=True, slots=True)
class Found:
    """What is known when a soak is over."""

    samples: Sequence[Usage]
    """Of the daemon."""
    heard: Heard
    twin: Mapping[str, int]
    """What the twin did, by the names of `TALLIED`."""
    ends_ns: NDArray[np.int64]
    """When the sweeps ended of which nobody knows the number once the link is lost."""
    driver: Mapping[str, int]
    """Counters of the driver in the last status."""
    outages: int
    """Twins that were killed, and subscribers that were stopped."""
    exit_code: int
    stop_s: float
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
        Row("faults and outages", _harm(found)),
        *_resources(found.samples),
        Row("gaps in seq", heard.gaps, 0),
        *_losses(found),
        Row("late verdicts", 100 * heard.late / max(heard.readings, 1), 100 * LATE_MAX_SHARE, "%"),
        Row("worst, last byte to subscriber", heard.worst_ms, WORST_MAX_MS, "ms"),
        Row("restarts", max(len(heard.boots) - 1, 0) + (not heard.boots), 0),
        Row("exit code", abs(found.exit_code), 0),
        Row("time to stop", found.stop_s, STOP_MAX_S, "s"),
    ]


def _harm(found: Found) -> int:
    done = found.twin
    return found.outages + sum(done[name] for name in TALLIED if name != "sweeps")


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


def _losses(found: Found) -> list[Row]:
    """Sweeps that the twin made and that are no verdict, beyond what the counters say."""
    driver, heard = found.driver, found.heard
    counted = driver["missed_readings"]
    outages = sorted(heard.pauses_ns, key=lambda pause: pause[0] - pause[1])[
        : driver["link_losses"]
    ]
    outage = sum(made_between(found.ends_ns, *outage_ns) for outage_ns in outages)
    left = found.twin["sweeps"] - driver["readings"] - counted - outage
    at_breaks = LOST_PER_BREAK * (driver["link_losses"] + 1)  # the last is the end
    # After a stall readings that came together are left out, which the daemon counts.
    left_out = 0 if heard.status is None else heard.status.skipped_readings
    inside = abs(driver["readings"] - heard.readings - left_out)
    return [
        Row("sweeps made", found.twin["sweeps"]),
        Row("lost on the link, counted", counted),
        Row(f"lost while the link was, {driver['link_losses']} times", outage),
        Row("lost as the link broke", left, at_breaks),
        Row("unexplained losses", max(abs(left) - at_breaks, 0) + inside, 0),
    ]


def made_between(ends_ns: NDArray[np.int64], from_ns: int, to_ns: int) -> int:
    """Sweeps after the one that ended at `from_ns` and before that of `to_ns`."""
    margin_ns = round(PERIOD_SHARE * np.median(np.diff(ends_ns))) if len(ends_ns) > 1 else 0
    first, last = np.searchsorted(ends_ns, (from_ns + margin_ns, to_ns - margin_ns))
    return int(last - first)
