"""Make a table of recorded grasps with outcomes, in the format of the BioTac SP Stability Set."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES, electrode_columns
from graspd.daemon.publish.messages import decode_outcome
from graspd.daemon.record.mcap_reader import McapReader, RecordedMessage
from graspd.daemon.record.topics import Judged, Topic, decode_judged
from graspd.daemon.trust.lift_book import GraspId
from graspd.drivers.base import RecordingError
from graspd.drivers.recordings.columns import OBJECT, SLIPPED
from graspd.drivers.recordings.kinds import Kind, kind_of, open_recording


@dataclass(frozen=True, slots=True, eq=False)
class Grasp:
    """One grasp: a row of the table."""

    counts: NDArray[np.uint16]
    """Counts last judged before the outcome, shape (fingers, 24)."""
    slipped: bool
    object_name: str | None = None
    """Name of the object; None: not reported."""


@dataclass(slots=True)
class Export:
    """The grasps of some recordings, and the numbers of those left out."""

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
    """Last judged counts of each grasp."""
    told: set[GraspId] = field(default_factory=set)
    """Grasps with an outcome."""

    def take(self, message: RecordedMessage) -> None:
        """Add judged counts or an outcome; ignore other messages. Raises `ValueError` or
        `OverflowError` for a malformed one."""
        if message.kind == Topic.JUDGED:
            judgement = decode_judged(message.payload)
            self.judged[GraspId(judgement.boot_id, judgement.grasp)] = judgement
        if message.kind != Topic.OUTCOME:
            return
        outcome = decode_outcome(message.payload)
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
                except (ValueError, OverflowError) as error:
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
