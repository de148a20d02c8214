"""Streams of another day through a session network, the learner and the risk: what they are worth.

`python -m tests.bench.trust DIR --cache FOLDER` prints the tables; DIR is the folder that holds
`bts3/`. Every stream has objects that its network was not trained on, in a pose that it was not
trained on; the session's statistics run as in the daemon and every grasp is judged, none refused.
A: palm_down and palm_side, then palm_45. B: palm_45, then palm_down or palm_side. C: palm_45 and
one of the others, then the other one.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import itertools
import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.trust.learner import Learner, sigmoid
from daemon.trust.ledger import GRASPS_MAX, GraspId
from daemon.trust.risk import Permission, RiskLimits
from daemon.trust.trust import Trust, encode
from models.inputs import SessionBuilder, raw_features
from models.training.data.datasets import Grasps, read_all
from models.training.data.folds import fold_seed, object_folds

FOLDS = 4
CLIP = 3.0
"""Of the session features, as the zoo's models have it."""
SPLITS = (
    ("A", ("palm_down", "palm_side"), ("palm_45",)),
    ("B", ("palm_45",), ("palm_down", "palm_side")),
    ("C", ("palm_45", "palm_down"), ("palm_side",)),
    ("C", ("palm_45", "palm_side"), ("palm_down",)),
)
"""Protocol, tables of the training, tables of a stream each."""
ORDERS = ("random", "object by object")
OUTCOMES = (0, 5, 10, 20, 50, 100, 200)
REST = 200
"""Grasps from here on are what frozen learners are compared on."""
AGES = ((0, 50), (50, 100), (100, 200), (200, None))
ALPHAS = (0.02, 0.05, 0.1)
PARTS = (slice(0, 50), slice(None), slice(REST, None))
WINDOW = 50


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """The grasps of one table and fold, as they come."""

    protocol: str
    table: str
    order: str
    margins: NDArray[np.float64]
    """Log-odds of slip (N,) as the network says them."""
    features: NDArray[np.float32]
    """What the network was given, shape (N, 78)."""
    slipped: NDArray[np.bool_]

    def rows(self) -> Iterator[tuple[float, NDArray[np.float32], bool]]:
        """Margin, features and outcome of each grasp."""
        yield from zip(self.margins.tolist(), self.features, self.slipped.tolist(), strict=True)


def trained_margins(
    training: Grasps, streams: list[NDArray[np.uint16]], seed: int, epochs: int
) -> list[tuple[NDArray[np.float64], NDArray[np.float32]]]:
    """Margins (N,) and features (N, 78) of streams of counts by `small-session`, so trained."""
    from models.training.fitting.fit import fit
    from models.training.fitting.standards import TrainingStandards
    from models.training.systems.registry import SYSTEMS
    from models.training.systems.system import with_recipes

    table_of = training.table_of
    standards = TrainingStandards.of(raw_features(training.counts), table_of)
    inputs = standards.apply(raw_features(training.counts), table_of, CLIP)
    system = with_recipes(SYSTEMS["small-session"], epochs=epochs)
    network = fit(system, inputs, training.slipped, seed=seed)
    found = []
    for counts in streams:
        session = standards.statistics()
        builder = SessionBuilder(counts.shape[1], CLIP)
        features = np.empty((len(counts), *builder.shape), np.float32)
        for row, reading in zip(features, counts, strict=True):
            builder.use(session.mean, session.spread)
            builder.build(reading, row)
            session.observe(raw_features(reading))
        found.append((network.margins(features), features))
    return found


def all_streams(folder: Path, cache: Path, seeds: int, epochs: int) -> Iterator[Stream]:
    """All streams; networks that were trained before are not trained again."""
    grasps = read_all(folder / "bts3")
    objects = np.array(grasps.objects)
    names = np.array([file.name for file in grasps.files])[grasps.table_of]
    for seed in range(seeds):
        fold_of = object_folds(grasps.objects, FOLDS, seed)
        for fold in range(FOLDS):
            for protocol, training, tests in SPLITS:
                train = np.flatnonzero(np.isin(names, training) & (fold_of != fold))
                random = np.random.default_rng([seed, fold])
                kinds, rows = [], []
                for table, order, _ in itertools.product(tests, ORDERS, range(2)):
                    inside = np.flatnonzero((names == table) & (fold_of == fold))
                    kinds.append((table, order))
                    rows.append(_ordered(inside, objects, order, random))
                scores = _scores(grasps, train, rows, cache, fold_seed(seed, fold), epochs)
                for (table, order), chosen, score in zip(kinds, rows, scores, strict=True):
                    yield Stream(protocol, table, order, *score, grasps.slipped[chosen])


