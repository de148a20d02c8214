"""What a model file must say about itself, and how it is written into an ONNX file.

The contract is one JSON object under the metadata key `graspd` of the ONNX model. The daemon runs
no model without it: a network fed with the wrong layout, filling or finger order still answers,
and answers nonsense.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

METADATA_KEY = "graspd"
CONTRACT_VERSION = 1
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
    """Smallest and largest training count of each electrode, shape (fingers, 24).

    A count further outside than the margin is data that the model has never seen.
    """

    low: tuple[tuple[Count, ...], ...]
    high: tuple[tuple[Count, ...], ...]
    margin: Count


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
        for bound in (contract.seen.low, contract.seen.high):
            if [len(row) for row in bound] != [24] * len(contract.fingers):
                raise ModelError("model contract is wrong: seen counts are not (fingers, 24)")
        return contract
