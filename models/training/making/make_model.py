"""Make a model file and its card from grasp tables: measure, calibrate, train, export."""

from __future__ import annotations

import hashlib
import platform
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from graspd.models.bts3 import CITATIONS, LICENCE, REPOSITORY
from graspd.models.contract import (
    CLASSES,
    ConfidenceStep,
    Dataset,
    MeasuredError,
    ModelContract,
    Sharpness,
)
from graspd.models.training.data.datasets import ENOUGH_GRASPS, Grasps, lab_table_names, unpublished
from graspd.models.training.estimators.graphs import OPSET
from graspd.models.training.evaluating.broken import broken_study
from graspd.models.training.evaluating.figures import (
    COVERAGES,
    Figures,
    by_age,
    by_day,
    made_with,
    right,
    temperature,
    with_probability,
)
from graspd.models.training.evaluating.files import to_json, write_whole
from graspd.models.training.evaluating.frame import evaluated, judged, processes
from graspd.models.training.evaluating.metrics import (
    FEWEST_JUDGED,
    confusion,
    coverage_curve,
    f1_interval,
    verdict_figures,
)
from graspd.models.training.fitting.novelty import held_out_never_seen, made_up_never_seen
from graspd.models.training.fitting.standards import Variant
from graspd.models.training.fitting.trained import Trained, train
from graspd.models.training.making.export import export
from graspd.models.training.making.plan import TrainingPlan
from graspd.models.training.systems.explained import layers, taken
from graspd.models.training.systems.registry import configuration

LIBRARIES = ("numpy", "onnx", "onnxruntime", "onnxscript", "scikit-learn", "skl2onnx", "torch")
EXTRA_TRAININGS = 2
"""Number of counted trainings after the folds: the first fold again, and the final model."""

PUBLISHED_DATA = "The data is of one hand and 41 objects, lifted in one way."
WEAK_POINTS = (
    "A wrong electrode that keeps within what its neighbours allow is not noticed.",
    "Readings are compared with the training's covariance: what varies like a grasp without being "
    "one, such as hum on all electrodes, may be judged.",
)

OWN_LICENCE = "whatever the owner of the tables says"
"""Licence text for data without a published table."""


def make_model(
    plan: TrainingPlan, grasps: Grasps, out: Path, on_done: Callable[[], None]
) -> ModelContract:
    """Write `NAME.onnx` and its card `NAME.json` into `out`, which keeps the trainings too; return
    its contract.

    `grasps`: grasps of all given tables. `on_done`: called after each of the plan's
    jobs and of the `EXTRA_TRAININGS`. Raises `TooFewGraspsError` if the grasps are too few for the
    folds, `ExportError` if the file does not judge as the system does, `OSError` if a folder
    cannot be written.
    """
    wanted = plan.jobs(grasps)
    found = {}
    with processes(plan.processes):
        for job, rows in evaluated(wanted, grasps, out / "trainings"):
            found[job] = rows
            on_done()
    every = pd.concat([found[job] for job in wanted], ignore_index=True)
    measured = [
        Figures.of(with_probability(rows)) for _, rows in every.groupby("protocol", sort=False)
    ]
    again = judged(wanted[0], grasps)
    on_done()
    system = plan.system
    trained = train(system, plan.chosen(grasps).of_fingers(system.fingers), plan.seed)
    on_done()
    contract = _contract(plan, trained, measured)
    path = out / f"{plan.model}.onnx"
    calibrator = _calibrator(measured)
    of_margins = temperature(calibrator.of_variant())
    tables = trained.standards
    standards = None if tables is None else tables.each(trained.grasps.table_of)
    parity = export(trained.fitted, of_margins, contract, trained.grasps.counts, path, standards)
    data, first = path.read_bytes(), found[wanted[0]]
    card = {
        "what": f"{layers(system.estimator)} on {taken(system)}.",
        "contract": contract,
        "file": {
            "sha256": hashlib.sha256(data).hexdigest(),
            "size_bytes": len(data),
            "opset": OPSET,
            "parity": parity,
        },
        "parameters": trained.fitted.parameters,
        "data": _data_sources(grasps.files),
        "system": configuration(system, "input", "estimator", "recipe", "augmentation", "tables"),
        "protocols": {one.protocol: _card_figures(one) for one in measured},
        "temperature": of_margins,
        "calibrated_by": calibrator.protocol,
        "broken": None if plan.only else broken_study(system, trained.grasps, plan.seed),
        "never_seen": _never_seen(trained, contract, plan.seed),
        # Training the first fold again has given bit-identical margins.
        "same_seed_same_margins": first["margin"].equals(again["margin"]),
        "command": plan.command,
        "made_with": made_with(LIBRARIES) | {"machine": platform.machine()},
        "weak_points": _weak_points(measured, trained.grasps),
        "worth": None,  # `graspd report worth --card` fills it in
    }
    write_whole(path.with_suffix(".json"), to_json(card))
    return contract


