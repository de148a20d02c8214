"""A system: the configuration of one way from counts to the log-odds of slip."""

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
"""Limit of standardised session features; one beyond it comes from a sensor that moved."""


@dataclass(frozen=True, slots=True)
class SessionFeatures:
    """Input of a session model: features standardised by session, clipped to +-`clip`."""

    clip: float = CLIP


@dataclass(frozen=True, slots=True)
class Member:
    """One of the estimators that a blend asks."""

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
    """A figure of the paper, %, slip positive: mean and standard deviation."""

    protocol: EvalProtocol
    f1: tuple[float, float]
    accuracy: tuple[float, float] | None = None
    precision: tuple[float, float] | None = None
    recall: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class System:
    """One way from counts to a margin, complete except for data and seed."""

    name: str
    description: str
    input: SystemInput
    estimator: Estimator
    recipe: AnyRecipe | None = None
    """Training recipe of the network `estimator`; None for other estimators."""
    augmentation: Augmentation | None = None
    standardise: bool = False
    """True: the model standardises each input value by its training mean and spread."""
    fingers: tuple[Finger, ...] = FINGERS
    tables: tuple[str, ...] = WHOLE
    """Training tables of the kept model; protocols have their own."""
    published: tuple[PaperFigure, ...] = ()


def digest(system: System) -> str:
    """Return the SHA-256 of how it is trained, without name, texts, fingers and tables."""
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
