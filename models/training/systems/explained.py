"""Descriptions of systems: input, layers, the paper's row that each reproduces, training time."""

from __future__ import annotations

from collections.abc import Iterator

from graspd.biotac import TABLE_FINGERS
from graspd.models.contract import CountsInput, ImageInput, VectorInput
from graspd.models.training.estimators.configs import (
    BoostingConfig,
    ForestConfig,
    MlpConfig,
    NetworkConfig,
    SvmConfig,
)
from graspd.models.training.systems.registry import SYSTEMS, Estimator, System, SystemInput

TITLES = ("system", "consists of", "takes", "paper", "command", "minutes")
MINUTES = {
    ("cnn0", "cv"): 2,
    ("cnn1", "cv"): 3,
    ("cnn1-faithful", "cv"): 34,
    ("cnn1-faithful", "unknown"): 5,
    ("cnn1-augmented", "unknown"): 5,
    ("cnn1-dropout", "cv"): 2,
    ("cnn1-plain", "cv"): 2,
    ("cnn0-d1-least-contact", "cv"): 3,
    ("cnn0-horizontal", "cv"): 3,
    ("cnn0-vertical", "cv"): 2,
    ("blend-electrodes", "cv"): 3,
    ("cnn1-session", "cv"): 5,
}
"""Minutes of a system in a protocol on two cores, from RESULTS.md; others take one or less."""


def explained() -> Iterator[tuple[str, ...]]:
    """Yield a row for each protocol in which the paper has a system, one of `cv` for other systems;
    cells as in `TITLES`."""
    for name, system in SYSTEMS.items():
        words = layers(system.estimator), taken(system)
        rows = {figure.protocol: figure.place for figure in system.published} or {"cv": "-"}
        for protocol, place in rows.items():
            command = f"graspd evaluate {name} --protocol {protocol} --data DIR --seeds 1 --jobs 2"
            minutes = MINUTES.get((name, protocol), 1)
            yield (name, *words, place, command, str(minutes))


def quick_seconds(system: System) -> float:
    """Return the approximate time of a `--quick` training, s of one core, mean of all protocols."""
    match system.estimator:
        case NetworkConfig(hidden=1024):
            return 0.4
        case ForestConfig() | BoostingConfig():
            return 0.5
        case _:
            return 0.1


def layers(estimator: Estimator) -> str:
    """Return the parts of an estimator as text, such as `Conv32 3x3 - MaxPool2 - FC1024`."""
    match estimator:
        case NetworkConfig():
            second = estimator.second
            parts = [
                f"Conv{estimator.filters} 3x3",
                "MaxPool2" if estimator.pool else "",
                f"Conv{second.filters} {second.kernel}x{second.kernel}" if second else "",
                f"FC{estimator.hidden}",
            ]
            extra = f", dropout {estimator.dropout:g}" if estimator.dropout else ""
            plain = "" if estimator.batch_norm else ", no batch norm"
            return " - ".join(filter(None, parts)) + extra + plain
        case SvmConfig():
            return f"SVM, C {estimator.c:g}, gamma {estimator.gamma}"
        case ForestConfig():
            return f"random forest, {estimator.trees} trees"
        case MlpConfig():
            return "MLP, " + " - ".join(map(str, estimator.hidden))
        case BoostingConfig():
            return f"boosting, {estimator.iterations} trees of {estimator.leaves} leaves"
        case blend:
            return " + ".join(f"{one.copies} {layers(one.estimator)}" for one in blend.members)


def taken(system: System) -> str:
    """Return the input of a system as text, such as layout, fill and composition of its image."""
    words = _input(system.input)
    if system.augmentation is not None:
        words += ", flipped and rotated too"
    if system.fingers != TABLE_FINGERS:
        words += f", of {' and '.join(system.fingers)}"
    return words


def _input(kind: SystemInput) -> str:
    match kind:
        case ImageInput():
            return f"image {kind.layout}, {kind.fill}, {kind.composition}"
        case VectorInput():
            return "72 counts, z-scored by finger"
        case CountsInput():
            return "counts, standardised by electrode"
        case _:
            return "z-scored counts, calibrated by the session"