def _calibrator(measured: list[Figures]) -> Figures:
    """Return the figures that calibrate probabilities: those of new objects, if measured."""
    return measured[min(1, len(measured) - 1)]


def _contract(plan: TrainingPlan, trained: Trained, measured: list[Figures]) -> ModelContract:
    return ModelContract(
        version=2,
        name=plan.model,
        input=trained.takes(_sharpness(measured)),
        fingers=plan.system.fingers,
        classes=CLASSES,
        seed=plan.seed,
        datasets=tuple(file for file in trained.grasps.files if file.rows),
        measured=tuple(map(_measured, measured)),
        confidence=_confidence(_calibrator(measured)),
        seen=trained.seen(),
    )


def _confidence(one: Figures) -> tuple[ConfidenceStep, ...]:
    """Return the steps of the accuracy-coverage curve with at least `FEWEST_JUDGED` grasps."""
    rows = one.of_variant()
    return tuple(
        step
        for step in reversed(coverage_curve(rows["probability"], rows["slipped"]))
        if round(step.coverage * len(rows)) >= FEWEST_JUDGED
    )


def _measured(one: Figures) -> MeasuredError:
    f1, accuracy = one.spread("f1"), one.spread("accuracy")
    return MeasuredError(one.protocol, one.folds, f1.mean, f1.std, accuracy.mean, accuracy.std)


def _sharpness(measured: list[Figures]) -> tuple[Sharpness, ...]:
    """Return a session's temperatures by age, divided by the model's own: 1 or more, never rising.

    A single one, 1, if no running session was measured on other days.
    """
    base = temperature(_calibrator(measured).of_variant())
    later = next((one for one in measured if one.protocol == "days"), None)
    if later is None or Variant.RUNNING not in later.variants:
        return (Sharpness(0.0, 1.0),)
    steps: list[Sharpness] = []
    for age, part in reversed(by_age(later.of_variant(Variant.RUNNING)).items()):
        least = steps[-1].temperature if steps else 1.0
        steps.append(Sharpness(float(age), max(least, temperature(part) / base)))
    return tuple(reversed(steps))


def _never_seen(trained: Trained, contract: ModelContract, seed: int) -> dict[str, object]:
    """Return the fractions of readings that the contract's `seen` refuses.

    `held_out_object`: fraction of all grasps refused if their object is not trained on; None if one
    object has all grasps, or all but one.
    `made_up`: fraction of synthetic readings before any repair, by the way they were made.
    """
    grasps, seen = trained.grasps, contract.seen
    objects, counts = np.array(grasps.objects), trained.mapped(grasps.counts, grasps.table_of)
    # A covariance needs at least two grasps of other objects.
    several = len(objects) - max(Counter(grasps.objects).values()) > 1
    return {
        "held_out_object": held_out_never_seen(counts, objects, seen.margin) if several else None,
        "made_up": made_up_never_seen(counts, seen, seed),
    }


def _data_sources(files: Sequence[Dataset]) -> dict[str, object]:
    """Return licence and sources of the tables used for training or judging, for a card.

    `not_published` of the result: files to which they do not apply, as these are not published.
    """
    not_published = unpublished(files)
    sources: dict[str, object]
    if len(lab_table_names(files)) == len(files):
        sources = {"licence": OWN_LICENCE, "repository": None, "cite": ()}
    else:
        sources = {"licence": LICENCE, "repository": REPOSITORY, "cite": CITATIONS}
    return {**sources, "not_published": not_published}


