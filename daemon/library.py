"""graspd in a program or a notebook: a model that judges grasps, and recordings judged again."""

from __future__ import annotations

import os
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graspd.biotac import COUNT_MAX, ELECTRODES, Finger, electrode_columns
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import Assembly, Parts
from graspd.daemon.assembly.plan import MCAP, require_mcap
from graspd.daemon.assembly.sources import Source, Tables
from graspd.daemon.judge.decision import Limits
from graspd.daemon.judge.health import at_rail
from graspd.daemon.session import file as session_file
from graspd.drivers.base import JointReading
from graspd.models import trial, zoo
from graspd.models.contract import ModelError, SessionInput
from graspd.models.judge.grasp_judge import Examined, GraspJudge

if TYPE_CHECKING:
    import pandas as pd

    from graspd.daemon.publish.messages import Verdict


class GraspModel:
    """A trained model that judges grasps; it refuses those that the daemon would refuse."""

    classes = ("stable", "slip")
    """Columns of `predict_proba`."""

    def __init__(self, path: Path) -> None:
        """Load an ONNX file. Raises `ModelError`."""
        model = trial.load(path)
        self._takes = model.contract.input
        self.name: str = model.contract.name
        self.fingers: tuple[Finger, ...] = model.contract.fingers
        """Order of the fingers in the counts."""
        self._judge = GraspJudge.of(model, Limits.slip_threshold)
        self._turn = threading.Lock()
        """Held while it judges: it has one session, and the network one input."""

    def predict_proba(
        self,
        counts: ArrayLike | pd.DataFrame,
        *,
        session: str | os.PathLike[str] | ArrayLike | pd.DataFrame | None = None,
    ) -> NDArray[np.float64]:
        """Return the probabilities of `classes`, shape (n, 2), for each of n held grasps.

        `counts`: shape (n, fingers, 24), or a table with columns such as `ff_biotac_1`. NaN, or a
        masked value, is an electrode that is known to be broken, as is one at 0 or 4095. A row is
        NaN if the daemon would refuse to judge it. Threads may share a model.

        `session`, for models that need one: grasps of the same sensors on the same day, like
        `counts` and without outcomes, or the file of a session that a daemon has kept.
        Raises `ValueError`, `ModelError` or `SessionFileError` for what does not fit.
        """
        judged = self._counts(counts)
        probabilities = np.full((len(judged), 2), np.nan)
        with self._turn:
            self._begin(session)
            for row, values in enumerate(judged):
                p_slip = self._judge.judge(self._examine(values)).p_slip
                if p_slip is not None:
                    probabilities[row] = 1.0 - p_slip, p_slip
        return probabilities

    def _examine(self, values: NDArray[np.float64]) -> Examined:
        counts = np.where(np.isnan(values), 0.0, values).astype(np.uint16)
        broken = at_rail(counts)  # as is a NaN, which is 0 there
        return self._judge.examine(counts, broken if broken.any() else None)

    def _begin(self, session: str | os.PathLike[str] | ArrayLike | pd.DataFrame | None) -> None:
        """Begin a session of today's sensors."""
        calibration = self._judge.session
        if calibration is None or not isinstance(self._takes, SessionInput):
            if session is not None:
                raise ModelError(f"the model {self.name} keeps no session")
            return
        calibration.reset()
        if isinstance(session, str | os.PathLike):
            session_file.restore(Path(session), self.fingers, calibration)
        elif session is not None:
            for values in self._counts(session):
                examined = self._examine(values)
                self._judge.observe(examined, self._judge.judge(examined))
        if not calibration.calibrated:
            warnings.warn(
                f"{self.name} does not know the sensors of this day: its probabilities mean little "
                "on any day but those of its training. Give session= "
                f"{self._takes.calibrated_from:g} grasps or more of the same sensors; outcomes are "
                "not needed.",
                stacklevel=3,
            )

    def _counts(self, given: ArrayLike | pd.DataFrame) -> NDArray[np.float64]:
        """Return counts of shape (n, fingers, 24). Raises `ValueError`."""
        values = _of_table(given, self.fingers) if hasattr(given, "columns") else given
        given = np.asarray(values).dtype
        if given.kind in "cmM":
            raise ValueError(f"counts are of type {given}, not numbers")
        counts: NDArray[np.float64] = np.ma.array(values, dtype=np.float64).filled(np.nan)
        fingers = len(self.fingers)
        if counts.ndim != 3 or counts.shape[1:] != (fingers, ELECTRODES):
            raise ValueError(
                f"counts have shape {counts.shape}, {self.name} takes (n, {fingers}, {ELECTRODES})"
            )
        sound = counts[~np.isnan(counts)]
        if ((sound < 0) | (sound > COUNT_MAX) | (sound != np.trunc(sound))).any():
            raise ValueError(f"counts must be whole numbers in 0..{COUNT_MAX}, or NaN")
        return counts


