"""How soon and how surely it is known that nothing slides, on generated touches and slides.

`python -m tests.bench.stillness --streams 100` prints both operating points per rate, how soon a
slide that begins after the verdict revokes it, and the curve of the window against the slides that
are missed; `--plot FILE` draws that.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.judge.decision import GateLimits
from daemon.judge.stillness import Motion
from daemon.judge.windows import LONG_NS, SHORT_NS
from drivers.base import ELECTRODES
from drivers.twins.grasps.whole_grasps import RATE_HZ, Sampling
from tests.drivers.twins.slides import SECONDS, SPEED_COUNTS_PER_S, STANDSTILL_S, held

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
CURVE_SWEEPS = (5, 6, 8, 10, 12, 16, 20, 24, 28, 32)
"""Windows of the curve, in sweeps of 10 ms."""
LIMIT_MS, LIMIT_MISSED = 80.0, 0.85
"""A fixed limit, 120 counts/s over so long, called still so much of real slides' sweeps."""
BEGINS_S = 4.0
"""When the slide begins that revokes a verdict."""


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


def revoked(streams: int, false_alarms: float) -> Iterator[str]:
    """How long a verdict stands when a slide begins at the speed of the median one."""
    for rate, (rate_hz, sampling) in RATES.items():
        for kind, sliding in list(KINDS.items())[1:]:
            for early in (False, True):
                stood_ms = [
                    1e3 * _stands_s(sliding, seed, rate_hz, sampling, false_alarms, early=early)
                    for seed in range(streams)
                ]
                yield (
                    f"{rate}, {kind}: {'an early' if early else 'a sure'} verdict is revoked after "
                    f"p50 {np.quantile(stood_ms, 0.5):.0f}, p90 {np.quantile(stood_ms, 0.9):.0f} ms"
                )


def _stands_s(
    sliding: Sequence[bool],
    seed: int,
    rate_hz: float,
    sampling: Sampling,
    false_alarms: float,
    *,
    early: bool,
) -> float:
    random = np.random.default_rng([seed, 5])
    ways = random.normal(size=(len(sliding), ELECTRODES)) * np.array(sliding)[:, np.newaxis]
    ways *= SPEED_COUNTS_PER_S / np.sqrt((ways**2).mean(axis=1, keepdims=True)).clip(min=1e-9)
    usable = np.ones((len(sliding), ELECTRODES), dtype=np.bool_)
    motion = Motion(len(sliding), false_alarms, early=early)
    still = held(
        [False] * len(sliding),
        seconds=BEGINS_S + 1.0,
        rate_hz=rate_hz,
        rest_s=REST_S,
        sampling=sampling,
        seed=seed,
    )
    for t_s, counts in still:
        slid = np.rint(counts + ways * max(t_s - BEGINS_S, 0.0)).astype(np.uint16)
        motion.add(round(t_s * 1e9), slid, usable)
        if t_s >= BEGINS_S and not (motion.early if early else motion.sure):
            return t_s - BEGINS_S
    return float("inf")


@dataclass(frozen=True, slots=True)
class Point:
    """What a window can do at best, as each finger has the limit that its share needs."""

    ms: float
    slope: float
    """Slide sweeps of one finger that are called still by the fitted slope ..."""
    spread: float
    """... and by how far the electrodes spread."""


def curve(streams: int, false_alarms: float) -> list[Point]:
    """Slide sweeps missed by one window alone; limits are quantiles of held touches themselves."""
    share = (1.0 - false_alarms) ** (1.0 / FINGERS)
    touches, slides = (
        [_despiked(slide, seed) for seed in range(streams)] for slide in (False, True)
    )
    return [
        Point(10.0 * sweeps, *(_missed(touches, slides, sweeps, share, how) for how in HOW))
        for sweeps in CURVE_SWEEPS
    ]


def _despiked(slide: bool, seed: int) -> NDArray[np.float64]:
    """A finger's counts, shape (sweeps, 24), as the gate takes them: no rest, no standstill."""
    motion, usable, taken = Motion(1, GateLimits.false_alarms), np.ones((1, ELECTRODES), bool), []
    standstill_s = STANDSTILL_S[1] if slide else 0.0
    ends_s = REST_S + SECONDS - standstill_s
    for t_s, counts in held([slide], seconds=ends_s, rest_s=REST_S, seed=seed):
        motion.add(round(t_s * 1e9), counts, usable)
        if t_s >= REST_S + standstill_s:
            taken.append(motion.memory.clean[0])
    return np.array(taken, dtype=np.float64)


