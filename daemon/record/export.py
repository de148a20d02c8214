"""Make a table of recorded grasps with outcomes, in the format of the BioTac SP Stability Set."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

import msgspec
import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES, electrode_columns
from graspd.daemon.judge.reasons import Decision
from graspd.daemon.publish.messages import decode_outcome
from graspd.daemon.record.mcap_reader import McapReader, RecordedMessage
from graspd.daemon.record.topics import MALFORMED, Judged, Said, Topic, decode_judged
from graspd.daemon.trust.lift_book import GraspId
from graspd.drivers.base import RecordingError
from graspd.drivers.recordings.columns import OBJECT, SLIPPED
from graspd.drivers.recordings.kinds import Kind, kind_of, open_recording


class _Verdict(Said, frozen=True, kw_only=True):
    """Which grasp a verdict is on, and its time."""

    boot_id: str
    grasp: int
    t_mono_ns: int


_decode_verdict = msgspec.json.Decoder(_Verdict).decode


@dataclass(frozen=True, slots=True, eq=False)
class Grasp:
    """One grasp: a row of the table."""

    counts: NDArray[np.uint16]
    """Counts judged before the lift, shape (fingers, 24)."""
    slipped: bool
    object_name: str | None = None
    """Name of the object; None: not reported."""


@dataclass(slots=True)
class Export:
    """The grasps of some recordings, and the numbers of those left out.

    A grasp has the counts that were judged last when `lift` was answered yes, maybe again. If no
    controller asked, those judged last up to the first `stable` verdict; if there is none, those
    judged last of all. Later counts may be of an object in the air; the daemon does not learn from
    them either (`LiftBook.note`).
    """

    fingers: tuple[str, ...] = ()
    grasps: dict[GraspId, Grasp] = field(default_factory=dict)
    """Grasps in the order of their outcomes."""
    without_outcome: int = 0
    """Judged grasps without an outcome."""
    repaired: int = 0
    """Grasps with an outcome, but judged with repaired electrodes."""
    repeated: int = 0
    """Grasps with the same counts as an earlier one, such as from a replay in a loop."""
    unjoined: int = 0
    """Outcomes of grasps without judged counts."""
    cut_off: int = 0
    """Files that were cut off or are damaged."""
    judged: dict[GraspId, Judged] = field(default_factory=dict)
    """Counts of each grasp, judged before the lift if that is known."""
    told: set[GraspId] = field(default_factory=set)
    """Grasps with an outcome."""
    _last: tuple[GraspId, Judged] | None = None
    """Newest judged counts, and their grasp."""
    _verdict: tuple[GraspId, int] | None = None
    """Grasp and time, ns, of the last verdict."""
    _before_ns: dict[GraspId, int] = field(default_factory=dict)
    """Time, ns, of the verdict on which a grasp may be lifted; later counts may be of a lift."""

    def take(self, message: RecordedMessage) -> None:
        """Add a verdict, its judged counts, an announced lift or an outcome; ignore other messages.
        Raises one of `MALFORMED` for a malformed one."""
        match message.kind:
            case Topic.VERDICT:
                verdict = _decode_verdict(message.payload)
                grasp = GraspId(verdict.boot_id, verdict.grasp)
                self._verdict = grasp, verdict.t_mono_ns
                if verdict.verdict == Decision.STABLE:
                    self._before_ns.setdefault(grasp, verdict.t_mono_ns)
            case Topic.JUDGED:
                judged = decode_judged(message.payload)
                grasp = GraspId(judged.boot_id, judged.grasp)
                self._last = grasp, judged
                # A verdict, and an announced lift on it, come before its counts.
                if judged.t_mono_ns <= self._before_ns.get(grasp, math.inf):
                    self.judged[grasp] = judged
            case Topic.ANNOUNCED if self._verdict is not None:
                grasp, at_ns = self._verdict
                self._before_ns[grasp] = at_ns
                if self._last is not None and self._last[0] == grasp:
                    self.judged[grasp] = self._last[1]
            case Topic.OUTCOME:
                self._tell(message.payload)

    def _tell(self, payload: bytes) -> None:
        outcome = decode_outcome(payload)
        grasp = GraspId(outcome.grasp_boot_id or outcome.boot_id, outcome.grasp)
        self.told.add(grasp)
        judged = self.judged.get(grasp)
        if judged is None:
            self.unjoined += 1
        elif judged.repaired:
            self.repaired += grasp not in self.grasps
        else:
            shape = len(self.fingers), ELECTRODES
            counts = np.array(judged.counts, dtype=np.uint16).reshape(shape)
            self.grasps[grasp] = Grasp(counts, outcome.outcome == "slip", outcome.object)

    def leave_out_repeats(self) -> None:
        """Keep the first of all grasps with the same counts, and count the others."""
        first: dict[bytes, GraspId] = {}
        for grasp, row in self.grasps.items():
            first.setdefault(row.counts.tobytes(), grasp)
        self.repeated = len(self.grasps) - len(first)
        self.grasps = {grasp: self.grasps[grasp] for grasp in first.values()}

    def lacks(self) -> list[str]:
        """Return what the grasps lack, as texts that begin with a number."""
        lacking = {
            "left out without an outcome": self.without_outcome,
            "left out with repaired electrodes": self.repaired,
            "left out with the very counts of one before": self.repeated,
            "outcomes of grasps that are not in the recordings": self.unjoined,
            "files that were cut off": self.cut_off,
        }
        return [f"{count} {what}" for what, count in lacking.items() if count]


def collect(paths: Sequence[Path]) -> Export:
    """Return the grasps of recordings. `paths`: in the order of time.

    Raises `RecordingError` for other files, other fingers, or malformed messages; a damaged file is
    read up to the damage.
    """
    export = Export()
    for path in paths:
        kind = kind_of(path)
        if kind is not Kind.MCAP:
            raise RecordingError(path, f"is {kind.value}, not what `graspd run` has recorded")
        with open_recording(path) as stream:
            recording = McapReader(path, stream)
            header = recording.header
            if export.fingers and header.fingers != export.fingers:
                raise RecordingError(path, f"has other fingers than {paths[0]}")
            export.fingers = header.fingers
            for message in recording:
                try:
                    export.take(message)
                except MALFORMED as error:
                    raise RecordingError(path, f"{message.kind} message: {error}") from error
            export.cut_off += recording.cut_off
    export.without_outcome = len(export.judged.keys() - export.told)
    export.leave_out_repeats()
    return export


def write(out: TextIO, export: Export, object_name: str) -> None:
    """Write the table as CSV, one row per grasp. `object_name`: for grasps without one."""
    writer = csv.writer(out, lineterminator="\n")
    names = [name for finger in export.fingers for name in electrode_columns(finger)]
    writer.writerow([OBJECT, SLIPPED, *names])
    for grasp in export.grasps.values():
        name = object_name if grasp.object_name is None else grasp.object_name
        writer.writerow([name, int(grasp.slipped), *grasp.counts.ravel().tolist()])
