"""How grasps are dealt out to folds, and which seed each training gets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from models.training.arrays import Bools, Ints


class TooFewGraspsError(ValueError):
    """The data cannot be cut into that many folds: take fewer folds or more data."""


def folds_of(slipped: Bools, folds: int, seed: int) -> Ints:
    """Fold of each grasp, shape (N,): stratified, shuffled with the seed.

    Raises `TooFewGraspsError` if a class has fewer grasps than there are folds.
    """
    from sklearn.model_selection import StratifiedKFold

    fewest = min(int(slipped.sum()), int((~slipped).sum()))
    if fewest < folds:
        raise TooFewGraspsError(
            f"{folds} folds need {folds} grasps of each class, one has {fewest}"
        )
    split = StratifiedKFold(folds, shuffle=True, random_state=seed)
    fold_of = np.empty(len(slipped), dtype=np.int64)
    for fold, (_, test) in enumerate(split.split(np.zeros((len(slipped), 1)), slipped)):
        fold_of[test] = fold
    return fold_of


def fold_seed(seed: int, fold: int) -> int:
    """Seed of the training of one fold; a different one for each fold and each split seed."""
    return int(np.random.SeedSequence([seed, fold]).generate_state(1)[0])


def object_folds(objects: Sequence[str], folds: int, seed: int) -> Ints:
    """Fold of each grasp, shape (N,): objects are dealt to folds by the seed, each to one.

    Raises `TooFewGraspsError` if there are fewer objects than folds.
    """
    names = sorted(set(objects))
    if len(names) < folds:
        raise TooFewGraspsError(f"{folds} folds need {folds} objects, there are {len(names)}")
    dealt = np.random.default_rng(seed).permutation(len(names)) % folds
    fold_of_object = dict(zip(names, dealt.tolist(), strict=True))
    return np.array([fold_of_object[name] for name in objects], dtype=np.int64)
