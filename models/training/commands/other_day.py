"""`graspd evaluate --test`: judge one day's grasps with a model of another, as the daemon does."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from graspd.biotac import Finger
from graspd.models import known_grasps, trial, zoo
from graspd.models.judge.grasp_judge import GraspJudge
from graspd.models.training.commands.common import WrongInputError, check_fingers, read_each, say
from graspd.models.training.data.datasets import FEWEST_GRASPS, Grasps, concatenate
from graspd.models.training.evaluating.days import Day
from graspd.models.training.evaluating.metrics import f1_interval, verdict_figures
from graspd.models.training.fitting.trained import Trained, train
from graspd.models.training.systems.registry import SYSTEMS, System, with_recipes

DEFAULT = "small-session"
SEED = 0
OTHER_OPTIONS = ("data", "own", "protocol", "seeds", "table", "dask", "jobs", "out")
"""Options of `graspd evaluate` that do not go with `--test`."""


@dataclass(frozen=True, slots=True)
class _Model:
    """A trained model; `known`: hashes of the grasps that it was trained on."""

    name: str
    fingers: tuple[Finger, ...]
    known: known_grasps.Hashes
    judge: Callable[[], GraspJudge]
    """Function that returns a new judge, whose session is empty."""


def judge_other_days(
    args: argparse.Namespace, systems: Sequence[System], epochs: int | None
) -> None:
    """Print the figures of `--model`, or of systems trained on `--train`, on each `--test` table.

    `systems`: empty for the default one. `epochs`: None for the systems' own.
    Raises `WrongInputError`, `DatasetError` and `ModelError`.
    """
    if args.train and args.model:
        raise WrongInputError("--train and --model exclude each other")
    if args.model and systems:
        raise WrongInputError(f"{systems[0].name} goes with --train: --model is trained already")
    if not args.test or not (args.train or args.model):
        raise WrongInputError("--test needs --train or --model, and each of these needs --test")
    for option in OTHER_OPTIONS:
        if getattr(args, option):
            raise WrongInputError(f"--{option} does not go with --test")
    tables = read_each([*args.train, *args.test], args.read_as)
    days = tables[len(args.train) :]
    if args.model:
        models = [_of_file(args.model)]
    else:
        models = list(_trained(systems, concatenate(tables[: len(args.train)]), epochs))
    made = [_figures(model, day) for model in models for day in days]
    if args.json:
        sys.stdout.write(json.dumps(made, indent=2) + "\n")
    else:
        sys.stdout.writelines(map(_line, made))


def _of_file(what: str) -> _Model:
    """Return a model of the zoo by its name, or another one by its file."""
    path = Path(what) if what.endswith(".onnx") or os.sep in what else zoo.find(what)
    model = trial.load(path)
    contract = model.contract
    known = known_grasps.of_model(model)
    return _Model(contract.name, contract.fingers, known, lambda: GraspJudge.of(model))


def _trained(systems: Sequence[System], grasps: Grasps, epochs: int | None) -> Iterator[_Model]:
    if len(grasps) < FEWEST_GRASPS or grasps.slipped.all() or not grasps.slipped.any():
        raise WrongInputError(
            f"--train has {len(grasps)} grasps, {int(grasps.slipped.sum())} of which slipped: a "
            f"model needs {FEWEST_GRASPS}, and both kinds"
        )
    systems = systems or [SYSTEMS[zoo.for_hand(DEFAULT, grasps.fingers)]]
    check_fingers(systems, grasps)
    names = ", ".join(file.name for file in grasps.files)
    for system in systems:
        seen = grasps.of_fingers(system.fingers)
        wanted = system if epochs is None else with_recipes(system, epochs=epochs)
        trained = train(wanted, seen, SEED)
        yield _Model(
            f"{system.name} of {names}",
            system.fingers,
            known_grasps.hashes(seen.counts),
            partial(_judge_of, trained),
        )


def _judge_of(trained: Trained) -> GraspJudge:
    return Day(trained).judge_of


def _figures(model: _Model, day: Grasps) -> dict[str, Any]:
    """Judge a table's grasps in order, from an empty session; warn of those trained on. Return
    `verdict_figures` of those not refused, the names `table` and `model`, the numbers of grasps
    `all` and `trained_on`, and `f1_interval`, 95 %; None: of one object, or without a slip."""
    table = day.files[0].name
    try:
        day = day.of_fingers(model.fingers)
    except ValueError as error:
        raise WrongInputError(f"{table}: {error}") from error
    known = known_grasps.are_among(known_grasps.hashes(day.counts), model.known)
    if known.any():
        text = f"{model.name} was trained on {known.sum()} of {len(day)} grasps of {table}"
        say("evaluate", f"warning: {text}: it judges others worse")
    rows = _judged(model.judge(), day)
    judged = rows[~rows["refused"]]
    return {
        "table": table,
        "model": model.name,
        "all": len(day),
        "trained_on": int(known.sum()),
        **verdict_figures(judged),
        "f1_interval": f1_interval(judged),
    }


def _judged(judge: GraspJudge, day: Grasps) -> pd.DataFrame:
    """Judge grasps in order, each learned by the session; return a row for each: `margin`,
    `refused`, `object`, `slipped`."""
    margins, refused = np.zeros(len(day)), np.zeros(len(day), np.bool_)
    for index, counts in enumerate(day.counts):
        examined = judge.examine(counts)
        opinion = judge.judge(examined)
        judge.observe(examined, opinion)
        margins[index], refused[index] = opinion.margin, opinion.refusal is not None
    return pd.DataFrame(
        {"margin": margins, "refused": refused, "object": day.objects, "slipped": day.slipped}
    )


def _line(figures: dict[str, Any]) -> str:
    """Return the figures of one model on one table as a line of text."""
    parts = [f"{figures['grasps']} of {figures['all']} judged"]
    if figures["slips_called_stable"] is not None or figures["stable_called_slip"]:
        others = "of one object"
        if figures["f1_interval"] is not None:
            low, high = figures["f1_interval"]
            others = f"{100 * low:.1f} to {100 * high:.1f} for other objects"
        parts.append(f"F1 {100 * figures['f1']:.1f} % ({others})")
    if figures["slips_among_stable"] is not None:
        parts.append(f"{100 * figures['slips_among_stable']:.1f} % of `stable` slipped")
    return f"{figures['table']} by {figures['model']}: {', '.join(parts)}\n"
