"""What a session model refuses, and what poison does to a session, on days it was not trained on.

`python -m tests.bench.novelty DIR` prints two tables; DIR is the folder that holds `bts3/`. The
streams are those of `graspd evaluate --protocol days`, in random order, judged by what a test holds
to the daemon. Nonsense is shown to a calibrated session that does not learn from it. Poison comes
before the stream: what counts is how many of the stream's slips are called stable after it. It is
`told` where the outcomes of those that were called stable are known.
"""

from __future__ import annotations

import argparse
import itertools
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.trust.learner import Learner
from models.training.arrays import Bools, Ints
from models.training.data.datasets import COUNT_MAX, Grasps, read_all
from models.training.data.protocols import DAYS, DAYS_FOLDS, fold_seed, splits
from models.training.evaluating.days import CALIBRATED_FROM, SessionDay
from models.training.fitting.trained import Trained, train
from models.training.systems.registry import SYSTEMS

Counts = NDArray[np.uint16]
EVERY = 4
"""One grasp of so many is followed by a reading of each kind of nonsense."""
FIRST = 100
"""Grasps of other objects of the day, before the slips."""
SLIPS = (300, 900)
REPEATS, NOISE_COUNTS = 50, 5.0
ORDERS = tuple(itertools.permutations(range(3)))[1:]


def nonsense(grasp: Counts, day: Counts, random: np.random.Generator) -> dict[str, Counts]:
    """Readings that are no grasps, by kind, from one grasp and all of its day (N, 3, 24)."""
    low, high = day.min(axis=0), day.max(axis=0)
    made = {
        "each electrode from another grasp": random.permuted(day, axis=0)[0],
        "uniform in 0..4095": random.integers(0, COUNT_MAX, grasp.shape, endpoint=True),
        "uniform in each electrode's range": random.integers(low, high, endpoint=True),
        "middle of the ranges, with noise": (low.astype(float) + high) / 2
        + random.normal(0.0, 3.5, grasp.shape),
        "fingers exchanged": grasp[list(ORDERS[random.integers(len(ORDERS))])],
    }
    for offset in (400, -400):
        moved = grasp.astype(float)
        moved[random.integers(len(grasp))] += offset
        made[f"one finger {offset:+} counts"] = np.clip(moved, 0.0, COUNT_MAX)
    return {kind: reading.astype(np.uint16) for kind, reading in made.items()}


def watch(trained: Trained, stream: Counts, seed: int) -> tuple[Bools, dict[str, list[bool]]]:
    """Which grasps (N,) of a stream are refused, and which readings of each kind of nonsense."""
    day, random = SessionDay(trained), np.random.default_rng(seed)
    refused, caught = np.empty(len(stream), np.bool_), defaultdict[str, list[bool]](list)
    for index, grasp in enumerate(stream):
        if day.session.grasps >= CALIBRATED_FROM and index % EVERY == 0:
            for kind, reading in nonsense(grasp, stream, random).items():
                caught[kind].append(not day.look(reading)[1])
        refused[index] = day.judge(grasp)[1]
    return refused, caught


def stable(trained: Trained, before: Counts, stream: Counts, *, told: bool = False) -> Bools:
    """Which grasps (N,) of a stream are called stable, after what came before it.

    If it is `told`, what came before were slips, and the outcomes of those that were called stable,
    and so lifted, are known.
    """
    day, said = SessionDay(trained), []
    learner = Learner(len(day.inputs))
    for index, reading in enumerate(np.concatenate((before, stream))):
        margin, refused = day.judge(reading)
        log_odds, features = learner.judge(margin, day.inputs)
        said.append(not refused and log_odds <= 0.0)
        if told and said[-1] and index < len(before):
            learner.learn(features, slipped=True)
    return np.array(said[len(before) :])


