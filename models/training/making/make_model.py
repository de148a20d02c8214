"""Make a model file and its card from grasp tables: measure, calibrate, train, export."""

from __future__ import annotations

import hashlib
import platform
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from graspd.models.contract import (
    CLASSES,
    ConfidenceStep,
    Input,
    MeasuredError,
    ModelContract,
    SessionInput,
    Sharpness,
)
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.estimators.graphs import OPSET
from graspd.models.training.evaluating import jobs
from graspd.models.training.evaluating.broken import broken_study
from graspd.models.training.evaluating.days import CALIBRATED_FROM
from graspd.models.training.evaluating.files import to_json, write_whole
from graspd.models.training.evaluating.metrics import FEWEST_JUDGED
from graspd.models.training.evaluating.run_jobs import run_jobs
from graspd.models.training.evaluating.summaries import SystemSummary, made_with, summarise
from graspd.models.training.fitting.novelty import held_out_never_seen, made_up_never_seen
from graspd.models.training.fitting.standards import PRIOR_GRASPS, RUNNING
from graspd.models.training.fitting.trained import Trained, train
from graspd.models.training.making.card import data_sources, measured, weak_points
from graspd.models.training.making.export import export
from graspd.models.training.making.plan import TrainingPlan
from graspd.models.training.systems.system import SessionFeatures, System, configuration

LIBRARIES = ("numpy", "onnx", "onnxruntime", "onnxscript", "scikit-learn", "skl2onnx", "torch")
EXTRA_TRAININGS = 2
"""Trainings beside the folds: one for repeatability, one for the model itself.

The study of broken electrodes, three more, comes last.
"""


def make_model(
    plan: TrainingPlan, grasps: Grasps, out: Path, results: Path, on_done: Callable[[], None]
) -> ModelContract:
    """Write `NAME.onnx` and its card `NAME.json` into `out`; trainings are kept in `results`.

    `grasps` are those of all tables that there are. `on_done` is called after each of the plan's
    jobs and of the `EXTRA_TRAININGS`. Raises `TooFewGraspsError` if the grasps are too few for the
    folds, `ExportError` if the file does not judge as the system does, `OSError` if a folder
    cannot be written.
    """
    wanted = plan.jobs(grasps)
    found = {}
    for job, result in run_jobs(wanted, grasps, results, processes=plan.processes):
        found[job] = result
        on_done()
    summaries = [
        summarise({job: found[job] for job in wanted if job.protocol == protocol}, grasps)
        for protocol in plan.protocols(grasps)
    ]
    again = jobs.run(wanted[0], grasps)
    on_done()
    system = plan.system
    trained = train(system, plan.chosen(grasps).of_fingers(system.fingers), plan.seed)
    on_done()
    contract = _contract(plan, trained, summaries)
    calibrator = _calibrator(summaries)
    path = out / f"{plan.model}.onnx"
    temperature = calibrator.main.temperature
    tables = trained.standards
    standards = None if tables is None else tables.each(trained.grasps.table_of)
    parity = export(trained.fitted, temperature, contract, trained.grasps.counts, path, standards)
    data, first = path.read_bytes(), found[wanted[0]]
    card = {
        "what": system.description,
        "contract": contract,
        "file": {
            "sha256": hashlib.sha256(data).hexdigest(),
            "size_bytes": len(data),
            "opset": OPSET,
            "parity": parity,
        },
        "parameters": trained.fitted.parameters,
        "data": data_sources(grasps.files),
        "system": configuration(system, "input", "estimator", "recipe", "augmentation", "tables"),
        "protocols": {summary.protocol: measured(summary) for summary in summaries},
        "temperature": temperature,
        "calibrated_by": calibrator.protocol,
        "broken": None if plan.only else broken_study(system, trained.grasps, plan.seed),
        "never_seen": _never_seen(trained, contract, plan.seed),
        # Training the first fold again gave bit-identical margins.
        "same_seed_same_margins": all(
            np.array_equal(margins, again.margins[name]) for name, margins in first.margins.items()
        ),
        "command": plan.command,
        "made_with": made_with(LIBRARIES) | {"machine": platform.machine()},
        "weak_points": weak_points(summaries, trained.grasps),
        "worth": None,  # `graspd report worth --card` fills it in
    }
    write_whole(path.with_suffix(".json"), to_json(card))
    return contract


