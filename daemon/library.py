"""graspd in a program or a notebook: a model that judges grasps, and replayed recordings."""

from __future__ import annotations

import logging
import os
import re
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graspd.biotac import FINGERS, Finger
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import Assembly, Parts
from graspd.daemon.assembly.plan import require_mcap
from graspd.daemon.assembly.sources import Source, Tables, model_keys
from graspd.daemon.judge.decision import Limits
from graspd.daemon.judge.health import at_rail
from graspd.daemon.run.unjudged import Unjudged
from graspd.daemon.scene import SceneError
from graspd.daemon.session import file as session_file
from graspd.drivers.base import JointReading, RecordingError
from graspd.drivers.recordings import csv_player
from graspd.drivers.recordings.columns import (
    OBJECT,
    SLIPPED,
    finger_column,
    problem_of_fingers,
    time_column,
)
from graspd.drivers.recordings.kinds import Kind, files_of, kind_of_all, refuse_options
from graspd.drivers.recordings.layout import BLOCK_ROWS, ReadAs, are_labelled, problem_of_sweeps
from graspd.drivers.recordings.values import BLANK
from graspd.models import trial, zoo
from graspd.models.contract import CLASSES, ModelError, SessionInput
from graspd.models.counts import check_fingers, column_names, counts_of, fingers_of, write_csv
from graspd.models.judge.grasp_judge import Examined, GraspJudge
from graspd.models.runtime import read

if TYPE_CHECKING:
    from graspd.daemon.publish.messages import Verdict

ARGUMENTS = {"--as ": "read_as=", "--rate-hz": "rate_hz=", "--model ": "model="}
"""Arguments of `judge`, by the options of the command line for the same."""


