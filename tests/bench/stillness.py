"""How soon and how surely it is known that nothing slides, on generated touches and slides.

`python -m tests.bench.stillness --streams 100` prints both operating points per rate, and the curve
of the window against the slides that are missed.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.judge.limits import GateLimits
from daemon.judge.stillness import Motion
from daemon.judge.windows import LONG_NS
from drivers.base import ELECTRODES
from drivers.twins.grasps.slides import SECONDS, STANDSTILL_S, held
from drivers.twins.grasps.whole_grasps import RATE_HZ, Sampling

REST_S = 1.5
"""The fingers rest before, so that their noise is known, s."""
FINGERS = 3
KINDS = {
    "held": [False] * FINGERS,
    "one finger slides": [True, *[False] * (FINGERS - 1)],
    "all slide": [True] * FINGERS,
}
RATES = {
    "71.43 Hz held": (RATE_HZ, Sampling.HELD),
    "71.43 Hz": (1000 / 14, Sampling.FRESH),
    "100 Hz": (RATE_HZ, Sampling.FRESH),
    "1000 Hz": (1000.0, Sampling.FRESH),
}
CURVE_SWEEPS = (5, 6, 8, 10, 12, 16, 20, 24, 32)
"""Windows of the curve, in sweeps of 10 ms."""


@dataclass(slots=True)
class Found:
    """What was said of streams of one kind, sweep by sweep."""

    early: NDArray[np.bool_]
    """Shape (streams, sweeps), from the first long window on that has no rest in it."""
    sure: NDArray[np.bool_]

    @property
    def ever_sure(self) -> float:
        """Share of the streams that are surely still at any time while it slides."""
        return float(self.sure.any(axis=1).mean())


def followed(
    sliding: Sequence[bool], streams: int, rate_hz: float, sampling: Sampling, false_alarms: float
) -> Found:
    """So many streams; the standstill at begin and end of a slide is left out."""
    usable = np.ones((len(sliding), ELECTRODES), dtype=np.bool_)
    standstill_s = STANDSTILL_S[1] if any(sliding) else 0.0
    begin_s = REST_S + LONG_NS / 1e9 + standstill_s
    end_s = REST_S + SECONDS - standstill_s
    early, sure = [], []
    for seed in range(streams):
        motion, said = Motion(len(sliding), false_alarms, early=True), []
        stream = held(
            sliding,
            seconds=end_s,
            rate_hz=rate_hz,
            rest_s=REST_S,
            sampling=sampling,
            seed=seed,
        )
        for t_s, counts in stream:
            motion.add(round(t_s * 1e9), counts, usable)
            if t_s >= begin_s:
                said.append((motion.early, motion.sure))
        early.append([each for each, _ in said])
        sure.append([each for _, each in said])
    return Found(np.array(early), np.array(sure))


def points(streams: int, false_alarms: float) -> Iterator[str]:
    """Both operating points, for people."""
    for rate, (rate_hz, sampling) in RATES.items():
        for kind, sliding in KINDS.items():
            found = followed(sliding, streams, rate_hz, sampling, false_alarms)
            yield (
                f"{rate}, {kind}: of the sweeps {found.early.mean():.1%} early and "
                f"{found.sure.mean():.1%} surely still; {found.ever_sure:.0%} of the streams "
                f"ever surely"
            )


def curve(streams: int, false_alarms: float) -> Iterator[str]:
    """Slide sweeps missed by one window alone, each finger with the limit that its share needs.

    The limit is the quantile of held touches themselves: what a window can do at best.
    """
    share = (1.0 - false_alarms) ** (1.0 / FINGERS)
    touches, slides = (
        [
            np.array([counts[0] for _, counts in held([slide], seed=seed)], dtype=np.float64)
            for seed in range(streams)
        ]
        for slide in (False, True)
    )
    for sweeps in CURVE_SWEEPS:
        still = np.quantile(np.concatenate([_slopes(each, sweeps) for each in touches]), share)
        missed = float(np.mean(np.concatenate([_slopes(each, sweeps) for each in slides]) <= still))
        yield (
            f"{10 * sweeps} ms: {still:.0f} counts/s; of the sweeps of one sliding finger "
            f"{missed:.0%} are called still, of three {missed**FINGERS:.0%}"
        )


def _slopes(counts: NDArray[np.float64], sweeps: int) -> NDArray[np.float64]:
    """Mean over the electrodes of the absolute slopes of counts, shape (rows, 24), counts/s."""
    weights = np.arange(sweeps) - (sweeps - 1) / 2.0
    windows = np.lib.stride_tricks.sliding_window_view(counts, sweeps, axis=0)
    slopes = windows @ (weights / (weights @ weights)) * RATE_HZ
    return np.asarray(np.abs(slopes).mean(axis=1), dtype=np.float64)


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.stillness", description=__doc__)
    parser.add_argument("--streams", type=int, default=100)
    parser.add_argument("--false-alarms", type=float, default=GateLimits.false_alarms)
    options = parser.parse_args()
    for lines in (points, curve):
        for line in lines(options.streams, options.false_alarms):
            print(line, flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
