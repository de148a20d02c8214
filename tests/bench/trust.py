"""Streams of another day through a session network, the learner and the risk: what they are worth.

`python -m tests.bench.trust DIR` prints the tables; DIR is the folder that holds
`bts3/`. The streams are those of `graspd report worth`.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.measure.streams import ORDERS, Life, Plan, Stream, live, streams
from daemon.trust.learner import Learner
from daemon.trust.trust import RiskLimits
from models.training.data.datasets import read_all
from models.training.evaluating.day_figures import VerdictFigures

OUTCOMES = (0, 5, 10, 20, 50, 100, 200)
REST = 200
"""Grasps from here on are what frozen learners are compared on."""
AGES = ((0, 50), (50, 100), (100, 200), (200, None))
ALPHAS = (0.02, 0.05, 0.1)
PARTS = (slice(0, 50), slice(None), slice(REST, None))
WINDOW = 50


def frozen(stream: Stream, outcomes: Sequence[int]) -> Iterator[NDArray[np.bool_]]:
    """Verdicts slip on the grasps from `REST` on, after so many outcomes and no more."""
    learner = Learner(stream.features.shape[1])
    rows = list(stream.rows())
    for index, (margin, row, slipped) in enumerate(rows):
        if index in outcomes:
            yield np.array([learner.judge(m, x)[0] > 0.0 for m, x, _ in rows[REST:]])
        learner.learn(learner.judge(margin, row)[1], slipped=bool(slipped))


def f1_and_slips(said: NDArray[np.bool_], slipped: NDArray[np.bool_]) -> tuple[float, float]:
    """F1 of slip, and the share of slips among what is called stable, %."""
    figures = VerdictFigures.of(said, slipped)
    return 100.0 * figures.f1, 100.0 * (figures.slips_among_stable or 0.0)


def worst_window(life: Life) -> float:
    """Largest share of slips, %, among `WINDOW` stable lifts in a row; NaN for fewer."""
    slips = life.stream.slipped[life.stable].astype(float)
    if len(slips) < WINDOW:
        return math.nan
    return float(100.0 * np.convolve(slips, np.full(WINDOW, 1.0 / WINDOW), "valid").max())


def coverage(life: Life, part: slice) -> float:
    """Share, %, of the grasps of a part that held which were called stable."""
    held = ~life.stream.slipped[part]
    return 100.0 * float((life.stable[part] & held).sum()) / max(int(held.sum()), 1)


def learning_lines(streams: Sequence[Stream]) -> Iterator[str]:
    """F1 / slips among stable, means over streams."""
    yield "F1 / slips among stable, %, of grasps from 200 on, frozen after k outcomes"
    for protocol, order, group in _groups(streams):
        found = np.array(
            [
                [f1_and_slips(said, stream.slipped[REST:]) for said in frozen(stream, OUTCOMES)]
                for stream in group
            ]
        ).mean(axis=0)
        cells = [f"k={k} {f1:.1f}/{ss:.1f}" for k, (f1, ss) in zip(OUTCOMES, found, strict=True)]
        yield f"{protocol} {order:16} {'  '.join(cells)}"
    yield "F1 / slips among stable, %, always learning, by grasp; first the network alone"
    for protocol, order, group in _groups(streams):
        alone = [f1_and_slips(stream.margins > 0.0, stream.slipped) for stream in group]
        lives = [live(stream, RiskLimits(), every=True) for stream in group]
        cells = ["alone {:.1f}/{:.1f}".format(*np.mean(alone, axis=0))]
        for first, last in AGES:
            part = slice(first, last)
            found = [
                f1_and_slips(one.p_slip[part] > 0.5, one.stream.slipped[part]) for one in lives
            ]
            f1, ss = np.mean(found, axis=0)
            cells.append(f"{first}..{last or ''} {f1:.1f}/{ss:.1f}")
        yield f"{protocol} {order:16} {'  '.join(cells)}"


def risk_lines(streams: Sequence[Stream]) -> Iterator[str]:
    """What is called stable under a risk, and whether its bound was ever broken."""
    cases = [(RiskLimits(alpha), True) for alpha in ALPHAS]
    cases += [(RiskLimits(alpha, 50, 0.05), False) for alpha in ALPHAS]
    for limits, every in cases:
        which = (
            "every lift told" if every else "warm-up 50, stable lifts and 5 % of the others told"
        )
        yield f"max_slip_when_stable {limits.max_slip_when_stable:g}, {which}"
        yield from _risk_rows(streams, limits, every=every)
    for name, spoil in (("inverted from the middle on", _inverted), ("wrong by 3 %", _wrong)):
        yield f"max_slip_when_stable 0.05, every lift told, outcomes {name}"
        spoilt = [dataclasses.replace(one, slipped=spoil(one.slipped)) for one in streams]
        yield from _risk_rows(spoilt, RiskLimits(0.05), every=True)


def _inverted(slipped: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return slipped ^ (np.arange(len(slipped)) >= len(slipped) // 2)


def _wrong(slipped: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return slipped ^ (np.random.default_rng(0).random(len(slipped)) < 0.03)


def _risk_rows(streams: Sequence[Stream], limits: RiskLimits, *, every: bool) -> Iterator[str]:
    for protocol, order, group in _groups(streams):
        lives = [live(stream, limits, every=every) for stream in group]
        lifts = sum(int(one.stable.sum()) for one in lives)
        slips = sum(int((one.stable & one.stream.slipped).sum()) for one in lives)
        windows = np.array([worst_window(one) for one in lives])
        told = ~np.isnan(windows)
        worst = f"{windows[told].mean():.0f}/{windows[told].max():.0f}" if told.any() else "-"
        young, whole, rest = (np.mean([coverage(one, part) for one in lives]) for part in PARTS)
        asked = 100.0 * np.mean([one.supervised.mean() for one in lives])
        yield (
            f"{protocol} {order:16} slips among stable {100.0 * slips / max(lifts, 1):4.1f} %, "
            f"coverage first 50 {young:2.0f}, whole {whole:2.0f}, from 200 {rest:2.0f} %, "
            f"worst {WINDOW} mean/max {worst} %, "
            f"supervised {asked:2.0f} %, excess {max(one.excess for one in lives):4.1f}, "
            f"bound broken on {sum(not one.within for one in lives)} of {len(lives)}"
        )


def _groups(streams: Sequence[Stream]) -> Iterator[tuple[str, str, list[Stream]]]:
    for protocol in sorted({stream.protocol for stream in streams}):
        for order in ORDERS:
            group = [one for one in streams if (one.protocol, one.order) == (protocol, order)]
            yield protocol, order, group


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.trust", description=__doc__)
    parser.add_argument("data", type=Path, metavar="DIR")
    parser.add_argument("--quick", action="store_true", help="one seed, three epochs")
    options = parser.parse_args()
    plan = Plan(1 if options.quick else 2, epochs=3 if options.quick else None)
    found = list(streams(read_all(options.data / "bts3"), plan))
    for line in itertools.chain(learning_lines(found), risk_lines(found)):
        print(line, flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
