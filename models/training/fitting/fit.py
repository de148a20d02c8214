"""From a system and its training rows to a trained system: one function for every kind."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from sklearn.model_selection import StratifiedKFold

from models.training.arrays import Bools, Floats, Floats32
from models.training.data.augmentation import augment
from models.training.estimators.classical import ClassicalConfig, fit_classical
from models.training.estimators.compression import compressed
from models.training.estimators.networks import AnyNetwork, DenseConfig, NetworkConfig
from models.training.estimators.recipe import AnyRecipe, train_network
from models.training.fitting.calibration import fit_temperature
from models.training.fitting.fitted import (
    Fitted,
    FittedBlend,
    FittedClassical,
    FittedCompressed,
    FittedNetwork,
    FittedStandardised,
)
from models.training.systems.system import BlendConfig, DistilConfig, System, digest


def fit(system: System, inputs: Floats32, slipped: Bools, *, seed: int) -> Fitted:
    """Train a system on inputs (N, *shape), as its input's builder makes them, and labels (N,).

    The same arguments give the same result on the same machine. Raises `ValueError` if the inputs
    do not fit the estimator, or are too few.
    """
    if system.compression is not None:
        whole = _fit_once(replace(system, compression=None), inputs, slipped, seed)
        return FittedCompressed(compressed(whole.margin_graph("given"), system.compression, inputs))
    if system.standardise:
        mean, spread = inputs.mean(axis=0, dtype=np.float64), inputs.std(axis=0, dtype=np.float64)
        # A value that never changes tells nothing: it becomes zero.
        scale = np.divide(1.0, spread, where=spread > 0.0, out=np.zeros_like(spread))
        mean, scale = mean.astype(np.float32), scale.astype(np.float32)
        plain = replace(system, standardise=False)
        return FittedStandardised(
            fit(plain, (inputs - mean) * scale, slipped, seed=seed), mean, scale
        )
    if system.augmentation is not None:
        inputs, slipped = augment(inputs, slipped, system.augmentation, seed)
    match system.estimator:
        case BlendConfig() as blend:
            return _fit_blend(blend, inputs, slipped, seed)
        case DistilConfig() as distil:
            targets = _targets(distil, inputs, slipped, seed)
            return _fit_network(distil.student, system.recipe, inputs, targets, seed)
        case single:
            return _fit_single(single, system.recipe, inputs, slipped, seed)


_last: list[tuple[str, Fitted]] = []
"""The last system that was fitted to be compressed, by a digest of all that it was made from: the
forms of one network follow each other."""


def _fit_once(system: System, inputs: Floats32, slipped: Bools, seed: int) -> Fitted:
    parts = hashlib.sha256(f"{digest(system)} {seed}".encode())
    parts.update(np.ascontiguousarray(inputs).data)
    parts.update(np.ascontiguousarray(slipped).data)
    key = parts.hexdigest()
    if not _last or _last[0][0] != key:
        _last[:] = [(key, fit(system, inputs, slipped, seed=seed))]
    return _last[0][1]


def _fit_single(
    estimator: AnyNetwork | ClassicalConfig,
    recipe: AnyRecipe | None,
    inputs: Floats32,
    slipped: Bools,
    seed: int,
) -> FittedNetwork | FittedClassical:
    if isinstance(estimator, NetworkConfig | DenseConfig):
        return _fit_network(estimator, recipe, inputs, slipped, seed)
    return FittedClassical(fit_classical(estimator, inputs, slipped, seed))


def _fit_network(
    config: AnyNetwork,
    recipe: AnyRecipe | None,
    inputs: Floats32,
    slipped: Bools | Floats,
    seed: int,
) -> FittedNetwork:
    if recipe is None:
        raise ValueError("a network needs a recipe")
    network = train_network(config, inputs, slipped, recipe, seed=seed)
    return FittedNetwork(network, inputs.shape[1:], recipe.threads)


def _fit_blend(blend: BlendConfig, inputs: Floats32, slipped: Bools, seed: int) -> FittedBlend:
    copies = [member for member in blend.members for _ in range(member.copies)]
    total = sum(member.weight for member in blend.members)
    fitted, factors = [], []
    for member, member_seed in zip(copies, _seeds(seed, len(copies)), strict=True):
        judge = _fit_single(member.estimator, member.recipe, inputs, slipped, member_seed)
        spread = float(judge.margins(inputs).std())
        fitted.append(judge)
        # A member that judges all grasps alike has learnt nothing and has no say.
        share = member.weight / (member.copies * total)
        factors.append(share / spread if spread > 0.0 else 0.0)
    return FittedBlend(tuple(fitted), tuple(factors))


def _targets(distil: DistilConfig, inputs: Floats32, slipped: Bools, seed: int) -> Floats:
    """Probabilities of slip (N,): the labels mixed with what the teacher says out of fold."""
    margins = np.empty(len(inputs))
    split = StratifiedKFold(distil.inner_folds, shuffle=True, random_state=seed)
    seeds = _seeds(seed, distil.inner_folds)
    for fold_seed, (rest, fold) in zip(seeds, split.split(inputs, slipped), strict=True):
        teacher = _fit_blend(distil.teacher, inputs[rest], slipped[rest], fold_seed)
        margins[fold] = teacher.margins(inputs[fold])
    temperature = fit_temperature(margins, slipped)
    soft = 1.0 / (1.0 + np.exp(-margins / temperature))
    targets: Floats = distil.hard * slipped + (1.0 - distil.hard) * soft
    return targets


def _seeds(seed: int, number: int) -> Sequence[int]:
    return [int(value) for value in np.random.SeedSequence(seed).generate_state(number)]
