"""The model card: a JSON file beside the model that says how it was made and what it is worth."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from graspd.models.bts3 import CITATIONS, LICENCE, REPOSITORY
from graspd.models.contract import Dataset, ModelContract
from graspd.models.training.data.datasets import Grasps, lab_table_names, unpublished
from graspd.models.training.data.lab_tables import ENOUGH_GRASPS
from graspd.models.training.estimators.graphs import OPSET
from graspd.models.training.evaluating.broken import Study
from graspd.models.training.evaluating.day_figures import DayFigures
from graspd.models.training.evaluating.metrics import CurvePoint, Fraction, Spread
from graspd.models.training.evaluating.summaries import ObjectFigures, SystemSummary, Variant
from graspd.models.training.making.export import Parity

LIBRARIES = ("numpy", "onnx", "onnxruntime", "onnxscript", "scikit-learn", "skl2onnx", "torch")

PUBLISHED_DATA = "The data is of one hand and 41 objects, lifted in one way."
WEAK_POINTS = (
    "A wrong electrode that keeps within what its neighbours allow is not noticed.",
    "Readings are compared with the training's covariance: what varies like a grasp without being "
    "one, such as hum on all electrodes, may be judged.",
)

OWN_LICENCE = "whatever the owner of the tables says"
"""Of data without a published table."""


class ExportedFile(msgspec.Struct, frozen=True):
    """The ONNX file that the card is about."""

    sha256: str
    size_bytes: int
    opset: int
    parity: Parity

    @classmethod
    def of(cls, path: Path, parity: Parity) -> ExportedFile:
        data = path.read_bytes()
        return cls(hashlib.sha256(data).hexdigest(), len(data), OPSET, parity)


class Data(msgspec.Struct, frozen=True):
    """Where the data comes from. Digests and rows stand in the contract."""

    licence: str = LICENCE
    repository: str | None = REPOSITORY
    cite: tuple[str, ...] = CITATIONS
    not_published: tuple[str, ...] = ()
    """Files that differ from the published ones: licence and sources above are not theirs."""

    @classmethod
    def of(cls, files: Sequence[Dataset]) -> Data:
        """Of the tables that were trained on or judged by."""
        not_published = tuple(unpublished(files))
        if len(lab_table_names(files)) < len(files):
            return cls(not_published=not_published)
        return cls(OWN_LICENCE, None, (), not_published)


class Measured(msgspec.Struct, frozen=True):
    """One protocol: every figure is a fraction, slip positive, mean and spread over the folds."""

    folds: int
    train_grasps: float
    test_grasps: float
    spreads: dict[str, Spread]
    temperature: float
    """Makes these margins probabilities; Brier score and the like are cross-fitted."""
    confusion: list[list[int]]
    """Rows stable, slip as it was; columns as it was judged."""
    palms: dict[str, Fraction]
    objects: dict[str, ObjectFigures]
    accuracy_at_coverage: dict[str, float]
    thresholds: dict[str, CurvePoint | None]
    """By wanted accuracy: from which confidence on."""
    calibrated_by: dict[str, Spread]
    """F1 by how the session was calibrated; empty where no session is left out."""
    days: dict[str, DayFigures]
    """Of the protocol `days`, by group of streams."""

    @classmethod
    def of(cls, summary: SystemSummary) -> Measured:
        """The figures of a summary that a user of the model needs."""
        main: Variant = summary.main
        several = summary.variants if len(summary.variants) > 1 else {}
        return cls(
            folds=summary.folds,
            train_grasps=summary.train_grasps,
            test_grasps=summary.test_grasps,
            spreads=main.spreads,
            temperature=main.temperature,
            confusion=main.confusion,
            palms=main.palms,
            objects=main.objects,
            accuracy_at_coverage=main.coverages,
            thresholds=main.thresholds,
            calibrated_by={name: variant.spreads["f1"] for name, variant in several.items()},
            days=main.days,
        )


class NeverSeen(msgspec.Struct, frozen=True):
    """Fraction of readings that the contract's `seen` refuses."""

    held_out_object: float | None
    """Grasps of an object, by the other objects; None if there is only one."""
    made_up: dict[str, float]
    """Readings that no hand ever made, by the way they were made up; before any repair."""


