"""All systems that can be trained, by name: each is one way from counts to log-odds of slip."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import msgspec

from graspd.biotac import TABLE_FINGERS, Finger
from graspd.models.bts3 import NEW_SESSION, WHOLE
from graspd.models.contract import CountsInput, ImageInput, VectorInput
from graspd.models.layout import D1, D2A, D2B, D3
from graspd.models.tactile_image import Composition, Fill, Normalisation
from graspd.models.training.data.protocols import EvalProtocol
from graspd.models.training.estimators.configs import (
    CNN0,
    CNN1,
    CNN2,
    CNN3,
    AnyRecipe,
    Augmentation,
    BoostingConfig,
    ClassicalConfig,
    ForestConfig,
    MlpConfig,
    NetworkConfig,
    PublishedRecipe,
    Recipe,
    SecondConvolution,
    SessionRecipe,
    SvmConfig,
)

CLIP = 3.0
"""Limit of standardised session features. Larger ones come from sensors that have drifted."""


@dataclass(frozen=True, slots=True)
class SessionFeatures:
    """Input of a session model: features standardised by session, clipped to +-`clip`."""

    clip: float = CLIP


@dataclass(frozen=True, slots=True)
class Member:
    """One of the estimators of a blend."""

    estimator: NetworkConfig | ClassicalConfig
    recipe: AnyRecipe | None = None
    """Training recipe of a network; None for other estimators."""
    copies: int = 1
    """Number of trainings of the member, each with another seed."""
    weight: float = 1.0
    """Weight of all copies together."""


@dataclass(frozen=True, slots=True)
class BlendConfig:
    """Weighted mean of the members' margins, each first divided by its own spread."""

    members: tuple[Member, ...]


SystemInput = ImageInput | VectorInput | CountsInput | SessionFeatures
Estimator = NetworkConfig | ClassicalConfig | BlendConfig


@dataclass(frozen=True, slots=True)
class PaperFigure:
    """Scores in the paper, %, slip positive: mean and standard deviation; None: not given."""

    place: str
    """Table, figure or section of the paper (arXiv:1809.05551), and the row."""
    protocol: EvalProtocol
    f1: tuple[float, float]
    accuracy: tuple[float, float] | None = None
    precision: tuple[float, float] | None = None
    recall: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class System:
    """One way from counts to a margin, complete except for data and seed."""

    name: str
    input: SystemInput
    estimator: Estimator
    recipe: AnyRecipe | None = None
    """Training recipe of the network `estimator`; None for other estimators."""
    augmentation: Augmentation | None = None
    standardise: bool = False
    """True: the model standardises each input value by its training mean and spread."""
    fingers: tuple[Finger, ...] = TABLE_FINGERS
    tables: tuple[str, ...] = WHOLE
    """Tables that a final model is trained on; protocols have their own."""
    published: tuple[PaperFigure, ...] = ()


def digest(system: System) -> str:
    """Return the SHA-256 of the system's configuration without name and tables."""
    parts = configuration(system, "input", "estimator", "recipe", "augmentation", "standardise")
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def configuration(system: System, *fields: str) -> dict[str, Any]:
    """Return these fields of a system for JSON, and its fingers unless they are all three."""
    names = fields if system.fingers == TABLE_FINGERS else (*fields, "fingers")
    return {name: _plain(getattr(system, name)) for name in names}


def with_recipes(system: System, *, epochs: int) -> System:
    """Return the system with this number of epochs in each of its recipes."""
    estimator = system.estimator
    if isinstance(estimator, BlendConfig):
        members = [
            replace(member, recipe=_with_epochs(member.recipe, epochs))
            for member in estimator.members
        ]
        estimator = BlendConfig(tuple(members))
    recipe = _with_epochs(system.recipe, epochs)
    return replace(system, estimator=estimator, recipe=recipe)


def _with_epochs(recipe: AnyRecipe | None, epochs: int) -> AnyRecipe | None:
    return None if recipe is None else replace(recipe, epochs=epochs)


def _plain(value: object) -> Any:  # noqa: ANN401 - JSON
    """Return a value for JSON with class names, so that kinds with equal fields differ."""
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    if isinstance(value, msgspec.Struct):
        names = value.__struct_fields__
    elif dataclasses.is_dataclass(value):
        names = tuple(field.name for field in dataclasses.fields(value))
    else:
        return value
    return {"kind": type(value).__name__, **{name: _plain(getattr(value, name)) for name in names}}


def image(
    layout: str = D1.name,
    fill: Fill = Fill.NEIGHBOUR_MEAN,
    composition: Composition = Composition.CHANNELS,
) -> ImageInput:
    """Return an image input; default is the paper's best: D1, neighbour mean, channels."""
    return ImageInput(layout, fill.value, Normalisation.FILLED_IMAGE.value, composition.value)


VECTOR = VectorInput()
COUNTS = CountsInput()
IMAGE = image()
SESSION = SessionFeatures()

CNN_RECIPE = Recipe()
SHARP_SVM = SvmConfig(c=5.0, gamma=0.02)
SESSION_RECIPE = SessionRecipe()


def cnn(
    name: str,
    network: NetworkConfig,
    *published: PaperFigure,
    recipe: Recipe | PublishedRecipe = CNN_RECIPE,
    augmentation: Augmentation | None = None,
    takes: ImageInput = IMAGE,
) -> System:
    """Return a system of a convolutional network on tactile images.

    `published`: its results in the paper. `takes`: how its images are made.
    """
    return System(name, takes, network, recipe, augmentation, published=published)


