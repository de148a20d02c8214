"""What a model file must say about itself, and how it is written into an ONNX file.

The contract is one JSON object under the metadata key `graspd` of the ONNX model. The daemon runs
no model without it: a network fed with the wrong layout, filling or finger order still answers,
and answers nonsense.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from models.layout import ELECTRODES

METADATA_KEY = "graspd"
CLASSES = ("stable", "slip")
"""Order of the two probabilities that every model returns."""
INPUT_NAME = "tactile_image"
OUTPUT_NAME = "probability"

Finger = Literal["ff", "mf", "rf", "lf", "th"]
"""First, middle, ring, little finger, thumb."""
Fraction = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Count = Annotated[int, msgspec.Meta(ge=0, le=4095)]


class ModelError(Exception):
    """A model file is missing, broken, or says that it does not fit. Give up until it is fixed."""


class Dataset(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One file that a model was trained on."""

    name: str
    sha256: str
    rows: int


class MeasuredError(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Error of the training recipe, measured on data that was left out. Slip is positive."""

    protocol: str
    """`cv`: stratified cross-validation, mean and standard deviation over the folds."""
    folds: int
    f1_mean: Fraction
    f1_std: Fraction
    accuracy_mean: Fraction
    accuracy_std: Fraction


class SeenCounts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the training counts look like; `models.seen` says what follows for a reading."""

    low: tuple[tuple[Count, ...], ...]
    """Smallest count of each electrode, shape (fingers, 24)."""
    high: tuple[tuple[Count, ...], ...]
    """Largest count of each electrode, shape (fingers, 24)."""
    margin: Count
    """A count further outside of `low`..`high` than this was never seen."""
    centre: tuple[tuple[float, ...], ...]
    """Mean of each electrode, counts, shape (fingers, 24)."""
    whitening: tuple[tuple[float, ...], ...]
    """Rows of the lower triangle of a matrix L, 1/counts, whose product `L @ L.T` is the inverse
    covariance of all electrodes, fingers one after the other: row i has i + 1 values."""
    distance_max: Annotated[float, msgspec.Meta(gt=0.0)]
    """A reading with a larger root-mean-square whitened deviation was never seen."""


class ModelContract(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that must agree between a model and whoever feeds it."""

    version: Literal[1]
    name: str
    layout: str
    fill: str
    normalisation: str
    composition: Literal["channels"]
    fingers: tuple[Finger, ...]
    """Order of the image's channels."""
    classes: tuple[str, ...]
    seed: int
    datasets: tuple[Dataset, ...]
    measured: MeasuredError
    seen: SeenCounts

    def to_json(self) -> str:
        """Text of the `graspd` metadata entry."""
        return msgspec.json.encode(self).decode()

    @classmethod
    def from_json(cls, text: str) -> ModelContract:
        """Parse and check a metadata entry. Raises `ModelError` naming the field."""
        try:
            contract = msgspec.json.decode(text, type=cls)
        except msgspec.DecodeError as error:
            raise ModelError(f"model contract is wrong: {error}") from error
        if contract.classes != CLASSES:
            raise ModelError(f"model classes are {contract.classes}, not {CLASSES}")
        _check(contract)
        return contract


def _check(contract: ModelContract) -> None:
    """Raise `ModelError` for what the types alone do not say."""
    fingers, seen = contract.fingers, contract.seen
    if not fingers or len(set(fingers)) != len(fingers):
        raise ModelError(f"model contract is wrong: fingers {fingers} are not different ones")
    for rows in (seen.low, seen.high, seen.centre):
        if [len(row) for row in rows] != [ELECTRODES] * len(fingers):
            raise ModelError("model contract is wrong: seen counts are not (fingers, 24)")
    if [len(row) for row in seen.whitening] != list(range(1, ELECTRODES * len(fingers) + 1)):
        raise ModelError("model contract is wrong: whitening is not a triangle over all electrodes")
    if any(
        low > high
        for rows in zip(seen.low, seen.high, strict=True)
        for low, high in zip(*rows, strict=True)
    ):
        raise ModelError("model contract is wrong: a lowest count is above the highest")