def _card_figures(one: Figures) -> dict[str, object]:
    """Return the figures of a protocol that a user of the model needs, slip positive.

    `calibrated_by`: F1 by variant of session calibration; empty if there is one variant.
    `f1_interval`: over all grasps, for other objects; None: of one object, or without a slip.
    """
    rows = one.of_variant()
    several = one.variants if len(one.variants) > 1 else []
    return {
        "folds": one.folds,
        "train_grasps": float(one.trainings["train_grasps"].mean()),
        "test_grasps": one.test_grasps,
        "spreads": {figure: one.spread(figure) for figure in one.scores},
        "temperature": temperature(rows),
        "confusion": confusion(rows).tolist(),
        "f1_interval": f1_interval(rows),
        "palms": {table: _share(part) for table, part in rows.groupby("table")},
        "objects": {
            name: {"share": _share(part), "f1": verdict_figures(part)["f1"]}
            for name, part in rows.groupby("object")
        },
        "accuracy_at_coverage": {f"{share:g}": one.accuracy_at(share) for share in COVERAGES},
        "calibrated_by": {variant: one.spread(variant=variant) for variant in several},
        "days": by_day(rows) if one.protocol == "days" else {},
    }


def _share(rows: pd.DataFrame) -> dict[str, object]:
    return {"grasps": len(rows), "accuracy": float(right(rows).mean())}


def _weak_points(measured: Sequence[Figures], grasps: Grasps) -> tuple[str, ...]:
    """Return sentences with figures on what the model cannot do; `grasps`: its training."""
    texts = []
    for one in measured:
        f1, rows = 100 * one.spread().mean, one.of_variant()
        if one.protocol.startswith("objects"):
            shares = right(rows).groupby(rows["object"]).mean()
            texts.append(
                f"New objects do worse than known ones: F1 {f1:.1f} %; the worst is "
                f"{shares.idxmin()}, of which {100 * shares.min():.0f} % are judged rightly."
            )
        elif one.protocol == "days":
            figures = verdict_figures(rows)
            among, missed = figures["slips_among_stable"], figures["slips_called_stable"]
            if among is not None and missed is not None:
                texts.append(
                    f"On days that it was not trained on, with new objects, {100 * among:.0f} % of "
                    f"what it calls stable slips, and {100 * missed:.0f} % of the slips are called "
                    "stable, as long as it is told no outcomes."
                )
        elif one.protocol == "session" and one.headline != Variant.NONE:
            none = 100 * one.spread(variant=Variant.NONE).mean
            texts.append(
                f"On another day it needs the session's grasps: F1 {none:.1f} % without any, "
                f"{f1:.1f} % with fifty."
            )
        elif one.protocol == "session":
            texts.append(
                f"On another day (palm_45: same hand, other palm pose, drifted sensors) F1 is "
                f"{f1:.1f} %: it still ranks (AUC {one.spread('auc').mean:.2f}), its zero has "
                "moved. What looks unlike the training data is refused."
            )
    own = lab_table_names(grasps.files)
    return (*texts, *(_own_data(grasps, own, measured) if own else [PUBLISHED_DATA]), *WEAK_POINTS)


def _own_data(grasps: Grasps, own: Sequence[str], measured: Sequence[Figures]) -> Iterator[str]:
    objects, tables = len(set(grasps.objects)), sum(file.rows > 0 for file in grasps.files)
    yield (
        f"The data is of {objects} {'object' if objects == 1 else 'objects'} in {tables} "
        f"{'table' if tables == 1 else 'tables'}. Not published: {', '.join(own)}."
    )
    if any(one.protocol == "session" for one in measured):
        yield "The figures of another day are of the published tables alone."
    else:
        yield "What it is worth on another day than those of its data was not measured."
    if len(grasps) < ENOUGH_GRASPS:
        yield (
            f"{len(grasps)} grasps, {int(grasps.slipped.sum())} of which slipped, are few: the "
            "daemon takes many others for unlike the training, and calls them unknown; "
            f"{ENOUGH_GRASPS} are enough."
        )