def _ordered(
    rows: NDArray[np.int64], objects: NDArray[np.str_], order: str, random: np.random.Generator
) -> NDArray[np.int64]:
    mixed = random.permutation(rows)
    if order == "random":
        return mixed
    own = objects[mixed]
    return np.concatenate([mixed[own == name] for name in random.permutation(np.unique(own))])


def _scores(
    grasps: Grasps,
    train: NDArray[np.int64],
    rows: list[NDArray[np.int64]],
    cache: Path,
    seed: int,
    epochs: int,
) -> list[tuple[NDArray[np.float64], NDArray[np.float32]]]:
    """What `trained_margins` gives, from the cache where it has it."""
    training = grasps.rows(train)
    asked = [training.digest(), seed, epochs, [chosen.tolist() for chosen in rows]]
    key = hashlib.sha256(json.dumps(asked).encode()).hexdigest()[:24]
    path = cache / f"{key}.npz"
    if not path.exists():
        counts = [grasps.counts[chosen] for chosen in rows]
        found = trained_margins(training, counts, seed, epochs)
        cache.mkdir(parents=True, exist_ok=True)
        named: dict[str, Any] = {f"m{i}": margins for i, (margins, _) in enumerate(found)}
        named |= {f"x{i}": features for i, (_, features) in enumerate(found)}
        np.savez(path, **named)
        print(f"trained {path.name}", file=sys.stderr, flush=True)  # noqa: T201
    with np.load(path) as kept:
        return [(kept[f"m{i}"], kept[f"x{i}"]) for i in range(len(rows))]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Life:
    """What was said of a stream's grasps (N,), each after the outcomes of those before it."""

    stream: Stream
    p_slip: NDArray[np.float64]
    stable: NDArray[np.bool_]
    """Which were called stable."""
    supervised: NDArray[np.bool_]
    """Which others were lifted all the same, though only stable ones are."""
    excess: float
    """Most slips among stable lifts at any time beyond the share that is allowed."""
    within: bool
    """Whether they never exceeded the bound."""


def live(stream: Stream, limits: RiskLimits, *, every: bool) -> Life:
    """Judge, lift and tell one grasp after the other; not `every` lift, but those that it asks for.

    Without `every`, the outcomes of other grasps than stable and supervised ones stay unknown.
    """
    trust, number = Trust("bench", stream.features.shape[1], limits), len(stream.slipped)
    p_slip, stable = np.empty(number), np.zeros(number, np.bool_)
    supervised, excess, within = stable.copy(), 0.0, True
    alpha = limits.max_slip_when_stable or 0.0
    for index, (margin, row, slipped) in enumerate(stream.rows()):
        grasp = GraspId(stream.table, index)
        found = trust.judge(grasp, sigmoid(margin), margin, row)
        p_slip[index], supervised[index] = found.p_slip, found.supervised
        stable[index] = found.permission is Permission.ALLOWED and found.p_slip < 0.5
        trust.note(grasp, found, stable=bool(stable[index]))
        if every or stable[index] or found.supervised:
            trust.outcome(grasp, slipped=slipped)
        excess = max(excess, trust.risk.slips - alpha * trust.risk.lifts)
        within &= trust.risk.bound is None or trust.risk.slips <= trust.risk.bound + 1e-9
    return Life(stream, p_slip, stable, supervised & ~stable, excess, within)


def frozen(stream: Stream, outcomes: Sequence[int]) -> Iterator[NDArray[np.bool_]]:
    """Verdicts slip on the grasps from `REST` on, after so many outcomes and no more."""
    learner = Learner(stream.features.shape[1])
    features = [learner.features(margin, row) for margin, row, _ in stream.rows()]
    for index, (one, slipped) in enumerate(zip(features, stream.slipped, strict=True)):
        if index in outcomes:
            yield np.array([learner.log_odds(rest) > 0.0 for rest in features[REST:]])
        learner.learn(one, slipped=bool(slipped))


