"""How the error of a recipe is measured. `cv` is the paper's: 10-fold, stratified, on *Whole*."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import accuracy_score, precision_recall_fscore_support, roc_auc_score
from sklearn.model_selection import StratifiedKFold

from models.contract import MeasuredError
from models.training.calibration import p_slip
from models.training.networks import NetworkConfig
from models.training.recipe import Progress, Recipe, logits, train


class TooFewGraspsError(ValueError):
    """The data cannot be cut into that many folds: take fewer folds or more data."""


@dataclass(frozen=True, slots=True)
class Scores:
    """Figures of one test set as fractions, slip positive."""

    grasps: int
    accuracy: float
    precision: float
    recall: float
    f1: float
    auc: float
    """Area under the ROC curve: does it rank, whatever the threshold."""


@dataclass(frozen=True, slots=True, eq=False)
class CrossValidation:
    """Result of the `cv` protocol."""

    folds: tuple[Scores, ...]
    fold_of: NDArray[np.int64]
    """Shape (N,): the fold in which each grasp was left out."""
    logits: NDArray[np.float64]
    """Shape (N, 2), order (stable, slip): of each grasp by the network that never saw it."""

    def mean_std(self, name: str) -> tuple[float, float]:
        """Mean and (population) standard deviation of one of the scores over the folds."""
        values = np.array([getattr(fold, name) for fold in self.folds])
        return float(values.mean()), float(values.std())

    def measured(self) -> MeasuredError:
        """The figures that go into a model's contract."""
        f1_mean, f1_std = self.mean_std("f1")
        accuracy_mean, accuracy_std = self.mean_std("accuracy")
        return MeasuredError("cv", len(self.folds), f1_mean, f1_std, accuracy_mean, accuracy_std)


@dataclass(frozen=True, slots=True)
class Repeatability:
    """How much of a training is the seed's and how much the machine's, on the first fold."""

    same_seed_same_logits: bool
    """Training again with the same seed and threads gave bit-identical logits."""
    one_thread_largest_difference: float
    """Of a slip probability, when trained on one thread."""
    one_thread_f1_change: float


def score(values: NDArray[np.float64], slipped: NDArray[np.bool_]) -> Scores:
    """Figures of logits (N, 2) against labels (N,) that hold both classes."""
    margin = values[:, 1] - values[:, 0]
    verdict = margin > 0.0
    precision, recall, f1, _ = precision_recall_fscore_support(
        slipped, verdict, average="binary", zero_division=0.0
    )
    return Scores(
        grasps=len(slipped),
        accuracy=float(accuracy_score(slipped, verdict)),
        precision=float(precision),
        recall=float(recall),
        f1=float(f1),
        auc=float(roc_auc_score(slipped, margin)),
    )


def folds_of(slipped: NDArray[np.bool_], folds: int, seed: int) -> NDArray[np.int64]:
    """Fold of each grasp, shape (N,): stratified, shuffled with the seed.

    Raises `TooFewGraspsError` if a class has fewer grasps than there are folds.
    """
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
    """Seed of the training of one fold: another start for each, so the spread holds that too."""
    return int(np.random.SeedSequence([seed, fold]).generate_state(1)[0])


def cross_validate(
    config: NetworkConfig,
    images: NDArray[np.float32],
    slipped: NDArray[np.bool_],
    recipe: Recipe,
    *,
    folds: int,
    seed: int,
    on_epoch: Progress | None = None,
) -> CrossValidation:
    """Train `folds` networks, each judged on what it never saw. Raises `TooFewGraspsError`."""
    fold_of = folds_of(slipped, folds, seed)
    out_of_fold = np.empty((len(slipped), 2))
    scores = []
    for fold in range(folds):
        test = fold_of == fold
        network = train(
            config,
            images[~test],
            slipped[~test],
            recipe,
            seed=fold_seed(seed, fold),
            on_epoch=on_epoch,
        )
        out_of_fold[test] = logits(network, images[test], recipe.threads)
        scores.append(score(out_of_fold[test], slipped[test]))
    return CrossValidation(tuple(scores), fold_of, out_of_fold)


def measure_repeatability(
    config: NetworkConfig,
    images: NDArray[np.float32],
    slipped: NDArray[np.bool_],
    recipe: Recipe,
    validation: CrossValidation,
    *,
    seed: int,
    on_epoch: Progress | None = None,
) -> Repeatability:
    """Train the first fold of a cross-validation again, then once more on a single thread."""
    test = validation.fold_of == 0
    first = validation.logits[test]

    def again(threads: int) -> NDArray[np.float64]:
        network = train(
            config,
            images[~test],
            slipped[~test],
            replace(recipe, threads=threads),
            seed=fold_seed(seed, 0),
            on_epoch=on_epoch,
        )
        return logits(network, images[test], threads)

    same, alone = again(recipe.threads), again(1)
    return Repeatability(
        same_seed_same_logits=bool(np.array_equal(first, same)),
        one_thread_largest_difference=float(np.abs(p_slip(first) - p_slip(alone)).max()),
        one_thread_f1_change=score(alone, slipped[test]).f1 - validation.folds[0].f1,
    )
