"""From grasp tables to a model file and its card: measure, calibrate, train, export."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import nn

from models.bts3 import FINGERS
from models.contract import CLASSES, ModelContract
from models.layout import D1
from models.seen import SeenCheck
from models.tactile_image import Fill, Normalisation, TactileImager
from models.training import card as cards
from models.training.calibration import cross_fitted_p_slip, fit_temperature, p_slip, reliability
from models.training.datasets import Grasps, unpublished
from models.training.export import OPSET, Parity, export
from models.training.networks import NetworkConfig, parameter_count
from models.training.protocols import (
    CrossValidation,
    Scores,
    cross_validate,
    measure_repeatability,
    score,
)
from models.training.recipe import Progress, Recipe, logits, train
from models.training.seen import (
    held_out_never_seen,
    made_up_never_seen,
    seen_counts,
)

FILL = Fill.NEIGHBOUR_MEAN
NORMALISATION = Normalisation.FILLED_IMAGE
WHAT = (
    "Says from the tactile image of one reading, taken after the fingers closed and before the "
    "lift, whether the object will stay (stable) or slip."
)
EXTRA_TRAININGS = 3
"""Beside the folds: two for the repeatability, one for the model itself."""


@dataclass(frozen=True, slots=True)
class Order:
    """What to make."""

    network: NetworkConfig
    recipe: Recipe
    folds: int
    seed: int

    @property
    def epochs(self) -> int:
        """Epochs of all trainings together."""
        return (self.folds + EXTRA_TRAININGS) * self.recipe.epochs

    @property
    def command(self) -> str:
        """The command line that repeats it."""
        return (
            f"graspd train {self.network.name} --data DIR --seed {self.seed} "
            f"--folds {self.folds} --epochs {self.recipe.epochs}"
        )


def make(
    order: Order,
    grasps: Grasps,
    new_session: Grasps | None,
    out: Path,
    on_epoch: Progress | None = None,
) -> cards.Card:
    """Write `<name>.onnx` and `<name>.json` into the folder `out`.

    Raises `TooFewGraspsError` if the grasps are too few for the folds, `ExportError` if the file
    does not judge as the network does, `OSError` if the folder cannot be written.
    """
    config, recipe, seed = order.network, order.recipe, order.seed
    images, slipped = _images(grasps), grasps.slipped
    validation = cross_validate(
        config, images, slipped, recipe, folds=order.folds, seed=seed, on_epoch=on_epoch
    )
    repeatability = measure_repeatability(
        config, images, slipped, recipe, validation, seed=seed, on_epoch=on_epoch
    )
    calibration = _calibration(validation, slipped)
    network = train(config, images, slipped, recipe, seed=seed, on_epoch=on_epoch)
    contract = _contract(order, grasps, validation)
    path = out / f"{config.name}.onnx"
    parity = export(network, calibration.temperature, contract, grasps.counts, path)
    session = _judge_new_session(network, calibration.temperature, contract, new_session)
    card = cards.Card(
        what=f"{WHAT} Network: Conv{config.filters} - FC{config.hidden}.",
        contract=contract,
        file=_file(path, parity),
        data=cards.Data(not_published=tuple(unpublished(grasps.files))),
        network=config,
        trained_parameters=parameter_count(network),
        recipe=recipe,
        cross_validation=cards.Validation.of(validation),
        calibration=calibration,
        never_seen=cards.NeverSeen(
            held_out_fold=held_out_never_seen(grasps.counts, validation.fold_of),
            held_out_object=_held_out_object(grasps),
            made_up=made_up_never_seen(grasps.counts, contract.seen, seed),
        ),
        new_session=session,
        repeatability=repeatability,
        command=order.command,
        made_with=cards.made_with(),
        weak_points=cards.weak_points(session),
    )
    cards.write(card, path.with_suffix(".json"))
    return card


def _images(grasps: Grasps) -> NDArray[np.float32]:
    imager = TactileImager(len(FINGERS), D1, FILL, NORMALISATION)
    return imager.build_batch(grasps.counts)[0]


def _held_out_object(grasps: Grasps) -> float | None:
    objects = np.array(grasps.objects)
    return held_out_never_seen(grasps.counts, objects) if len(set(grasps.objects)) > 1 else None


def _calibration(validation: CrossValidation, slipped: NDArray[np.bool_]) -> cards.Calibration:
    fitted = cross_fitted_p_slip(validation.logits, slipped, validation.fold_of)
    return cards.Calibration(
        temperature=fit_temperature(validation.logits, slipped),
        before=reliability(p_slip(validation.logits), slipped),
        after=reliability(fitted, slipped),
    )


def _contract(order: Order, grasps: Grasps, validation: CrossValidation) -> ModelContract:
    return ModelContract(
        version=1,
        name=order.network.name,
        layout=D1.name,
        fill=FILL,
        normalisation=NORMALISATION,
        composition="channels",
        fingers=FINGERS,
        classes=CLASSES,
        seed=order.seed,
        datasets=grasps.files,
        measured=validation.measured(),
        seen=seen_counts(grasps.counts),
    )


def _file(path: Path, parity: Parity) -> cards.ModelFile:
    data = path.read_bytes()
    return cards.ModelFile(hashlib.sha256(data).hexdigest(), len(data), OPSET, parity)


def _judge_new_session(
    network: nn.Module, temperature: float, contract: ModelContract, session: Grasps | None
) -> cards.NewSession | None:
    if session is None:
        return None
    values, slipped = logits(network, _images(session)), session.slipped
    refused = SeenCheck(contract.seen).never_seen(session.counts)
    return cards.NewSession(
        file=session.files[0],
        scores=_score_if_both(values, slipped),
        reliability=reliability(p_slip(values, temperature), slipped),
        never_seen=float(refused.mean()),
        scores_of_rest=_score_if_both(values[~refused], slipped[~refused]),
    )


def _score_if_both(values: NDArray[np.float64], slipped: NDArray[np.bool_]) -> Scores | None:
    return score(values, slipped) if len(np.unique(slipped)) == 2 else None