def f1_and_slips(said: NDArray[np.bool_], slipped: NDArray[np.bool_]) -> tuple[float, float]:
    """F1 of slip, and the share of slips among what is called stable, %."""
    hits, missed = int((said & slipped).sum()), int((~said & slipped).sum())
    f1 = 2.0 * hits / max(2 * hits + missed + int((said & ~slipped).sum()), 1)
    return 100.0 * f1, 100.0 * missed / max(int((~said).sum()), 1)


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


def endurance_lines(outcomes: int, width: int) -> Iterator[str]:
    """So many outcomes: at the clip, then constant and contradicting, then real variety."""
    learner, random = Learner(width), np.random.default_rng(0)
    for kind in ("at the clip", "constant, contradicting", "random"):
        least = most = learner.log_odds(learner.features(0.0, np.zeros(width)))
        rows = random.normal(0.0, 1.0, (1000, width)).clip(-CLIP, CLIP)
        if kind != "random":
            rows = np.sign(rows) * CLIP if kind == "at the clip" else np.full_like(rows, 0.5)
        for index in range(outcomes // 3):
            features = learner.features(30.0 * math.sin(index), rows[index % 1000])
            learner.learn(features, slipped=bool(random.random() < 0.5))
            said = learner.log_odds(features)
            least, most = min(least, said), max(most, said)
        Learner(width).restore(learner.state())  # raises for what is not positive definite
        covariance = np.frombuffer(learner.state().covariance).reshape(width + 2, width + 2)
        values = np.linalg.eigvalsh(covariance)
        yield (
            f"{outcomes // 3} outcomes, {kind}: log-odds {least:.1f}..{most:.1f}, "
            f"eigenvalues {values[0]:.1e}..{values[-1]:.1e}"
        )


def cost_lines(width: int) -> Iterator[str]:
    """What a judged grasp and an outcome take, and the largest state."""
    trust, random = Trust("bench", width, RiskLimits(0.05)), np.random.default_rng(0)
    rows = random.normal(0.0, 1.0, (3000, width)).clip(-CLIP, CLIP).astype(np.float32)
    judged, told = [], []
    for index, row in enumerate(rows):
        grasp, began = GraspId("0" * 32, index), time.perf_counter_ns()
        found = trust.judge(grasp, 0.5, 0.3, row)
        trust.note(grasp, found, stable=found.permission is Permission.ALLOWED)
        said = time.perf_counter_ns()
        trust.outcome(grasp, slipped=bool(row[0] > 0.0))
        judged.append(said - began)
        told.append(time.perf_counter_ns() - said)
    for index, row in enumerate(rows[:GRASPS_MAX]):
        grasp = GraspId("1" * 32, index)
        trust.note(grasp, trust.judge(grasp, 0.5, 0.3, row), stable=False)
    for name, took in (("judge and note", judged), ("outcome", told)):
        p50, p99 = np.percentile(took, (50, 99)) / 1e3
        yield f"{name}: p50 {p50:.1f}, p99 {p99:.1f} us"
    yield f"largest state: {len(encode(trust.state())) / 1024:.0f} KiB"


def _groups(streams: Sequence[Stream]) -> Iterator[tuple[str, str, list[Stream]]]:
    for protocol in sorted({stream.protocol for stream in streams}):
        for order in ORDERS:
            group = [one for one in streams if (one.protocol, one.order) == (protocol, order)]
            yield protocol, order, group


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.trust", description=__doc__)
    parser.add_argument("data", type=Path, metavar="DIR")
    parser.add_argument("--cache", type=Path, required=True, help="folder for what is scored")
    parser.add_argument("--quick", action="store_true", help="one seed, three epochs")
    parser.add_argument("--outcomes", type=int, default=1_000_000, help="of the endurance run")
    options = parser.parse_args()
    seeds, epochs = (1, 3) if options.quick else (2, 40)
    found = list(all_streams(options.data, options.cache, seeds, epochs))
    width = found[0].features.shape[1]
    lines = (
        *(cost_lines(width), learning_lines(found), risk_lines(found)),
        endurance_lines(options.outcomes, width),
    )
    for line in itertools.chain(*lines):
        print(line, flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
