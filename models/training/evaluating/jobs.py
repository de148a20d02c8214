"""One training and its judgement of the grasps left out, kept in a file by all it depends on."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import threading
import time
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import joblib
import numpy as np
from numpy.typing import NDArray

from models.inputs import builder, raw_features
from models.training.arrays import Bools, Floats, Ints, Numbers
from models.training.data.datasets import Grasps
from models.training.data.folds import fold_seed
from models.training.data.protocols import FOLDS, EvalProtocol, Split, splits
from models.training.evaluating.days import judged_days
from models.training.evaluating.files import write_whole
from models.training.fitting.fit import fit
from models.training.fitting.fitted import Fitted
from models.training.fitting.standards import NONE, TRAINING, TrainingStandards, later_session
from models.training.fitting.trained import train
from models.training.systems.system import SessionFeatures, System, digest, with_recipes

FORMAT = 1
"""Goes up when a job gives another result for the same configuration, or is written otherwise."""
MAX_FILE_BYTES = 64 * 2**20
"""A larger file is no result: 4682 grasps in 8 variants take 0.4 MB."""
_META, _TEST, _MARGINS, _AGES, _REFUSED = "meta", "test", "margins.", "ages.", "refused."
_INTERRUPTED = "Training interrupted"
_ONE_AT_A_TIME = threading.Lock()
"""torch's random state and its number of threads belong to the process."""

_log = logging.getLogger(__name__)

Number = TypeVar("Number", np.float64, np.int64, np.bool_)


class BrokenResultError(Exception):
    """A stored result is not what it claims to be: run the job again."""


class ClusterError(Exception):
    """The cluster is not there, or lost a job too often. What is finished is kept: try again."""


Outcomes = Iterator[tuple[int, bytes]]
"""Of jobs in the order in which they finish: index of the job, `JobResult.to_bytes`."""


@dataclass(frozen=True, slots=True)
class Job:
    """One fold of one protocol for one system."""

    system: System
    protocol: EvalProtocol
    seed: int
    """Of the split and, with the fold, of the training."""
    fold: int
    folds: int = FOLDS

    def key(self, data: str) -> str:
        """SHA-256 of all that the result depends on; `data` is the digest of the grasps."""
        parts = [FORMAT, digest(_alone(self.system)), self.protocol, self.seed, self.fold]
        text = json.dumps([*parts, self.folds, data])
        return hashlib.sha256(text.encode()).hexdigest()

    def file_name(self, data: str) -> str:
        """Of the stored result: different for every job and every data (a digest)."""
        readable = f"{self.system.name}.{self.protocol}.{self.seed}.{self.fold}"
        return f"{readable}.{self.key(data)[:16]}.npz"


@dataclass(frozen=True, slots=True, eq=False)
class JobResult:
    """How a trained system judges the test grasps of a job."""

    test: Ints
    """Indices (n,) of the grasps, ascending."""
    margins: dict[str, Floats]
    """By variant: uncalibrated log-odds of slip (n,)."""
    train_grasps: int
    seconds: float
    """Of training and judging."""
    parameters: int
    """How many numbers the trained system consists of."""
    ages: dict[str, Ints] = field(default_factory=dict)
    """By running variant: grasps (n,) that the session had seen before."""
    refused: dict[str, Bools] = field(default_factory=dict)
    """In `days`, by variant: which grasps (n,) the daemon would hold for never seen."""

    def to_bytes(self) -> bytes:
        """A .npz file without pickled objects."""
        meta = {
            "format": FORMAT,
            "train_grasps": self.train_grasps,
            "seconds": self.seconds,
            "parameters": self.parameters,
        }
        arrays = {_TEST: self.test, _META: np.frombuffer(json.dumps(meta).encode(), np.uint8)}
        arrays |= {_MARGINS + variant: values for variant, values in self.margins.items()}
        arrays |= {_AGES + variant: values for variant, values in self.ages.items()}
        arrays |= {_REFUSED + variant: values for variant, values in self.refused.items()}
        file = io.BytesIO()
        np.savez(file, allow_pickle=False, **arrays)  # type: ignore[arg-type]
        return file.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> JobResult:
        """The inverse of `to_bytes`. Raises `BrokenResultError`."""
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
                result = _result({name: arrays[name] for name in arrays.files})
        except (OSError, EOFError, ValueError, TypeError, KeyError, zipfile.BadZipFile) as error:
            raise BrokenResultError(f"is no result of a job: {error}") from error
        return result