def _missed(
    touches: Sequence[NDArray[np.float64]],
    slides: Sequence[NDArray[np.float64]],
    sweeps: int,
    share: float,
    how: Callable[[NDArray[np.float64], int], NDArray[np.float64]],
) -> float:
    still = np.quantile(np.concatenate([how(each, sweeps) for each in touches]), share)
    return float(np.mean(np.concatenate([how(each, sweeps) for each in slides]) <= still))


def _slopes(counts: NDArray[np.float64], sweeps: int) -> NDArray[np.float64]:
    """Mean over the electrodes of the absolute slopes of counts, shape (rows, 24), counts/s."""
    weights = np.arange(sweeps) - (sweeps - 1) / 2.0
    windows = np.lib.stride_tricks.sliding_window_view(counts, sweeps, axis=0)
    slopes = windows @ (weights / (weights @ weights)) * RATE_HZ
    return np.asarray(np.abs(slopes).mean(axis=1), dtype=np.float64)


def _spreads(counts: NDArray[np.float64], sweeps: int) -> NDArray[np.float64]:
    """Root mean square over the electrodes of their deviation from their mean, counts."""
    windows = np.lib.stride_tricks.sliding_window_view(counts, sweeps, axis=0)
    return np.asarray(np.sqrt(windows.var(axis=2, ddof=1).mean(axis=1)), dtype=np.float64)


HOW = (_slopes, _spreads)


def draw(points: Sequence[Point], slides: Found, path: Path) -> None:
    """The curve of one sliding finger, and where the gate stands on it."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    mpl.rcParams["svg.hashsalt"] = "graspd"
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    times_ms = [point.ms for point in points]
    axes.plot(times_ms, [100 * point.slope for point in points], label="slope of a line")
    axes.plot(times_ms, [100 * point.spread for point in points], label="spread of the electrodes")
    for name, ms, share in (
        ("early", SHORT_NS / 1e6, slides.early.mean()),
        ("sure", LONG_NS / 1e6, slides.sure.mean()),
    ):
        axes.plot([ms], [100 * share], "o", color="black")
        axes.annotate(f"{name}: {share:.0%}", (ms, 100 * share), (6, 8), textcoords="offset points")
    missed = (LIMIT_MS, 100 * LIMIT_MISSED)
    axes.plot(*([each] for each in missed), "x", color="tab:red")
    axes.annotate("a limit of 120 counts/s", missed, (6, -4), textcoords="offset points")
    axes.set_xlabel("time in which it is looked at, ms")
    axes.set_ylabel("of a sliding finger's time called still, %")
    axes.set_ylim(0, 100)
    axes.grid(alpha=0.25)
    axes.legend(loc="upper right", frameon=False)
    figure.savefig(path, format="svg", metadata={"Date": None, "Creator": None})


def main() -> None:
    """Print all of it, and draw the curve if asked."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.stillness", description=__doc__)
    parser.add_argument("--streams", type=int, default=100)
    parser.add_argument("--false-alarms", type=float, default=GateLimits.false_alarms)
    parser.add_argument("--plot", type=Path, metavar="FILE", help="as SVG")
    options = parser.parse_args()
    for lines in (points, revoked):
        for line in lines(options.streams, options.false_alarms):
            print(line, flush=True)  # noqa: T201
    found = curve(options.streams, options.false_alarms)
    for point in found:
        print(  # noqa: T201
            f"{point.ms:.0f} ms: of the sweeps of one sliding finger {point.slope:.0%} are called "
            f"still by their slope, {point.spread:.0%} by their spread"
        )
    if options.plot is not None:
        slides = followed(
            KINDS["all slide"][:1], options.streams, RATE_HZ, Sampling.FRESH, _share(options)
        )
        draw(found, slides, options.plot)


def _share(options: argparse.Namespace) -> float:
    """Of the false alarms of a hand, what one of its fingers may have."""
    return float(1.0 - (1.0 - options.false_alarms) ** (1.0 / FINGERS))


if __name__ == "__main__":
    main()