def load(model: str | os.PathLike[str], *, fingers: Sequence[Finger] = ()) -> GraspModel:
    """Return a model by its name (`graspd models` lists them) or by the path of an ONNX file.

    `fingers`: those of the hand, for the form of the model that judges fewer. Raises `ModelError`.
    """
    return GraspModel(_path(model, fingers))


def judge(
    recordings: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    model: str | os.PathLike[str] | None = None,
) -> Iterator[Verdict]:
    """Yield the verdict on each reading, as `graspd replay RECORDING...` says it.

    `recordings`: grasp tables or streams (CSV), or the files of one run in order (MCAP). `model`:
    a name or a path; by default the one that judged then, of CSV files small-session.
    Raises `SceneError`, `RecordingError` or `ModelError`.
    """
    if isinstance(recordings, str | os.PathLike):
        recordings = [recordings]
    paths = [Path(path) for path in recordings]
    parts = _parts(paths, {} if model is None else {"path": _path(model).absolute()})
    pipeline, driver = parts.pipeline, parts.drivers[0]
    with ExitStack() as stack:
        around = Assembly(parts, stack)
        outbox = around.build_outbox()
        around.open_drivers()
        while not driver.exhausted:
            for reading in driver.read_ready():
                if isinstance(reading, JointReading):
                    pipeline.observe_joints(reading)
                    continue
                received_ns = time.monotonic_ns()
                judgement = pipeline.judge(reading)
                yield outbox.verdict(judgement, received_ns, assembly.NO_SILENCE_NS)[0]
                pipeline.learn()


def _parts(paths: Sequence[Path], model: dict[str, Any]) -> Parts:
    source: Source = Tables(paths, {})
    if MCAP in {path.suffix for path in paths}:
        require_mcap("judging MCAP")
        from graspd.daemon.assembly.recordings import RecordedRun

        source = RecordedRun(paths)
    scene = source.scene({}, model, None)
    parts = source.parts(scene, assembly.load_model(scene), None)
    source.restore(parts.pipeline)
    return parts


def _path(model: str | os.PathLike[str], fingers: Sequence[Finger] = ()) -> Path:
    if isinstance(model, str) and not model.endswith(".onnx"):
        return zoo.find(zoo.for_hand(model, fingers) if fingers else model)
    return Path(model)


def _of_table(table: Any, fingers: Sequence[str]) -> NDArray[np.float64]:  # noqa: ANN401
    """Return the counts of a table of pandas, or of anything that has its columns."""
    names = [name for finger in fingers for name in electrode_columns(finger)]
    missing = [name for name in names if name not in table.columns]
    if missing:
        raise ValueError(f"the table has no column {missing[0]}")
    columns = list(table.columns)
    twice = [name for name in names if columns.count(name) > 1]
    if twice:
        raise ValueError(f"the table has the column {twice[0]} more than once")
    values = np.asarray(table[names].to_numpy(dtype=np.float64, na_value=np.nan))
    return values.reshape(-1, len(fingers), ELECTRODES)