class GraspModel:
    """A trained model that judges grasps; it refuses those that the daemon would refuse.

    It is pickled as path and digest, so that other processes on this computer can load it.
    """

    classes_ = np.array(CLASSES)
    """Columns of `predict_proba`: `stable`, `slip`."""

    def __init__(self, path: Path, sha256: str | None = None) -> None:
        """Load an ONNX file. Raises `ModelError`, also if its digest is not `sha256`."""
        file = read(path)
        if sha256 not in (None, file.sha256):
            raise ModelError(f"{path}: was changed since this model was pickled: load it again")
        model = trial.load(path, file)
        self._file = path.absolute(), file.sha256
        self._takes = model.contract.input
        self.name: str = model.contract.name
        self.fingers: tuple[Finger, ...] = model.contract.fingers
        """Order of the fingers in the counts."""
        self._judge = GraspJudge.of(model, Limits.slip_threshold)
        self._turns: dict[int, threading.Lock] = {}
        """Lock of each process by its id. Threads share the session and the network's input."""

    def __repr__(self) -> str:
        return f"<GraspModel {self.name} of {', '.join(self.fingers)}>"

    def __reduce__(self) -> tuple[type[GraspModel], tuple[Path, str]]:
        return type(self), self._file

    def predict(
        self,
        counts: ArrayLike,
        *,
        session: str | os.PathLike[str] | ArrayLike | None = None,
        read_as: Literal["table"] | None = None,
    ) -> NDArray[np.str_]:
        """Return `stable`, `slip` or `unknown` for each grasp, shape (n,), by `predict_proba`."""
        p_slip = self._probabilities(counts, session, read_as)[:, 1]
        stable = p_slip < Limits.slip_threshold
        return np.where(np.isnan(p_slip), "unknown", np.where(stable, *CLASSES))

    def predict_proba(
        self,
        counts: ArrayLike,
        *,
        session: str | os.PathLike[str] | ArrayLike | None = None,
        read_as: Literal["table"] | None = None,
    ) -> NDArray[np.float64]:
        """Return the probabilities of `classes_`, shape (n, 2), for each of n held grasps.

        `counts`: shape (n, fingers, 24), or a table with columns such as `ff_biotac_1`. NaN, or a
        masked or missing value, is an electrode that is known to be broken, as is one at 0 or 4095.
        A row is NaN if the daemon would refuse to judge it, or if the sensor of a finger stood
        still: it has the counts of another row in which other fingers differ. Threads may share a
        model.

        `session`, for models that need one: grasps of the same sensors on the same day, like
        `counts` and without outcomes, or the file of a session that a daemon has kept.
        `read_as="table"` decides for a table of which many rows nearly repeat each other.
        Raises `ValueError`, `ModelError` or `SessionFileError` for what does not fit, and
        `RuntimeError` in a process that was forked while a thread judged.
        """
        return self._probabilities(counts, session, read_as)

    def _probabilities(
        self,
        counts: ArrayLike,
        session: str | os.PathLike[str] | ArrayLike | None,
        read_as: ReadAs | None,
    ) -> NDArray[np.float64]:
        judged = _grasps(counts, self.fingers, read_as)
        probabilities = np.full((len(judged), 2), np.nan)
        with self._turn():
            self._begin(session, read_as)
            for row in np.flatnonzero(~_stand_still(judged)):
                p_slip = self._judge.judge(self._examine(judged[row])).p_slip
                if p_slip is not None:
                    probabilities[row] = 1.0 - p_slip, p_slip
        return probabilities

    def _turn(self) -> threading.Lock:
        """Return the lock that a thread of this process holds while it judges.

        Raises `RuntimeError` if this process was forked while a thread judged.
        """
        own = os.getpid()
        if any(turn.locked() for pid, turn in list(self._turns.items()) if pid != own):
            raise RuntimeError(
                f"a thread was judging by {self} when process {own} was forked: load it there again"
            )
        return self._turns.setdefault(own, threading.Lock())

    def _examine(self, values: NDArray[np.float64]) -> Examined:
        counts = np.where(np.isnan(values), 0.0, values).astype(np.uint16)
        broken = at_rail(counts)  # includes NaN, which is 0 here
        return self._judge.examine(counts, broken if broken.any() else None)

    def _begin(
        self, session: str | os.PathLike[str] | ArrayLike | None, read_as: ReadAs | None
    ) -> None:
        """Reset the calibration, then calibrate by `session`; warn if the model needs more grasps.

        Raises `ModelError` for a session if the model keeps none.
        """
        calibration = self._judge.session
        if calibration is None or not isinstance(self._takes, SessionInput):
            if session is not None:
                raise ModelError(f"the model {self.name} keeps no session")
            return
        calibration.reset()
        if isinstance(session, str | os.PathLike):
            session_file.restore(Path(session), self.fingers, calibration)
        elif session is not None:
            grasps = _grasps(session, self.fingers, read_as)
            for values in grasps[~_stand_still(grasps)]:
                examined = self._examine(values)
                self._judge.observe(examined, self._judge.judge(examined))
        if not calibration.calibrated:
            warnings.warn(
                f"{self.name} does not know the sensors of this day: its probabilities mean little "
                "on any day but those of its training. Give session= "
                f"{self._takes.calibrated_from:g} grasps or more of the same sensors; outcomes are "
                "not needed.",
                stacklevel=4,
            )


def _grasps(
    given: ArrayLike, fingers: Sequence[Finger], read_as: ReadAs | None
) -> NDArray[np.float64]:
    """Return counts of shape (n, fingers, 24). Raises `ValueError`, also for a table of sweeps."""
    if read_as not in (None, "table"):
        raise ValueError(
            f"read_as={read_as!r}: a GraspModel judges grasps; graspd.judge(table, "
            "read_as='stream', rate_hz=...) judges sweeps"
        )
    time_of_sweeps = _time_of(given)
    if time_of_sweeps is not None:
        raise ValueError(
            f"the table is a stream, by its column {time_of_sweeps}: its rows are sweeps and "
            "not grasps; graspd.judge(table) judges it"
        )
    counts = counts_of(given, fingers)
    if names := column_names(given):
        _refuse_fingers_by_row(given, names)
        rows = counts.reshape(-1, counts.shape[1] * counts.shape[2])
        blocks = np.array_split(rows, range(BLOCK_ROWS, len(rows), BLOCK_ROWS))
        problem = problem_of_sweeps(blocks, read_as, labelled=_are_labelled(given))
        if problem is not None:
            raise ValueError(f"the table: {_in_arguments(problem)} graspd.judge judges sweeps")
    return counts


