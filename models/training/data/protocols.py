"""Evaluation protocols: the grasps for training, and the grasps that are judged.

`cv`, `objects` and `objects-whole` also use lab tables, which are not published; without any
published table they use only these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, get_args

import numpy as np

from graspd.models.bts3 import NEW_SESSION, WHOLE
from graspd.models.training.arrays import Ints
from graspd.models.training.data.datasets import Grasps, first_readings, lab_table_names

EvalProtocol = Literal["cv", "unknown", "objects", "objects-whole", "session", "days"]
PROTOCOLS: tuple[EvalProtocol, ...] = get_args(EvalProtocol)
ABOUT: dict[EvalProtocol, str] = {
    "cv": "known objects: stratified folds of palm_down + palm_side (the paper's)",
    "unknown": "the paper's 8 objects left out of palm_down + palm_side",
    "objects": "objects left out in groups, palm_down + palm_side + palm_45",
    "objects-whole": "objects left out in groups, palm_down + palm_side",
    "session": "palm_45 by palm_down + palm_side, its objects left out in groups",
    "days": "tables by others (A: palm_45 by palm_down + palm_side; B: palm_down and palm_side by "
    "palm_45; C: each of these by the other and palm_45), their objects left out in groups",
}
UNKNOWN_OBJECTS = frozenset(
    ("juice", "aquarius", "green_gel", "tennis", "football", "milk", "metal_pen_case", "train")
)
"""Objects that the authors' notebooks leave out of the training: 485 of 2549 grasps. The paper's
text counts 6 objects."""
FOLDS = 10
DAYS = (
    ("A", WHOLE, (NEW_SESSION,)),
    ("B", (NEW_SESSION,), WHOLE),
    ("C", (NEW_SESSION, WHOLE[1]), WHOLE[:1]),
    ("C", (NEW_SESSION, WHOLE[0]), WHOLE[1:]),
)
"""Streams of the protocol `days`: name, training tables, judged tables."""
DAYS_FOLDS = 4
"""Most folds of objects in `days`; with more, no session would have hundreds of grasps."""


class TooFewGraspsError(ValueError):
    """The data lack a table, or are too few for the folds: use fewer folds or more data."""


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """Grasps for a training, and grasps that test it: row indices, ascending."""

    name: str
    train: Ints
    test: Ints
    calibration: Ints | None = None
    """Rows of the judged session, of other objects, to calibrate it; None except in `session`."""


def splits(protocol: EvalProtocol, grasps: Grasps, seed: int, folds: int = FOLDS) -> list[Split]:
    """Return a split for each fold of a protocol; `unknown` has one, `days` at most `DAYS_FOLDS`
    for each of `DAYS`.

    Raises `TooFewGraspsError` if the data lack a table, objects or grasps.
    """
    return _MAKERS[protocol](grasps, seed, folds)


def near_copies(grasps: Grasps) -> int:
    """Return the number of rows of lab tables that nearly repeat another row."""
    _, rows = np.unique(grasp_of(grasps), return_counts=True)
    return int(rows[rows > 1].sum())


def grasp_of(grasps: Grasps) -> Ints:
    """Return for each row the index of the first row of the same grasp, shape (N,).

    Rows of lab tables that nearly repeat each other are readings of one grasp; each row of a
    published table is a grasp of its own.
    """
    number = np.arange(len(grasps))
    rows = grasps.rows_of(lab_table_names(grasps.files))
    number[rows] = rows[first_readings(grasps.counts[rows])]
    return number


def fewest_grasps(grasps: Grasps) -> int:
    """Return the number of grasps with the rarer label; all readings of a grasp count as one."""
    return _fewest(grasps, grasp_of(grasps))


def _fewest(grasps: Grasps, grasp: Ints) -> int:
    first = np.unique(grasp, return_index=True)[1]
    slips = int(grasps.slipped[first].sum())
    return min(slips, len(first) - slips)


def folds_of(grasps: Grasps, folds: int, seed: int) -> Ints:
    """Return the fold of each row, shape (N,): stratified, shuffled with the seed.

    All readings of a grasp are in the same fold. Raises `TooFewGraspsError` if a class has fewer
    grasps than folds.
    """
    from sklearn.model_selection import StratifiedGroupKFold, StratifiedKFold

    slipped, grasp = grasps.slipped, grasp_of(grasps)
    fewest = _fewest(grasps, grasp)
    if fewest < folds:
        raise TooFewGraspsError(
            f"{folds} folds need {folds} grasps of each class, one has {fewest}"
        )
    places = np.zeros((len(slipped), 1))
    if len(set(grasp.tolist())) == len(grasps):
        made = StratifiedKFold(folds, shuffle=True, random_state=seed).split(places, slipped)
    else:
        grouped = StratifiedGroupKFold(folds, shuffle=True, random_state=seed)
        made = grouped.split(places, slipped, grasp)
    fold_of = np.empty(len(slipped), dtype=np.int64)
    for fold, (_, test) in enumerate(made):
        fold_of[test] = fold
    return fold_of


def fold_seed(seed: int, fold: int) -> int:
    """Return the seed of a fold's training, different for each fold and split seed."""
    return int(np.random.SeedSequence([seed, fold]).generate_state(1)[0])