_CNN1_FIGURES = (
    PaperFigure("figure 4, CNN1", "cv", (94.2, 0.8)),
    PaperFigure("III-E, CNN1", "unknown", (87.7, 0.4)),
)
_CNN3_FIGURES = PaperFigure("figure 4, CNN3", "cv", (92.2, 2.0))

_PAPER = (
    cnn("cnn0", CNN0, PaperFigure("III-B, neighbour mean; III-C, channels", "cv", (92.6, 1.7))),
    cnn("cnn1", CNN1, *_CNN1_FIGURES),
    cnn("cnn2", CNN2, PaperFigure("figure 4, CNN2", "cv", (92.0, 2.0))),
    cnn("cnn3", CNN3, _CNN3_FIGURES),
    cnn("cnn3-3x3", replace(CNN3, second=SecondConvolution(kernel=3)), _CNN3_FIGURES),
    cnn("cnn1-faithful", CNN1, *_CNN1_FIGURES, recipe=PublishedRecipe()),
    cnn(
        "cnn1-augmented",
        replace(CNN1, dropout=0.25),
        PaperFigure("III-E, CNN1 augmented", "unknown", (90.1, 0.4)),
        recipe=PublishedRecipe(epochs=30, l2=0.015),
        augmentation=Augmentation(),
    ),
    cnn("cnn1-dropout", replace(CNN1, dropout=0.25)),
    cnn(
        "cnn1-plain", replace(CNN1, batch_norm=False), recipe=replace(CNN_RECIPE, weight_decay=0.0)
    ),
    System(
        "svm",
        VECTOR,
        SvmConfig(c=3.0, gamma=0.1),
        published=(PaperFigure("figure 4, SVM", "cv", (88.0, 2.9)),),
    ),
    System("mlp", VECTOR, MlpConfig((300,))),
    System(
        "rf",
        VECTOR,
        ForestConfig(101, None),
        published=(
            PaperFigure("figure 4, RF", "cv", (92.6, 1.5)),
            PaperFigure("III-E, RF", "unknown", (90.2, 0.5)),
        ),
    ),
)

_D2_FIGURES = PaperFigure("table III, D2", "cv", (89.7, 1.5), (89.6, 1.7))
_LAYOUTS = tuple(
    cnn(
        f"cnn0-{layout.name.lower()}-{Fill.LEAST_CONTACT.value}",
        CNN0,
        published,
        takes=image(layout.name, Fill.LEAST_CONTACT),
    )
    for layout, published in (
        (
            D1,
            PaperFigure("table III, D1", "cv", (91.0, 1.4), (90.9, 1.5), (90.4, 2.4), (91.6, 2.4)),
        ),
        (D2A, _D2_FIGURES),
        (D2B, _D2_FIGURES),
        (D3, PaperFigure("table III, D3", "cv", (89.7, 1.4), (89.7, 1.3))),
    )
)
"""CNN0 on the images of the paper's table III."""

_COMPOSITIONS = tuple(
    cnn(
        f"cnn0-{composition.value}",
        CNN0,
        PaperFigure(f"III-C, {composition.value}", "cv", f1),
        takes=image(composition=composition),
    )
    for composition, where, f1 in (
        (Composition.HORIZONTAL, "side by side", (92.1, 1.7)),
        (Composition.VERTICAL, "below one another", (92.3, 1.8)),
    )
)
"""CNN0 on the images of the paper's section III-C, beside `cnn0` itself."""

_ELECTRODES = (
    System("svm-electrodes", COUNTS, SHARP_SVM, standardise=True),
    System(
        "blend-electrodes",
        COUNTS,
        BlendConfig((Member(SHARP_SVM), Member(CNN0, CNN_RECIPE, copies=2))),
        standardise=True,
    ),
    System("cnn0-electrodes", COUNTS, CNN0, CNN_RECIPE, standardise=True),
    System(
        "small-electrodes",
        COUNTS,
        NetworkConfig(filters=16, hidden=64),
        CNN_RECIPE,
        standardise=True,
    ),
)

_SESSION = (
    System("svm-session", SESSION, SvmConfig(c=3.0, gamma=0.003)),
    System(
        "hgb-session",
        SESSION,
        BoostingConfig(iterations=400, learning_rate=0.05, leaves=15, features=0.3),
    ),
    System("cnn1-session", SESSION, replace(CNN1, dropout=0.3), SESSION_RECIPE),
    System(
        "small-session",
        SESSION,
        NetworkConfig(filters=16, hidden=64, dropout=0.3),
        SESSION_RECIPE,
        tables=(*WHOLE, NEW_SESSION),
    ),
)

_HAND: tuple[Finger, ...] = TABLE_FINGERS
_FEWER_FINGERS = tuple(
    replace(_SESSION[-1], name=f"small-session-{'-'.join(fingers)}", fingers=fingers)
    for fingers in (*combinations(_HAND, 1), *combinations(_HAND, 2))
)
"""The default system for hands with fewer sensors; its inputs are those of fewer fingers."""

SYSTEMS = {
    system.name: system
    for system in _PAPER + _LAYOUTS + _COMPOSITIONS + _ELECTRODES + _SESSION + _FEWER_FINGERS
}
"""Systems by name, the paper's first. A new system is one more entry here."""
