"""What a model file must say about itself, and how it is written into an ONNX file.

The contract is one JSON object under the metadata key `graspd` of the ONNX model. The daemon runs
no model without it: a network fed with the wrong layout, filling or finger order still answers,
and answers nonsense.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from graspd.models.layout import ELECTRODES

METADATA_KEY = "graspd"
CLASSES = ("stable", "slip")
"""Order of the two probabilities that every model returns."""
OUTPUT_NAME = "probability"
FEATURES_PER_FINGER = ELECTRODES + 2
"""Of a session model: 24 z-values, the finger's mean and its spread."""

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
    """Mean and deviation over folds of the recipe's error on data left out; slip is positive."""

    protocol: str
    """`cv`: known objects; `unknown`, `objects`: others; `session`, `days`: on other days."""
    folds: int
    f1_mean: Fraction
    f1_std: Fraction
    accuracy_mean: Fraction
    accuracy_std: Fraction


class SeenCounts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the training counts look like; `electrodes` says what follows for a reading."""

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
    distance_min: Annotated[float, msgspec.Meta(ge=0.0)] = 0.0
    """A reading with a smaller one was never seen either: it is the mean of all, not a grasp."""

    def whitening_matrix(self) -> NDArray[np.float64]:
        """Return L of `whitening`, lower triangular, shape (electrodes, electrodes), 1/counts."""
        size = len(self.whitening)
        matrix = np.zeros((size, size))
        matrix[np.tril_indices(size)] = [value for row in self.whitening for value in row]
        return matrix


class ImageInput(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="image"):
    """The model takes tactile images."""

    layout: str
    fill: str
    normalisation: str
    composition: Literal["channels", "horizontal", "vertical"]
    """How the fingers' images stand together (paper, section II-C)."""


class VectorInput(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="vector"):
    """The model takes the counts, z-scored per finger over its 24 electrodes."""


class CountsInput(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="counts"):
    """The model takes the counts as they are: whatever is done to them is inside its graph."""


class Sharpness(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How far a verdict may be trusted while a session is young."""

    grasps: Annotated[float, msgspec.Meta(ge=0.0)]
    """Weight of the session's statistics from which on this holds, grasps."""
    temperature: Annotated[float, msgspec.Meta(ge=1.0)]
    """The margin (log-odds of slip) is divided by this; as measured on a session left out."""


class SessionInput(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="session"):
    """The model takes features standardised by the session's own, unlabelled grasps.

    Features, 26 per finger: first every finger's 24 z-values, then every finger's mean, then every
    finger's spread, counts. What the session has not shown yet is filled in by the training's
    statistics, which weigh `prior_grasps` grasps.
    """

    mean: tuple[float, ...]
    """Training mean of each feature."""
    spread: tuple[Annotated[float, msgspec.Meta(gt=0.0)], ...]
    """Training standard deviation of each feature, within a session."""
    clip: Annotated[float, msgspec.Meta(gt=0.0)]
    """Standardised features are clipped to +- this."""
    prior_grasps: Annotated[float, msgspec.Meta(gt=0.0)]
    """Weight of the training's statistics, grasps."""
    calibrated_from: Annotated[float, msgspec.Meta(ge=0.0)]
    """Grasps' worth of statistics from which on the session counts as calibrated."""
    sharpness: tuple[Sharpness, ...]
    """Ascending in `grasps`, from 0."""


Input = ImageInput | VectorInput | CountsInput | SessionInput
"""What a model is fed with; in JSON told apart by `type`."""


class ConfidenceStep(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One point of the accuracy-coverage curve, measured on data that was left out."""

    confidence: Fraction
    """Judging only where max(p_slip, 1 - p_slip) reaches this ..."""
    accuracy: Fraction
    """... this share of the verdicts was right ..."""
    coverage: Fraction
    """... and this share of the grasps was judged."""


class ModelContract(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that must agree between a model and the program that feeds it."""

    version: Literal[2]
    name: str
    input: Input
    fingers: tuple[Finger, ...]
    """Order of the fingers in the input."""
    classes: tuple[str, ...]
    seed: int
    datasets: tuple[Dataset, ...]
    measured: tuple[MeasuredError, ...]
    """By protocol; at least one."""
    confidence: tuple[ConfidenceStep, ...]
    """Ascending in `confidence`; empty if it was not measured."""
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
    if any(row[-1] <= 0.0 for row in seen.whitening):
        raise ModelError("model contract is wrong: whitening has no inverse")
    if not contract.measured:
        raise ModelError("model contract is wrong: states no measured error")
    if isinstance(contract.input, SessionInput):
        _check_session(contract.input, len(fingers))
    if any(
        low > high
        for rows in zip(seen.low, seen.high, strict=True)
        for low, high in zip(*rows, strict=True)
    ):
        raise ModelError("model contract is wrong: a lowest count is above the highest")


def _check_session(session: SessionInput, fingers: int) -> None:
    width = fingers * FEATURES_PER_FINGER
    if not len(session.mean) == len(session.spread) == width:
        raise ModelError(f"model contract is wrong: session statistics are not of {width} features")
    starts = [step.grasps for step in session.sharpness]
    if not starts or starts[0] != 0.0 or starts != sorted(set(starts)):
        raise ModelError("model contract is wrong: sharpness does not ascend from 0 grasps")
