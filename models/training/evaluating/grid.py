"""Grid search: every configuration of a classical system's grid as a system of its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

from models.training.data.protocols import EvalProtocol
from models.training.estimators.networks import DenseConfig, NetworkConfig
from models.training.evaluating.metrics import Spread
from models.training.evaluating.summaries import Summary
from models.training.systems.system import BlendConfig, DistilConfig, System


@dataclass(frozen=True, slots=True)
class GridPoint:
    """What one configuration of a grid reached, as fractions."""

    name: str
    f1: Spread
    accuracy: Spread


def grid_of(system: System) -> list[System]:
    """A system for each configuration of the estimator's grid; none for networks and blends."""
    match system.estimator:
        case BlendConfig() | DistilConfig() | NetworkConfig() | DenseConfig():
            return []
        case classical:
            return [
                dataclasses.replace(system, name=_name(system, config), estimator=config)
                for config in classical.grid()
            ]


def best_of_grid(
    system: System, protocol: EvalProtocol, summaries: Sequence[Summary]
) -> list[GridPoint]:
    """All configurations of a system's grid, the best F1 first."""
    names = {variant.name for variant in grid_of(system)}
    points = [
        GridPoint(summary.system, summary.main.spreads["f1"], summary.main.spreads["accuracy"])
        for summary in summaries
        if summary.system in names and summary.protocol == protocol
    ]
    return sorted(points, key=lambda point: -point.f1.mean)


def _name(system: System, config: object) -> str:
    """A name that a file may have: `svm-c=3.0-gamma=0.01`."""
    if not dataclasses.is_dataclass(config):
        raise TypeError(f"{type(config).__name__} is no configuration")
    fields = (
        f"{field.name}={getattr(config, field.name)}".replace(" ", "")
        for field in dataclasses.fields(config)
    )
    return "-".join((system.name, *fields))
