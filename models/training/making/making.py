"""From grasp tables to a model file and its card: measure, calibrate, train, export."""

from __future__ import annotations

import hashlib
import shlex
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from models.bts3 import NEW_SESSION, TABLES, WHOLE
from models.contract import (
    CLASSES,
    ConfidenceStep,
    Input,
    MeasuredError,
    ModelContract,
    SessionInput,
    Sharpness,
)
from models.training.data.datasets import Grasps
from models.training.data.protocols import Protocol
from models.training.estimators.graphs import OPSET
from models.training.evaluating import jobs
from models.training.evaluating.broken import broken_study
from models.training.evaluating.jobs import Job, JobResult
from models.training.evaluating.metrics import FEWEST_JUDGED
from models.training.evaluating.summary import Summary, summarise
from models.training.evaluating.sweep import sweep
from models.training.fitting.seen import held_out_never_seen, made_up_never_seen, seen_counts
from models.training.fitting.standards import PRIOR_GRASPS, RUNNING
from models.training.fitting.trained import Trained, train
from models.training.making import card as cards
from models.training.making.export import Parity, SessionStandards, export
from models.training.systems.system import SessionFeatures, System

CALIBRATED_FROM = 20.0
"""Grasps from which on a session counts as calibrated: later ones gain two points at most."""
EXTRA_TRAININGS = 2
"""Beside the folds: one for the repeatability, one for the model itself. The study of broken
electrodes, three more, comes last."""


@dataclass(frozen=True, slots=True)
class Order:
    """What to make."""

    system: System
    folds: int
    seed: int
    processes: int = 1
    only: Protocol | None = None
    """Measured by this protocol alone, and without broken electrodes: for a model that is compared
    and not used."""
    own: tuple[str, ...] = ()
    """Names of the files of one's own that are trained on, with their endings."""

    def protocols(self, grasps: Grasps) -> tuple[Protocol, ...]:
        """By what it is measured: `cv` first; the second, with new objects, calibrates it."""
        if self.only is not None:
            return (self.only,)
        there = {file.name for file in grasps.files}
        if not there.intersection(WHOLE):
            return ("cv", "objects")
        if NEW_SESSION not in there:
            return ("cv", "objects-whole")
        objects: Protocol = "objects" if NEW_SESSION in self.system.tables else "objects-whole"
        return ("cv", objects, "session")

    def jobs(self, grasps: Grasps) -> list[Job]:
        """Every training that is judged."""
        return [
            Job(self.system, protocol, self.seed, fold, self.folds)
            for protocol in self.protocols(grasps)
            for fold in range(self.folds)
        ]

    @property
    def command(self) -> str:
        """The command line that repeats it, without the folders of this machine."""
        published = [table.name for table in TABLES if table.name in self.system.tables]
        data = ["--data DIR"] if published else []
        data += [f"--own {shlex.quote(name)}" for name in self.own]
        only = [] if self.only is None else [f"--only {self.only}"]
        words = (*data, f"--seed {self.seed}", f"--folds {self.folds}", *only)
        return " ".join(("graspd train", self.system.name, *words))


def make(
    order: Order, grasps: Grasps, out: Path, results: Path, on_done: Callable[[], None]
) -> cards.Card:
    """Write `<name>.onnx` and `<name>.json` into the folder `out`; trainings are kept in `results`.

    `grasps` are all tables that there are. Raises `TooFewGraspsError` if they are too few for the
    folds, `ExportError` if the file does not judge as the system does, `OSError` if a folder
    cannot be written.
    """
    wanted = order.jobs(grasps)
    found = sweep(wanted, grasps, results, processes=order.processes, on_done=on_done)
    summaries = _summaries(order, grasps, found)
    again = jobs.run(wanted[0], grasps)
    on_done()
    chosen = grasps.of_tables(order.system.tables).of_fingers(order.system.fingers)
    trained = train(order.system, chosen, order.seed)
    on_done()
    contract = _contract(order, trained, summaries)
    calibrator = _calibrator(summaries)
    path = out / f"{order.system.name}.onnx"
    temperature = calibrator.main.temperature
    parity = export(
        trained.fitted, temperature, contract, trained.grasps.counts, path, _sessions(trained)
    )
    card = cards.Card(
        what=order.system.description,
        contract=contract,
        file=_file(path, parity),
        parameters=trained.fitted.parameters,
        data=cards.Data.of(grasps.files),
        system=cards.configuration(order.system),
        protocols={summary.protocol: cards.Measured.of(summary) for summary in summaries},
        temperature=temperature,
        calibrated_by=calibrator.protocol,
        broken=(
            None
            if order.only is not None
            else broken_study(order.system, trained.grasps, order.seed)
        ),
        never_seen=_never_seen(trained, contract, order.seed),
        same_seed_same_margins=_same(found[0], again),
        command=order.command,
        made_with=cards.made_with(),
        weak_points=cards.weak_points(summaries, trained.grasps),
    )
    cards.write(card, path.with_suffix(".json"))
    return card