def poisoned(
    trained: Trained, others: Grasps, stream: Counts, seed: int
) -> Iterator[tuple[str, Bools]]:
    """What is called stable (N,) of a stream, after each poison; `others` are of the same day."""
    random = np.random.default_rng(seed)
    mixed = random.permutation(len(others))
    counts, slipped = others.counts[mixed], others.slipped[mixed]
    first, slips = counts[:FIRST], counts[slipped]
    yield "nothing", stable(trained, first[:0], stream)
    yield f"{FIRST} grasps", stable(trained, first, stream)
    for number in SLIPS:
        again = slips[np.arange(number) % len(slips)]
        before = np.concatenate((first, again))
        yield f"{FIRST} grasps, {number} slips", stable(trained, before, stream)
    first_slips = slips[np.arange(SLIPS[0]) % len(slips)]
    yield f"{SLIPS[0]} slips", stable(trained, first_slips, stream)
    yield f"{SLIPS[0]} slips, told", stable(trained, first_slips, stream, told=True)
    held = counts[:1] + random.normal(0.0, NOISE_COUNTS, (REPEATS, *stream.shape[1:]))
    before = np.clip(held, 0.0, COUNT_MAX).astype(np.uint16)
    yield f"one grasp {REPEATS} times, with noise", stable(trained, before, stream)
    for order in ORDERS:
        name = "fingers " + " ".join(map(str, order))
        yield f"{name}, from the first grasp", stable(trained, first[:0], stream[:, list(order)])


def lines(grasps: Grasps, name: str, folds: int) -> Iterator[str]:
    """Both tables, by stream."""
    refused, slips = defaultdict[str, list[Bools]](list), defaultdict[str, list[Bools]](list)
    caught = defaultdict[tuple[str, str], list[bool]](list)
    called = defaultdict[tuple[str, str], list[Bools]](list)
    for index, split in enumerate(splits("days", grasps, 0, DAYS_FOLDS)):
        kind, fold = DAYS[index // DAYS_FOLDS][0], index % DAYS_FOLDS
        if fold >= folds:
            continue
        trained = train(SYSTEMS[name], grasps.rows(split.train), fold_seed(0, index))
        for table in np.unique(grasps.table_of[split.test]).tolist():
            inside = split.test[grasps.table_of[split.test] == table]
            rows = np.random.default_rng(index).permutation(inside)
            stream, where = grasps.counts[rows], f"{kind} {grasps.files[table].name}"
            found, of_nonsense = watch(trained, stream, index)
            refused[where].append(found)
            slips[where].append(grasps.slipped[rows])
            for what, each in of_nonsense.items():
                caught[where, what] += each
            others = grasps.rows(_others(grasps, table, inside))
            for what, said in poisoned(trained, others, stream, index):
                called[where, what].append(said)
    yield f"refused, slips among refused; nonsense that is refused, %: `{name}`, {folds} folds"
    for where, parts in refused.items():
        found, slipped = np.concatenate(parts), np.concatenate(slips[where])
        yield f"{where}: {100 * found.mean():.1f}, {100 * slipped[found].mean():.0f}"
        for (stream_name, what), values in caught.items():
            if stream_name == where:
                yield f"    {what}: {100 * np.mean(values):.1f} of {len(values)}"
    yield "slips called stable; slips among stable; called stable, %, after what came before"
    for (where, what), parts in called.items():
        said, slipped = np.concatenate(parts), np.concatenate(slips[where])
        shares = said[slipped].mean(), slipped[said].sum() / max(said.sum(), 1), said.mean()
        yield f"{where}, {what}: " + "; ".join(f"{100 * share:.1f}" for share in shares)


def _others(grasps: Grasps, table: int, rows: Ints) -> Ints:
    """The other grasps of a table."""
    return np.setdiff1d(np.flatnonzero(grasps.table_of == table), rows)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.novelty", description=__doc__)
    parser.add_argument("data", type=Path, metavar="DIR")
    parser.add_argument("--system", default="small-session", help="a session system")
    parser.add_argument("--folds", type=int, default=DAYS_FOLDS, help="of objects")
    options = parser.parse_args()
    for line in lines(read_all(options.data / "bts3"), options.system, options.folds):
        print(line, flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