def run(job: Job, grasps: Grasps) -> JobResult:
    """Train on a split and judge the grasps left out, on one thread.

    Depends on the arguments alone, whatever runs beside it. Raises `TooFewGraspsError` if the data
    do not have that split, `ValueError` if the system cannot learn from it.
    """
    split = splits(job.protocol, grasps, job.seed, job.folds)[job.fold]
    system, seed = _alone(job.system), fold_seed(job.seed, job.fold)
    grasps = grasps.of_fingers(system.fingers)
    # A forest would otherwise send its trees back to the cluster that this job came from.
    with _ONE_AT_A_TIME, joblib.parallel_config("sequential"), _interruptible():
        started_s = time.perf_counter()
        refused: dict[str, Bools] = {}
        if job.protocol == "days":
            trained = train(system, grasps.rows(split.train), seed)
            fitted = trained.fitted
            margins, refused, ages = judged_days(trained, grasps, split.test, seed)
        elif isinstance(system.input, SessionFeatures):
            fitted, margins, ages = _run_session(system, system.input, grasps, split, seed)
        else:
            inputs = builder(system.input, len(system.fingers)).build_batch(grasps.counts)[0]
            fitted = fit(system, inputs[split.train], grasps.slipped[split.train], seed=seed)
            margins, ages = {NONE: fitted.margins(inputs[split.test])}, {}
        seconds = time.perf_counter() - started_s
    numbers = len(split.train), seconds, fitted.parameters
    return JobResult(split.test, margins, *numbers, ages, refused)


def run_numbered(index: int, job: Job, grasps: Grasps) -> tuple[int, bytes]:
    """`run` as a process of its own is asked and answers: an item of `Outcomes`."""
    return index, run(job, grasps).to_bytes()


def load(folder: Path, job: Job, data: str) -> JobResult | None:
    """The stored result of a job on data with this digest; None, if broken with a warning."""
    path = folder / job.file_name(data)
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise BrokenResultError("is too large")
        return JobResult.from_bytes(path.read_bytes())
    except FileNotFoundError:
        return None
    except BrokenResultError as error:
        _log.warning("%s %s; it is run again", path, error)
        return None


def save(folder: Path, job: Job, data: str, content: bytes) -> None:
    """Store the bytes of a result, for `load`. Raises `OSError`."""
    write_whole(folder / job.file_name(data), content)


@contextmanager
def _interruptible() -> Iterator[None]:
    """A perceptron of scikit-learn takes Ctrl-C for the end of its training, and only warns."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=_INTERRUPTED, category=UserWarning)
        try:
            yield
        except UserWarning as warning:
            if str(warning).startswith(_INTERRUPTED):
                raise KeyboardInterrupt from warning
            raise


def _run_session(
    system: System, wanted: SessionFeatures, grasps: Grasps, split: Split, seed: int
) -> tuple[Fitted, dict[str, Floats], dict[str, Ints]]:
    """Each table is a session, standardised by its own training grasps."""
    features, table_of = raw_features(grasps.counts), grasps.table_of
    train, test = split.train, split.test
    standards = TrainingStandards.of(features[train], table_of[train])
    inputs = standards.apply(features[train], table_of[train], wanted.clip)
    fitted = fit(system, inputs, grasps.slipped[train], seed=seed)
    if split.calibration is None:
        known = standards.apply(features[test], table_of[test], wanted.clip)
        return fitted, {TRAINING: fitted.margins(known)}, {}
    session = later_session(features, test, split.calibration, standards, seed)
    margins = {
        variant: fitted.margins(by.apply(features[test], wanted.clip))
        for variant, by in session.standards.items()
    }
    return fitted, margins, session.ages


def _alone(system: System) -> System:
    return with_recipes(system, threads=1)


def _result(arrays: dict[str, Numbers]) -> JobResult:
    """Raises `KeyError`, `TypeError` or `ValueError` for what is no result."""
    meta = json.loads(arrays[_META].tobytes())
    if meta["format"] != FORMAT:
        raise ValueError(f"format {meta['format']}, not {FORMAT}")
    test = arrays[_TEST].astype(np.int64)
    margins = _named(arrays, _MARGINS, np.float64)
    ages = _named(arrays, _AGES, np.int64)
    if test.ndim != 1 or not margins:
        raise ValueError("has no margins")
    refused = _named(arrays, _REFUSED, np.bool_)
    columns = (*margins.values(), *ages.values(), *refused.values())
    if any(values.shape != test.shape for values in columns):
        raise ValueError("has margins or ages of another number of grasps")
    if not all(np.isfinite(values).all() for values in margins.values()):
        raise ValueError("has margins that are not finite")
    numbers = int(meta["train_grasps"]), float(meta["seconds"]), int(meta["parameters"])
    return JobResult(test, margins, *numbers, ages, refused)


def _named(
    arrays: dict[str, Numbers], prefix: str, kind: type[Number]
) -> dict[str, NDArray[Number]]:
    return {
        name.removeprefix(prefix): values.astype(kind)
        for name, values in arrays.items()
        if name.startswith(prefix)
    }
