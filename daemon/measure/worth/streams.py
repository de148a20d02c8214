"""Grasps of another day, as they come: what networks say that saw neither their objects nor pose.

The days are those of the protocol `days`. The session's statistics run from nothing as in the
daemon, but that slips weigh as much as others; every grasp is judged, none refused.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.process.text import progress
from models.inputs import SessionBuilder, builder, raw_features
from models.training.data.datasets import Grasps
from models.training.data.protocols import DAYS, DAYS_FOLDS, fold_seed, object_folds
from models.training.fitting.trained import train
from models.training.systems.registry import SYSTEMS
from models.training.systems.system import SessionFeatures, System, digest, with_recipes

OWN, PUBLISHED = "small-session", "cnn1"
"""Systems that judge: graspd's default, and the published network on the plain image."""
RANDOM, BY_OBJECT = "random", "object by object"
ORDERS: Final = (RANDOM, BY_OBJECT)
DRAWS: Final = 2
"""Streams of each table, fold and order."""

log = logging.getLogger("graspd")


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """The grasps of one table and fold, as they come."""

    protocol: str
    table: str
    order: str
    margins: NDArray[np.float64]
    """Log-odds of slip (N,) as graspd's network says them."""
    features: NDArray[np.float32]
    """What it was given, shape (N, 78)."""
    published: NDArray[np.float64]
    """Log-odds of slip (N,) as the published network says them."""
    slipped: NDArray[np.bool_]

    def rows(self) -> Iterator[tuple[float, NDArray[np.float32], bool]]:
        """Margin, features and outcome of each grasp."""
        yield from zip(self.margins.tolist(), self.features, self.slipped.tolist(), strict=True)


@dataclass(frozen=True, slots=True)
class Plan:
    """How much is trained."""

    seeds: int
    """Splits of the objects, and trainings of each fold."""
    folds: int = DAYS_FOLDS
    """Of each split, that are judged."""
    epochs: int | None = None
    """Instead of the systems' own: does it run?"""
    cache: Path | None = None
    """Folder of what networks said: they are not trained again."""


def streams(grasps: Grasps, plan: Plan) -> Iterator[Stream]:
    """All streams of the three tables."""
    objects = np.array(grasps.objects)
    names = np.array([file.name for file in grasps.files])[grasps.table_of]
    for seed, fold in itertools.product(range(plan.seeds), range(plan.folds)):
        fold_of = object_folds(grasps.objects, DAYS_FOLDS, seed)
        for protocol, training, tables in DAYS:
            progress(
                f"seed {seed + 1} of {plan.seeds}, fold {fold + 1} of {plan.folds}, {protocol}"
            )
            seen = grasps.rows(np.flatnonzero(np.isin(names, training) & (fold_of != fold)))
            random = np.random.default_rng([seed, fold])
            kinds, rows = [], []
            for table, order, _ in itertools.product(tables, ORDERS, range(DRAWS)):
                inside = np.flatnonzero((names == table) & (fold_of == fold))
                kinds.append((table, order))
                rows.append(_ordered(inside, objects, order, random))
            counts = [grasps.counts[chosen] for chosen in rows]
            own = _said(OWN, seen, counts, fold_seed(seed, fold), plan)
            published = _said(PUBLISHED, seen, counts, fold_seed(seed, fold), plan)
            for (table, order), chosen, said, theirs in zip(
                kinds, rows, own, published, strict=True
            ):
                slipped = grasps.slipped[chosen]
                yield Stream(protocol, table, order, *said, theirs[0], slipped)


Said = tuple[NDArray[np.float64], NDArray[np.float32]]
"""Margins (N,), and what the network was given (N, ...), empty of one without a session."""


def _ordered(
    rows: NDArray[np.int64], objects: NDArray[np.str_], order: str, random: np.random.Generator
) -> NDArray[np.int64]:
    mixed = random.permutation(rows)
    if order == RANDOM:
        return mixed
    own = objects[mixed]
    return np.concatenate([mixed[own == name] for name in random.permutation(np.unique(own))])


def _said(
    name: str, seen: Grasps, several: Sequence[NDArray[np.uint16]], seed: int, plan: Plan
) -> list[Said]:
    """What a system says of streams of counts (N, 3, 24), from the cache where it is there."""
    system = SYSTEMS[name]
    if plan.epochs is not None:
        system = with_recipes(system, epochs=plan.epochs)
    if plan.cache is None:
        return judged(system, seen, several, seed)
    asked = hashlib.sha256(json.dumps([digest(system), seen.digest(), seed]).encode())
    for counts in several:
        asked.update(counts.tobytes())
    path = plan.cache / f"{name}.{asked.hexdigest()[:24]}.npz"
    if not path.exists():
        found = judged(system, seen, several, seed)
        plan.cache.mkdir(parents=True, exist_ok=True)
        parts = dict(zip(_names(several), itertools.chain(*found), strict=True))
        np.savez(path, **parts)  # type: ignore[arg-type]
        log.info("%s: trained", path.name)
    with np.load(path) as kept:
        values = [kept[part] for part in _names(several)]
    return list(zip(values[::2], values[1::2], strict=True))


def _names(several: Sequence[NDArray[np.uint16]]) -> list[str]:
    return [f"{kind}{index}" for index in range(len(several)) for kind in ("margins", "inputs")]


def judged(
    system: System, seen: Grasps, several: Sequence[NDArray[np.uint16]], seed: int
) -> list[Said]:
    """What a system that is trained on the grasps `seen` says of streams of counts (N, 3, 24)."""
    trained, takes = train(system, seen, seed), system.input
    found = []
    for counts in several:
        if trained.standards is not None and isinstance(takes, SessionFeatures):
            session = trained.standards.statistics()
            builds = SessionBuilder(counts.shape[1], takes.clip)
            inputs = np.empty((len(counts), *builds.shape), np.float32)
            for row, reading in zip(inputs, counts, strict=True):
                builds.use(session.mean, session.spread)
                builds.build(reading, row)
                session.observe(raw_features(reading))
            found.append((trained.fitted.margins(inputs), inputs))
        elif not isinstance(takes, SessionFeatures):
            images, _ = builder(takes, counts.shape[1]).build_batch(counts)
            found.append((trained.fitted.margins(images), np.empty((0, 0), np.float32)))
    return found
