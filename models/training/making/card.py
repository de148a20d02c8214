"""Parts of a model card, the JSON file beside a model that says what the model is worth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from graspd.models.bts3 import CITATIONS, LICENCE, REPOSITORY
from graspd.models.contract import Dataset
from graspd.models.training.data.datasets import ENOUGH_GRASPS, Grasps, lab_table_names, unpublished
from graspd.models.training.evaluating.summaries import SystemSummary

PUBLISHED_DATA = "The data is of one hand and 41 objects, lifted in one way."
WEAK_POINTS = (
    "A wrong electrode that keeps within what its neighbours allow is not noticed.",
    "Readings are compared with the training's covariance: what varies like a grasp without being "
    "one, such as hum on all electrodes, may be judged.",
)

OWN_LICENCE = "whatever the owner of the tables says"
"""Licence of data without a published table."""


def data_sources(files: Sequence[Dataset]) -> dict[str, object]:
    """Return licence and sources of the tables used for training or judging.

    Files under `not_published` differ from the published ones: the rest is not about them.
    """
    not_published = unpublished(files)
    sources: dict[str, object]
    if len(lab_table_names(files)) == len(files):
        sources = {"licence": OWN_LICENCE, "repository": None, "cite": ()}
    else:
        sources = {"licence": LICENCE, "repository": REPOSITORY, "cite": CITATIONS}
    return {**sources, "not_published": not_published}


def measured(summary: SystemSummary) -> dict[str, object]:
    """Return the figures of a protocol that a user of the model needs, slip positive.

    `calibrated_by`: F1 by variant of session calibration; empty where no session is left out.
    """
    main = summary.main
    several = summary.variants if len(summary.variants) > 1 else {}
    return {
        "folds": summary.folds,
        "train_grasps": summary.train_grasps,
        "test_grasps": summary.test_grasps,
        "spreads": main.spreads,
        "temperature": main.temperature,
        "confusion": main.confusion,
        "palms": main.palms,
        "objects": main.objects,
        "accuracy_at_coverage": main.coverages,
        "thresholds": main.thresholds,
        "calibrated_by": {name: variant.spreads["f1"] for name, variant in several.items()},
        "days": main.days,
    }


def weak_points(summaries: Sequence[SystemSummary], grasps: Grasps) -> tuple[str, ...]:
    """Return sentences on what the model cannot do, with figures; `grasps` are trained on."""
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