def _calibrator(summaries: list[SystemSummary]) -> SystemSummary:
    """Return the summary that calibrates probabilities: of new objects, if measured."""
    return summaries[min(1, len(summaries) - 1)]


def _contract(
    plan: TrainingPlan, trained: Trained, summaries: list[SystemSummary]
) -> ModelContract:
    return ModelContract(
        version=2,
        name=plan.model,
        input=_input(plan.system, trained, summaries),
        fingers=plan.system.fingers,
        classes=CLASSES,
        seed=plan.seed,
        datasets=tuple(file for file in trained.grasps.files if file.rows),
        measured=tuple(map(_measured, summaries)),
        confidence=_confidence(_calibrator(summaries)),
        seen=trained.seen(),
    )


def _confidence(summary: SystemSummary) -> tuple[ConfidenceStep, ...]:
    """Return the steps with enough grasps; few grasps do not show how often they are right."""
    judged = summary.folds * summary.test_grasps
    return tuple(
        ConfidenceStep(point.confidence, point.accuracy, point.coverage)
        for point in reversed(summary.main.curve)
        if round(point.coverage * judged) >= FEWEST_JUDGED
    )


def _measured(summary: SystemSummary) -> MeasuredError:
    f1, accuracy = summary.main.spreads["f1"], summary.main.spreads["accuracy"]
    return MeasuredError(
        summary.protocol, summary.folds, f1.mean, f1.std, accuracy.mean, accuracy.std
    )


def _input(system: System, trained: Trained, summaries: list[SystemSummary]) -> Input:
    if not isinstance(system.input, SessionFeatures):
        return system.input
    if trained.standards is None:
        raise ValueError("a session system was trained without standards")
    prior = trained.standards.prior
    return SessionInput(
        mean=tuple(prior.mean.tolist()),
        spread=tuple(prior.spread.tolist()),
        clip=system.input.clip,
        prior_grasps=PRIOR_GRASPS,
        calibrated_from=float(CALIBRATED_FROM),
        sharpness=_sharpness(summaries),
    )


def _sharpness(summaries: list[SystemSummary]) -> tuple[Sharpness, ...]:
    """Return the temperatures of a young session, which is never surer than a calibrated one."""
    base = _calibrator(summaries).main.temperature
    later = next((s for s in summaries if s.protocol == "days"), None)
    if later is None:
        return (Sharpness(0.0, 1.0),)
    steps: list[Sharpness] = []
    for age in reversed(later.variants[RUNNING].ages):
        least = steps[-1].temperature if steps else 1.0
        steps.append(Sharpness(float(age.grasps_before), max(least, age.temperature / base)))
    return tuple(reversed(steps))


def _never_seen(trained: Trained, contract: ModelContract, seed: int) -> dict[str, object]:
    """Return the fractions of readings that the contract's `seen` refuses.

    `held_out_object`: of grasps of an object, by the other objects. `made_up`: of readings that no
    hand ever made, before any repair, by the way they were made up.
    """
    grasps, margin = trained.grasps, trained.margin
    objects, counts = np.array(grasps.objects), trained.mapped(grasps.counts, grasps.table_of)
    # Two of other objects at least have a covariance.
    several = len(objects) - max(Counter(grasps.objects).values()) > 1
    return {
        "held_out_object": held_out_never_seen(counts, objects, margin) if several else None,
        "made_up": made_up_never_seen(counts, contract.seen, seed),
    }
