"""The controller of a replay, which reports outcomes, and tables that a model was trained on."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from graspd.biotac import ELECTRODES
from graspd.daemon.publish.companion import Companion, PublishedVerdict, Requests
from graspd.daemon.publish.messages import OBJECT_PATTERN
from graspd.daemon.trust.lift_book import GraspId, Report
from graspd.drivers.recordings.csv_rows import read_rows
from graspd.drivers.recordings.layout import Layout
from graspd.models import known_grasps
from graspd.models.runtime import TactileModel


class _Lift(NamedTuple):
    report: Report
    allowed: bool
    """True if a verdict on the grasp was `stable` or requested a supervised lift."""
    over: bool
    """True if the next reading is certainly another grasp."""


class Controller(Companion):
    """Reports the recorded outcome of each judged grasp before the next grasp, as a robot does."""

    def __init__(self, *, only_lifted: bool) -> None:
        """`only_lifted`: True reports outcomes of `stable` verdicts and supervised lifts only."""
        self._only_lifted = only_lifted
        self._requests: Requests | None = None
        self._lift: _Lift | None = None

    def before_wait(self, requests: Requests) -> None:
        self._requests = requests

    def on_verdict(self, published: PublishedVerdict) -> None:
        """Keep a judged grasp whose outcome is recorded; report that of the grasp before it."""
        verdict, reading = published.verdict, published.reading
        if self._lift is not None and self._lift.report.grasp.grasp != verdict.grasp:
            self.tell()
        note = None if reading is None else reading.annotation
        if note is None or note.slipped is None or not verdict.judged:
            return
        again = self._lift is not None and self._lift.allowed
        self._lift = _Lift(
            Report(
                GraspId(verdict.boot_id, verdict.grasp),
                "slip" if note.slipped else "stable",
                _sent(note.object_name),
            ),
            allowed=again or verdict.verdict == "stable" or verdict.supervised,
            over=verdict.gate is None,
        )

    def after_round(self) -> None:
        """Report the outcome if each reading is a grasp, whose lift is over at once."""
        if self._lift is not None and self._lift.over:
            self.tell()

    def tell(self) -> None:
        """Report the recorded outcome of the current grasp, if `only_lifted` permits it."""
        lift, self._lift = self._lift, None
        if lift is None or self._requests is None or (self._only_lifted and not lift.allowed):
            return
        self._requests.outcome(lift.report, lambda _problem: None)


def _sent(object_name: str | None) -> str | None:
    """Return the name if an outcome message may contain it, else None. Tables may have any text."""
    return object_name if re.fullmatch(OBJECT_PATTERN, object_name or "") else None


def trained_on(
    layouts: Mapping[Path, Layout], models: Sequence[TactileModel]
) -> list[dict[Path, str]]:
    """Return for each model the recordings with grasps on which it was trained.

    Each result maps paths of recordings to a text with the number of grasps that the model knows.
    Grasps and tables are recognised by their content, not by name. `layouts`: layout of each
    recording, by path. The `models` must judge the same fingers. Raises `RecordingError` and
    `ModelError`.
    """
    known = [known_grasps.of_model(model) for model in models]
    found: list[dict[Path, str]] = [{} for _ in models]
    fingers = models[0].contract.fingers
    for path, layout in layouts.items():
        if layout.is_stream:
            continue  # sweeps are not grasps
        rows = [row.counts for row in read_rows(path, fingers, layout=layout)]
        counts = np.array(rows, np.uint16).reshape(-1, len(fingers), ELECTRODES)
        grasps = known_grasps.hashes(counts)
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        for model, hashes, of_model in zip(models, known, found, strict=True):
            trained = int(known_grasps.are_among(grasps, hashes).sum())
            if digest in {dataset.sha256 for dataset in model.contract.datasets}:
                trained = len(counts)  # an older model has no hashes of its grasps
            if trained:
                of_model[path] = f"{trained} of {len(counts)} grasps of {path.name}"
    return found