def object_folds(objects: Sequence[str], folds: int, seed: int) -> Ints:
    """Return the fold of each grasp, shape (N,); all grasps of an object share a fold.

    Raises `TooFewGraspsError` if there are fewer objects than folds.
    """
    names = sorted(set(objects))
    if len(names) < folds:
        raise TooFewGraspsError(f"{folds} folds need {folds} objects, there are {len(names)}")
    dealt = np.random.default_rng(seed).permutation(len(names)) % folds
    fold_of_object = dict(zip(names, dealt.tolist(), strict=True))
    return np.array([fold_of_object[name] for name in objects], dtype=np.int64)


def _stratified(grasps: Grasps, seed: int, folds: int) -> list[Split]:
    rows = _rows(grasps, *WHOLE, with_lab=True)
    return _leave_out(rows, folds_of(grasps.rows(rows), folds, seed), folds)


def _grouped(tables: tuple[str, ...], grasps: Grasps, seed: int, folds: int) -> list[Split]:
    rows = _rows(grasps, *tables, with_lab=True)
    return _leave_out(rows, _object_folds(grasps, rows, folds, seed), folds)


def _unknown(grasps: Grasps, _seed: int, _folds: int) -> list[Split]:
    rows = _rows(grasps, *WHOLE)
    out = np.array([grasps.objects[row] in UNKNOWN_OBJECTS for row in rows])
    if not out.any() or out.all():
        raise TooFewGraspsError("the data lack the objects that the paper leaves out")
    return [Split("unknown objects", rows[~out], rows[out])]


def _session(grasps: Grasps, seed: int, folds: int) -> list[Split]:
    """Return a split for each fold of objects: test in `palm_45`, train on others in `WHOLE`."""
    whole, later = _rows(grasps, *WHOLE), _rows(grasps, NEW_SESSION)
    fold_of = _object_folds(grasps, np.concatenate((whole, later)), folds, seed)
    of_whole, of_later = fold_of[: len(whole)], fold_of[len(whole) :]
    made = []
    for fold in range(folds):
        test = later[of_later == fold]
        if not len(test):
            raise TooFewGraspsError(f"{NEW_SESSION} has no grasp of the objects of fold {fold}")
        name = f"fold {fold}"
        made.append(Split(name, whole[of_whole != fold], test, later[of_later != fold]))
    return made


def _days(grasps: Grasps, seed: int, folds: int) -> list[Split]:
    """Return a split for each of `DAYS` and fold of objects, which the training leaves out."""
    folds = min(folds, DAYS_FOLDS)
    every = _rows(grasps, *WHOLE, NEW_SESSION)
    fold_of = np.full(len(grasps), -1)
    fold_of[every] = _object_folds(grasps, every, folds, seed)
    made = []
    for day, training, judged in DAYS:
        train, test = _rows(grasps, *training), _rows(grasps, *judged)
        for fold in range(folds):
            inside = test[fold_of[test] == fold]
            if not len(inside):
                raise TooFewGraspsError(f"{judged[0]} has no grasp of the objects of fold {fold}")
            made.append(Split(f"{day}, fold {fold}", train[fold_of[train] != fold], inside))
    return made


_MAKERS: dict[EvalProtocol, Callable[[Grasps, int, int], list[Split]]] = {
    "cv": _stratified,
    "unknown": _unknown,
    "objects": partial(_grouped, (*WHOLE, NEW_SESSION)),
    "objects-whole": partial(_grouped, WHOLE),
    "session": _session,
    "days": _days,
}


def _rows(grasps: Grasps, *tables: str, with_lab: bool = False) -> Ints:
    """Return the rows of these tables. Raises `TooFewGraspsError` if one is missing.

    `with_lab`: add lab tables; if there are no others, return their rows alone."""
    names = [file.name for file in grasps.files]
    if with_lab:
        lab = lab_table_names(grasps.files)
        tables = lab if len(lab) == len(names) else (*tables, *lab)
    for table in tables:
        if table not in names:
            raise TooFewGraspsError(f"the data lack {table}")
    return grasps.rows_of(tables)


def _object_folds(grasps: Grasps, rows: Ints, folds: int, seed: int) -> Ints:
    return object_folds([grasps.objects[row] for row in rows], folds, seed)


def _leave_out(rows: Ints, fold_of: Ints, folds: int) -> list[Split]:
    return [
        Split(f"fold {fold}", rows[fold_of != fold], rows[fold_of == fold]) for fold in range(folds)
    ]
