"""The contract of a model: one JSON object under the metadata key `graspd` of its ONNX file.

The daemon refuses a model without one, because a network that is fed with the wrong layout, filling
or finger order still answers, but wrongly.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX, ELECTRODES, Finger

METADATA_KEY = "graspd"
CLASSES = ("stable", "slip")
"""Classes, in the order of a model's two probabilities."""
OUTPUT_NAME = "probability"
FEATURES_PER_FINGER = ELECTRODES + 2
"""Features of a finger in a session model: 24 z-values, mean and spread."""

Fraction = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Count = Annotated[int, msgspec.Meta(ge=0, le=COUNT_MAX)]


class ModelError(Exception):
    """A model file is missing, broken or does not fit; no retry can succeed."""


class Dataset(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A file that a model was trained on."""

    name: str
    sha256: str
    rows: int


class MeasuredError(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """F1 (slip positive) and accuracy on held-out data: mean and deviation over the folds."""

    protocol: str
    """`cv`: known objects; `unknown`, `objects`: new objects; `session`, `days`: other days."""
    folds: int
    f1_mean: Fraction
    f1_std: Fraction
    accuracy_mean: Fraction
    accuracy_std: Fraction


class SeenCounts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Description of the training counts, used by `graspd.models.electrodes`."""

    low: tuple[tuple[Count, ...], ...]
    """Smallest count of each electrode, shape (fingers, 24)."""
    high: tuple[tuple[Count, ...], ...]
    """Largest count of each electrode, shape (fingers, 24)."""
    margin: Count
    """Counts beyond `low`..`high` that still count as like the training."""
    centre: tuple[tuple[float, ...], ...]
    """Mean of each electrode, counts, shape (fingers, 24)."""
    whitening: tuple[tuple[float, ...], ...]
    """Rows of a lower triangular matrix L, 1/counts; row i has i + 1 values.

    `L @ L.T` is the inverse covariance of all electrodes, one finger after the other.
    """
    distance_max: Annotated[float, msgspec.Meta(gt=0.0)]
    """Largest root-mean-square whitened deviation of a reading that is like the training."""
    distance_min: Annotated[float, msgspec.Meta(ge=0.0)] = 0.0
    """Smallest such deviation; a reading below it is nearer to the mean than any real grasp."""

    def whitening_matrix(self) -> NDArray[np.float64]:
        """Return L of `whitening`, lower triangular, shape (electrodes, electrodes), 1/counts."""
        size = len(self.whitening)
        matrix = np.zeros((size, size))
        matrix[np.tril_indices(size)] = [value for row in self.whitening for value in row]
        return matrix


class ImageInput(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="image"):
    """Input of a model that takes tactile images."""

    layout: str
    fill: str
    normalisation: str
    composition: Literal["channels", "horizontal", "vertical"]
    """Arrangement of the fingers' images (paper, section II-C)."""


class VectorInput(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="vector"):
    """Input of a model that takes counts, z-scored over the 24 electrodes of each finger."""


class CountsInput(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="counts"):
    """Input of a model that takes raw counts and transforms them in its own graph."""


class Sharpness(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Temperature of a session model's probabilities while the session is young."""

    grasps: Annotated[float, msgspec.Meta(ge=0.0)]
    """Number of grasps of the session from which on this temperature is used."""
    temperature: Annotated[float, msgspec.Meta(ge=1.0)]
    """Divisor of the margin (log-odds of slip), measured on a held-out session."""


class SessionInput(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="session"):
    """Input of a session model: features standardised by the session's own, unlabelled grasps.

    There are 26 features per finger: 24 z-values of each finger, then the mean of each finger, then
    the spread of each finger, counts. The training's statistics count as `prior_grasps` grasps.
    """

    mean: tuple[float, ...]
    """Training mean of each feature."""
    spread: tuple[Annotated[float, msgspec.Meta(gt=0.0)], ...]
    """Training standard deviation of each feature, within a session."""
    clip: Annotated[float, msgspec.Meta(gt=0.0)]
    """Largest magnitude of a standardised feature; larger ones are clipped."""
    prior_grasps: Annotated[float, msgspec.Meta(gt=0.0)]
    """Weight of the training's statistics, grasps."""
    calibrated_from: Annotated[float, msgspec.Meta(ge=0.0)]
    """Number of grasps from which on the session counts as calibrated."""
    sharpness: tuple[Sharpness, ...]
    """Temperatures, ascending in `grasps` from 0."""


Input = ImageInput | VectorInput | CountsInput | SessionInput
"""Kinds of input; the JSON key `type` names the kind."""


class ConfidenceStep(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One point of the accuracy-coverage curve, measured on held-out data."""

    confidence: Fraction
    """Smallest max(p_slip, 1 - p_slip) at which a grasp is judged."""
    accuracy: Fraction
    """Share of the judged grasps that were judged right."""
    coverage: Fraction
    """Share of the grasps that were judged."""


class ModelContract(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything on which a model and the program that feeds it must agree."""

    version: Literal[2]
    name: str
    input: Input
    fingers: tuple[Finger, ...]
    """Fingers in the order of the input."""
    classes: tuple[str, ...]
    seed: int
    datasets: tuple[Dataset, ...]
    measured: tuple[MeasuredError, ...]
    """Scores, one for each protocol; at least one."""
    confidence: tuple[ConfidenceStep, ...]
    """Points of the accuracy-coverage curve, ascending in `confidence`; empty: not measured."""
    seen: SeenCounts

    def to_json(self) -> str:
        """Return the text of the metadata entry `graspd`."""
        return msgspec.json.encode(self).decode()

    @classmethod
    def from_json(cls, text: str) -> ModelContract:
        """Parse and check a metadata entry. Raises `ModelError`, which names the field."""
        try:
            contract = msgspec.json.decode(text, type=cls)
        except msgspec.DecodeError as error:
            raise ModelError(f"model contract is wrong: {error}") from error
        if contract.classes != CLASSES:
            raise ModelError(f"model classes are {contract.classes}, not {CLASSES}")
        _check(contract)
        return contract


def _check(contract: ModelContract) -> None:
    """Raise `ModelError` for mistakes that the types do not exclude."""
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
