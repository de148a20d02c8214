"""The model card: a JSON file beside the model that says how it was made and what it is worth."""

from __future__ import annotations

import importlib.metadata
import platform
from pathlib import Path

import msgspec

from models.bts3 import CITATIONS, LICENCE, REPOSITORY
from models.contract import Dataset, ModelContract
from models.training.calibration import Reliability
from models.training.export import Parity
from models.training.networks import NetworkConfig
from models.training.protocols import CrossValidation, Repeatability, Scores
from models.training.recipe import Recipe

LIBRARIES = ("numpy", "onnx", "onnxruntime", "onnxscript", "scikit-learn", "torch")
AVERAGED = ("accuracy", "precision", "recall", "f1", "auc")

WEAK_POINTS = (
    "In `cv` the objects are known. New objects do worse: the paper gives F1 87.7 for CNN1.",
    "The data is of one hand and 41 objects, lifted in one way.",
    "One broken electrode that nobody notices is enough to turn a verdict.",
)


class ModelFile(msgspec.Struct, frozen=True):
    """The ONNX file that the card is about."""

    sha256: str
    size_bytes: int
    opset: int
    parity: Parity


class Data(msgspec.Struct, frozen=True):
    """Where the data comes from. Digests and rows stand in the contract."""

    licence: str = LICENCE
    repository: str = REPOSITORY
    cite: tuple[str, ...] = CITATIONS
    not_published: tuple[str, ...] = ()
    """Files that differ from the published ones: licence and sources above are not theirs."""


class Spread(msgspec.Struct, frozen=True):
    """Mean and population standard deviation over the folds."""

    mean: float
    std: float


class Validation(msgspec.Struct, frozen=True):
    """Cross-validation; every figure is a fraction, slip positive."""

    summary: dict[str, Spread]
    folds: tuple[Scores, ...]

    @classmethod
    def of(cls, validation: CrossValidation) -> Validation:
        """Summarise the folds."""
        summary = {name: Spread(*validation.mean_std(name)) for name in AVERAGED}
        return cls(summary, validation.folds)


class Calibration(msgspec.Struct, frozen=True):
    """The temperature in the file, fitted on the out-of-fold logits."""

    temperature: float
    before: Reliability
    after: Reliability
    how: str = (
        "measured on the out-of-fold logits; after: each fold by the temperature that the other "
        "folds give; ECE with 15 equal bins over the verdict's probability"
    )


class NeverSeen(msgspec.Struct, frozen=True):
    """Fraction of readings that the contract's `seen` refuses."""

    held_out_fold: float
    """Grasps of a fold, by what the other folds look like."""
    held_out_object: float | None
    """Grasps of an object, by the other objects; None if there is only one."""
    made_up: dict[str, float]
    """Readings that no hand ever made, by the way they were made up."""


class NewSession(msgspec.Struct, frozen=True):
    """The model on the same objects in a later session, with another palm pose."""

    file: Dataset
    scores: Scores | None
    """None if one class is missing."""
    reliability: Reliability
    never_seen: float
    """Fraction of its grasps that the contract's `seen` refuses."""
    scores_of_rest: Scores | None
    """Figures of the grasps that are not refused."""


class Card(msgspec.Struct, frozen=True):
    """Everything that is known about one model file."""

    what: str
    contract: ModelContract
    """Word for word what stands in the file."""
    file: ModelFile
    data: Data
    network: NetworkConfig
    trained_parameters: int
    recipe: Recipe
    cross_validation: Validation
    calibration: Calibration
    never_seen: NeverSeen
    new_session: NewSession | None
    repeatability: Repeatability
    command: str
    """Makes the file again, byte for byte on a machine of the same kind."""
    made_with: dict[str, str]
    weak_points: tuple[str, ...]


def weak_points(session: NewSession | None) -> tuple[str, ...]:
    """What a user must know, with the figures of the later session where it was judged."""
    if session is None or session.scores is None:
        return WEAK_POINTS
    text = (
        f"In a later session ({session.file.name}: same objects, other palm pose, drifted sensors) "
        f"F1 is {100 * session.scores.f1:.1f} %: it still ranks (AUC {session.scores.auc:.2f}), "
        "its zero has moved. What looks unlike the training data is refused: "
        f"{100 * session.never_seen:.1f} % of these grasps"
    )
    if session.scores_of_rest is not None:
        text += f"; on the rest F1 is {100 * session.scores_of_rest.f1:.1f} %"
    return (f"{text}.", *WEAK_POINTS)


def made_with() -> dict[str, str]:
    """Versions of what decides the weights' last digits."""
    versions = {name: importlib.metadata.version(name) for name in LIBRARIES}
    return {"machine": platform.machine(), "python": platform.python_version(), **versions}


def write(card: Card, path: Path) -> None:
    """Write the card as indented JSON."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(card), indent=2) + b"\n")