def _calibrator(summaries: list[Summary]) -> Summary:
    """What probabilities are calibrated by: new objects, where they were measured."""
    return summaries[min(1, len(summaries) - 1)]


def _summaries(order: Order, grasps: Grasps, found: list[JobResult]) -> list[Summary]:
    return [
        summarise(
            order.system,
            protocol,
            {order.seed: found[index * order.folds : (index + 1) * order.folds]},
            grasps,
        )
        for index, protocol in enumerate(order.protocols(grasps))
    ]


def _contract(order: Order, trained: Trained, summaries: list[Summary]) -> ModelContract:
    return ModelContract(
        version=2,
        name=order.system.name,
        input=_input(order.system, trained, summaries),
        fingers=order.system.fingers,
        classes=CLASSES,
        seed=order.seed,
        datasets=tuple(file for file in trained.grasps.files if file.rows),
        measured=tuple(map(_measured, summaries)),
        confidence=_confidence(_calibrator(summaries)),
        seen=seen_counts(_mapped(trained), trained.looks.margin),
    )


def _confidence(summary: Summary) -> tuple[ConfidenceStep, ...]:
    """Of few grasps the surest are too few to say how often they are right."""
    judged = summary.folds * summary.test_grasps
    return tuple(
        ConfidenceStep(point.confidence, point.accuracy, point.coverage)
        for point in reversed(summary.main.curve)
        if round(point.coverage * judged) >= FEWEST_JUDGED
    )


def _measured(summary: Summary) -> MeasuredError:
    f1, accuracy = summary.main.spreads["f1"], summary.main.spreads["accuracy"]
    return MeasuredError(
        summary.protocol, summary.folds, f1.mean, f1.std, accuracy.mean, accuracy.std
    )


def _input(system: System, trained: Trained, summaries: list[Summary]) -> Input:
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
        calibrated_from=CALIBRATED_FROM,
        sharpness=_sharpness(summaries),
    )


def _sharpness(summaries: list[Summary]) -> tuple[Sharpness, ...]:
    """How much less sure a young session is than the calibrated model, never more sure."""
    base = _calibrator(summaries).main.temperature
    later = next((s for s in summaries if s.protocol == "session"), None)
    if later is None:
        return (Sharpness(0.0, 1.0),)
    steps: list[Sharpness] = []
    for age in reversed(later.variants[RUNNING].ages):
        least = steps[-1].temperature if steps else 1.0
        steps.append(Sharpness(float(age.grasps_before), max(least, age.temperature / base)))
    return tuple(reversed(steps))


def _sessions(trained: Trained) -> SessionStandards | None:
    """For the parity check: every grasp standardised by its own table, as in training."""
    if trained.standards is None:
        return None
    standards = trained.standards.each(trained.grasps.table_of)
    return SessionStandards(standards.mean, standards.spread)


def _mapped(trained: Trained) -> NDArray[np.float64]:
    grasps = trained.grasps
    return trained.looks.to_training(grasps.counts, grasps.table_of)


def _never_seen(trained: Trained, contract: ModelContract, seed: int) -> cards.NeverSeen:
    objects = np.array(trained.grasps.objects)
    counts, margin = _mapped(trained), trained.looks.margin
    # Two of other objects at least have a covariance.
    several = len(objects) - max(Counter(trained.grasps.objects).values()) > 1
    return cards.NeverSeen(
        held_out_object=held_out_never_seen(counts, objects, margin) if several else None,
        made_up=made_up_never_seen(counts, contract.seen, seed),
    )


def _file(path: Path, parity: Parity) -> cards.ModelFile:
    data = path.read_bytes()
    return cards.ModelFile(hashlib.sha256(data).hexdigest(), len(data), OPSET, parity)


def _same(one: JobResult, other: JobResult) -> bool:
    return all(
        np.array_equal(margins, other.margins[name]) for name, margins in one.margins.items()
    )
