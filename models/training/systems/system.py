"""What a system is: one way from counts to the log-odds of slip, by configuration alone."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from typing import Any

import msgspec

from graspd.models.bts3 import FINGERS, WHOLE
from graspd.models.contract import CountsInput, Finger, ImageInput, VectorInput
from graspd.models.training.data.augmentation import Augmentation
from graspd.models.training.data.protocols import EvalProtocol
from graspd.models.training.estimators.configs import AnyRecipe, ClassicalConfig, NetworkConfig

CLIP = 3.0
"""Standardised session features are cut off here: what is farther out is a sensor that moved."""


@dataclass(frozen=True, slots=True)
class SessionFeatures:
    """Input of a session model; the statistics come from the grasps that it is trained on."""

    clip: float = CLIP


@dataclass(frozen=True, slots=True)
class Member:
    """One of the estimators that a blend asks."""

    estimator: NetworkConfig | ClassicalConfig
    recipe: AnyRecipe | None = None
    """Of a network."""
    copies: int = 1
    """How many of it are trained, each from another seed."""
    weight: float = 1.0
    """Of all copies together."""


@dataclass(frozen=True, slots=True)
class BlendConfig:
    """Weighted mean of the members' margins, each first divided by its own spread."""

    members: tuple[Member, ...]


SystemInput = ImageInput | VectorInput | CountsInput | SessionFeatures
Estimator = NetworkConfig | ClassicalConfig | BlendConfig


@dataclass(frozen=True, slots=True)
class PaperFigure:
    """A figure of the paper, %, slip positive: mean and standard deviation."""

    protocol: EvalProtocol
    f1: tuple[float, float]
    accuracy: tuple[float, float] | None = None
    precision: tuple[float, float] | None = None
    recall: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class System:
    """One way from counts to a margin, complete but for data and seed."""

    name: str
    description: str
    input: SystemInput
    estimator: Estimator
    recipe: AnyRecipe | None = None
    """Of the network that `estimator` is; None for others."""
    augmentation: Augmentation | None = None
    standardise: bool = False
    """Each value of an input by its own mean and spread in the training, within the model."""
    fingers: tuple[Finger, ...] = FINGERS
    tables: tuple[str, ...] = WHOLE
    """What the model that is kept is trained on; protocols say for themselves."""
    published: tuple[PaperFigure, ...] = ()


def digest(system: System) -> str:
    """SHA-256, hexadecimal, of all that decides a fold's result; name and description do not."""
    parts = configuration(system, "input", "estimator", "recipe", "augmentation", "standardise")
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def configuration(system: System, *fields: str) -> dict[str, Any]:
    """Return these fields of a system, JSON-ready, and its fingers if they are not all three."""
    names = fields if system.fingers == FINGERS else (*fields, "fingers")
    return {name: _plain(getattr(system, name)) for name in names}


def with_recipes(system: System, *, epochs: int) -> System:
    """Return the system with this number of epochs in each of its recipes."""
    estimator = system.estimator
    if isinstance(estimator, BlendConfig):
        members = [
            dataclasses.replace(member, recipe=_with_epochs(member.recipe, epochs))
            for member in estimator.members
        ]
        estimator = BlendConfig(tuple(members))
    recipe = _with_epochs(system.recipe, epochs)
    return dataclasses.replace(system, estimator=estimator, recipe=recipe)


def _with_epochs(recipe: AnyRecipe | None, epochs: int) -> AnyRecipe | None:
    return None if recipe is None else dataclasses.replace(recipe, epochs=epochs)


def _plain(value: object) -> Any:  # noqa: ANN401 - JSON
    """JSON-like, with the names of the classes: two kinds with the same fields differ."""
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    if isinstance(value, msgspec.Struct):
        names = value.__struct_fields__
    elif dataclasses.is_dataclass(value):
        names = tuple(field.name for field in dataclasses.fields(value))
    else:
        return value
    return {"kind": type(value).__name__, **{name: _plain(getattr(value, name)) for name in names}}