class Card(msgspec.Struct, frozen=True):
    """Everything that is known about one model file."""

    what: str
    contract: ModelContract
    """Word for word what stands in the file."""
    file: ExportedFile
    parameters: int
    """How many numbers the model consists of."""
    data: Data
    system: dict[str, Any]
    """Its configuration."""
    protocols: dict[str, Measured]
    temperature: float
    """In the file, fitted on the margins of `calibrated_by`: grasps that were not trained on."""
    calibrated_by: str
    broken: Study | None
    """What broken electrodes cost, and what is left of that after their repair; None if it was not
    studied."""
    never_seen: NeverSeen
    same_seed_same_margins: bool
    """Training the first fold again gave bit-identical margins."""
    command: str
    """Makes the file again, byte for byte on a machine of the same kind."""
    made_with: dict[str, str]
    weak_points: tuple[str, ...]
    worth: dict[str, Any] | None = None
    """What `graspd report worth --card` measured of networks of this system; None: nothing."""


def weak_points(summaries: Sequence[SystemSummary], grasps: Grasps) -> tuple[str, ...]:
    """Sentences on what the model cannot do, with measured figures; `grasps` are trained on."""
    texts = []
    for summary in summaries:
        f1 = 100 * summary.main.spreads["f1"].mean
        if summary.protocol.startswith("objects"):
            worst = min(summary.main.objects.items(), key=lambda item: item[1].share.accuracy)
            texts.append(
                f"New objects do worse than known ones: F1 {f1:.1f} %; the worst is {worst[0]}, "
                f"of which {100 * worst[1].share.accuracy:.0f} % are judged rightly."
            )
        elif summary.protocol == "days":
            figures = summary.main.days["all"].every
            among, missed = figures.slips_among_stable, figures.slips_called_stable
            if among is not None and missed is not None:
                texts.append(
                    f"On days that it was not trained on, with new objects, {100 * among:.0f} % of "
                    f"what it calls stable slips, and {100 * missed:.0f} % of the slips are called "
                    "stable, as long as it is told no outcomes."
                )
        elif summary.protocol == "session" and len(summary.variants) > 1:
            none = 100 * summary.variants["none"].spreads["f1"].mean
            texts.append(
                f"On another day it needs the session's grasps: F1 {none:.1f} % without any, "
                f"{f1:.1f} % with fifty."
            )
        elif summary.protocol == "session":
            auc = summary.main.spreads["auc"].mean
            texts.append(
                f"On another day (palm_45: same hand, other palm pose, drifted sensors) F1 is "
                f"{f1:.1f} %: it still ranks (AUC {auc:.2f}), its zero has moved. What looks "
                "unlike the training data is refused."
            )
    own = lab_table_names(grasps.files)
    return (*texts, *(_own_data(grasps, own, summaries) if own else [PUBLISHED_DATA]), *WEAK_POINTS)


def _own_data(
    grasps: Grasps, own: Sequence[str], summaries: Sequence[SystemSummary]
) -> Iterator[str]:
    objects, tables = len(set(grasps.objects)), sum(file.rows > 0 for file in grasps.files)
    yield (
        f"The data is of {objects} {'object' if objects == 1 else 'objects'} in {tables} "
        f"{'table' if tables == 1 else 'tables'}. Not published: {', '.join(own)}."
    )
    if any(summary.protocol == "session" for summary in summaries):
        yield "The figures of another day are of the published tables alone."
    else:
        yield "What it is worth on another day than those of its data was not measured."
    if len(grasps) < ENOUGH_GRASPS:
        yield (
            f"{len(grasps)} grasps, {int(grasps.slipped.sum())} of which slipped, are few: the "
            "daemon takes many others for unlike the training, and calls them unknown; "
            f"{ENOUGH_GRASPS} are enough."
        )