def _stand_still(counts: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return True for rows, shape (n,), in which a finger has the counts of a row with other counts
    of another finger; a live sensor's noise never repeats. `counts`: shape (n, fingers, 24)."""
    still = np.zeros(len(counts), np.bool_)
    known = np.nan_to_num(counts)
    _, whole = np.unique(known, axis=0, return_inverse=True)
    for finger in range(known.shape[1]):
        _, sweep = np.unique(known[:, finger], axis=0, return_inverse=True)
        pairs = np.unique(np.column_stack((sweep.ravel(), whole.ravel())), axis=0)
        still |= (np.bincount(pairs[:, 0]) > 1)[sweep.ravel()]
    return still


def _refuse_fingers_by_row(table: Any, names: Sequence[str]) -> None:  # noqa: ANN401
    """Raise `ValueError` if the columns are one finger's, and the column of fingers names more."""
    column = finger_column(names)
    if column is None or len(fingers_of(names)) > 1:
        return
    cells = np.asarray(table[column[1]], dtype=object).tolist()
    named = {str(cell).strip().lower() for cell in cells}.intersection(FINGERS)
    problem = problem_of_fingers(named)
    if problem is not None:
        raise ValueError(f"the column {column[1]}: {problem}")


def _are_labelled(table: Any) -> bool:  # noqa: ANN401
    """Return True if every row has an object and an outcome, and both outcomes occur."""
    if not {OBJECT, SLIPPED} <= set(column_names(table)):
        return False
    labels = (np.asarray(table[name], dtype=object).tolist() for name in (OBJECT, SLIPPED))
    texts = [["" if str(each).lower() in BLANK else str(each) for each in one] for one in labels]
    return are_labelled(zip(*texts, strict=True))


def _time_of(table: Any) -> str | None:  # noqa: ANN401
    """Return the name of the column of times or None. Raises `ValueError` for an index of times."""
    index = getattr(table, "index", None)
    kind = getattr(getattr(index, "dtype", None), "kind", "O")
    if kind in "fmM" or time_column([str(name) for name in getattr(index, "names", ())]):
        raise ValueError(
            "the index of the table is a time: table.reset_index(names='t') makes a column of it"
        )
    column = time_column([str(name) for name in column_names(table)])
    return None if column is None else column.name


def load(model: str | os.PathLike[str], *, fingers: Sequence[Finger] = ()) -> GraspModel:
    """Return a model by its name (`graspd models` lists them) or by the path of an ONNX file.

    `fingers`: those of the hand, in order; a name then gives its variant for exactly these, if it
    has one. The model takes counts of its own `fingers`. Raises `ModelError`, also if these are not
    among `fingers` in this order, and `ValueError` for a name that is not a finger's.
    """
    check_fingers(fingers)
    keys = model_keys(model)
    found = GraspModel(keys.get("path") or zoo.find(zoo.for_hand(keys["name"], fingers)))
    if fingers and not set(found.fingers).issubset(fingers):
        raise ModelError(f"{found} does not judge a hand of {', '.join(fingers)}")
    if fingers and [each for each in fingers if each in found.fingers] != list(found.fingers):
        raise ModelError(f"{found} takes counts in this order, not of {', '.join(fingers)}")
    return found


def judge(
    recordings: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | ArrayLike,
    *,
    model: str | os.PathLike[str] | None = None,
    read_as: ReadAs | None = None,
    rate_hz: float | None = None,
) -> Iterator[Verdict]:
    """Yield the verdict on each reading, as `graspd replay RECORDING...` prints it.

    `recordings`: grasp tables or streams, or the files of one run in order (MCAP); or a table as
    `read_grasps` and `read_recording` return it. `model`: a name or a path; by default the recorded
    one, and small-session for tables and streams. `read_as` and `rate_hz` decide for tables that
    may be streams (deploy/RECORDING.md). A warning at the end says why nothing, or little, was
    judged. Raises `SceneError`, `RecordingError`, `ModelError` or `ValueError`.
    """
    said: list[str] = []
    try:
        with ExitStack() as stack:
            paths = stack.enter_context(files_of(_files(recordings, stack)))
            chosen = {} if model is None else model_keys(model)
            parts = _parts(paths, chosen, read_as, rate_hz)
            pipeline, driver = parts.pipeline, parts.drivers[0]
            why = Unjudged(said.append, parts.scene.gate.fingers)
            around = Assembly(parts, stack)
            outbox = around.build_outbox()
            around.open_drivers()
            while not driver.exhausted:
                for reading in driver.read_ready():
                    why.on_reading(reading)
                    if isinstance(reading, JointReading):
                        pipeline.observe_joints(reading)
                        continue
                    received_ns = time.monotonic_ns()
                    judgement = pipeline.judge(reading)
                    why.add(judgement, reading.made_ns)
                    yield outbox.verdict(judgement, received_ns, assembly.NO_SILENCE_NS)[0]
                    pipeline.learn()
    except (RecordingError, SceneError, ValueError) as error:
        error.args = (_in_arguments(str(error)),)
        raise
    why.end(driver.counters)
    if said:
        warnings.warn("\n".join(dict.fromkeys(said)), stacklevel=2)


def _files(recordings: Any, stack: ExitStack) -> list[Path]:  # noqa: ANN401
    """Return the paths of `recordings`; a table is in a temporary file until `stack` closes."""
    if column_names(recordings):
        _refuse_coarse(recordings, _time_of(recordings))
        path = write_csv(recordings, stack.enter_context(TemporaryDirectory()))
        stack.enter_context(_named_as_given(path))
        return [path]
    if isinstance(recordings, str | os.PathLike):
        recordings = [recordings]
    try:
        paths = [Path(path) for path in recordings]
    except (TypeError, NotImplementedError) as error:  # a memoryview raises NotImplementedError
        given = type(recordings).__name__
        raise ValueError(
            f"it judges files and tables, not {given}: GraspModel.predict takes counts"
        ) from error
    if not paths:
        raise ValueError("no recording was given")
    return paths


def _refuse_coarse(table: Any, time: str | None) -> None:  # noqa: ANN401
    """Raise `ValueError` if float32 rounds times by a hundredth of their step, or more."""
    times = np.asarray(table[time]) if time is not None else np.empty(0)
    if times.dtype == np.float32 and len(times) > 1:
        step = np.median(np.abs(np.diff(times.astype(float))))
        rounding = np.spacing(np.nanmax(np.abs(times)))
        if not rounding < step / 100:
            raise ValueError(
                f"the column {time}: float32 rounds these times to {rounding:.2g}, and they are "
                f"{step:.2g} apart: give float64, or times from 0 on"
            )


@contextmanager
def _named_as_given(path: Path) -> Iterator[None]:
    """Let errors, as `ValueError`, and warnings that name the file `path` name the given table."""

    def of_table(said: str) -> str:
        said = said.replace(str(path), "the table").replace(", line 1:", ":")
        return re.sub(r", line (\d+)", lambda found: f", row {int(found[1]) - 2} (from 0)", said)

    def rename(record: logging.LogRecord) -> bool:
        if str(path) in record.getMessage():
            record.msg, record.args = of_table(record.getMessage()), None
        return True

    log = logging.getLogger(csv_player.__name__)
    log.addFilter(rename)
    try:
        yield
    except (RecordingError, SceneError) as error:
        raise ValueError(of_table(str(error))) from None
    finally:
        log.removeFilter(rename)


def _in_arguments(said: str) -> str:
    """Return an error's text with arguments of `judge` in place of command-line options."""
    for option, argument in ARGUMENTS.items():
        said = said.replace(option, argument)
    return said.removeprefix("command line: tactile.")


def _parts(
    paths: Sequence[Path], model: dict[str, Any], read_as: ReadAs | None, rate_hz: float | None
) -> Parts:
    source: Source
    kind = kind_of_all(paths)
    refuse_options(paths[0], kind, {"read_as": read_as, "rate_hz": rate_hz})
    if kind is not Kind.MCAP:
        source = Tables(paths, {}, read_as=read_as, rate_hz=rate_hz)
    else:
        require_mcap("judging MCAP")
        from graspd.daemon.assembly.recordings import RecordedRun

        source = RecordedRun(paths)
    scene = source.scene({}, model, None)
    parts = source.parts(scene, assembly.load_model(scene), None)
    source.restore(parts.pipeline)
    return parts
