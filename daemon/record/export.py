"""Makes a grasp table, in the layout of the BioTac SP Stability Set, of recorded grasps whose
outcome is known: the counts by which each was judged last before it was told."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from daemon.publish.messages import decode_outcome
from daemon.record.mcap import McapReader, RecordedMessage
from daemon.record.topics import Judged, Topic, decode_judged
from drivers.base import ELECTRODES, RecordingError
from drivers.recordings.csv_rows import OBJECT, SLIPPED, electrode_columns, open_recording

GraspId = tuple[str, int]
"""Boot id and number."""


@dataclass(frozen=True, slots=True, eq=False)
class Grasp:
    """One grasp: a row of the table."""

    counts: NDArray[np.uint16]
    """Shape (fingers, 24), as judged last before the outcome was told."""
    slipped: bool
    object_name: str | None = None
    """What was lifted; None if the controller has not told it."""


@dataclass(slots=True)
class Export:
    """The grasps of some recordings, and how many were left out."""

    fingers: tuple[str, ...] = ()
    grasps: dict[GraspId, Grasp] = field(default_factory=dict)
    """In the order of their outcomes."""
    without_outcome: int = 0
    """Left out: grasps that were judged and have no outcome."""
    repaired: int = 0
    """Left out: grasps with an outcome of which electrodes were repaired to judge them."""
    repeated: int = 0
    """Left out: grasps with the very counts of one before, as a recording played in a loop has."""
    unjoined: int = 0
    """Outcomes of grasps without judged counts before them in the recordings."""
    cut_off: int = 0
    """Files that were cut off or are damaged."""


def collect(paths: Sequence[Path]) -> Export:
    """The grasps of recordings, given in the order of time.

    Raises `RecordingError` for a file that cannot be read, has other fingers than the first, or
    does not have the counts that were judged.
    """
    joining = _Joining()
    found = joining.found
    for path in paths:
        with open_recording(path) as stream:
            recording = McapReader(path, stream)
            header = recording.header
            if not header.says_judged:
                raise RecordingError(path, "does not say which counts were judged")
            if found.fingers and header.fingers != found.fingers:
                raise RecordingError(path, f"has other fingers than {paths[0]}")
            found.fingers = header.fingers
            for message in recording:
                try:
                    joining.take(message)
                except (ValueError, OverflowError) as error:
                    raise RecordingError(path, f"{message.kind} message: {error}") from error
            found.cut_off += recording.cut_off
    found.without_outcome = len(joining.judged.keys() - joining.told)
    leave_out_repeats(found)
    return found


def leave_out_repeats(found: Export) -> None:
    """Keep the first of the grasps that have the same counts, and count the others."""
    first: dict[bytes, GraspId] = {}
    for grasp, row in found.grasps.items():
        first.setdefault(row.counts.tobytes(), grasp)
    found.repeated = len(found.grasps) - len(first)
    found.grasps = {grasp: found.grasps[grasp] for grasp in first.values()}


class _Joining:
    """Joins judged counts and outcomes by grasp."""

    def __init__(self) -> None:
        self.found = Export()
        self.judged: dict[GraspId, Judged] = {}
        self.told: set[GraspId] = set()

    def take(self, message: RecordedMessage) -> None:
        """Take in the next message. Raises `ValueError` or `OverflowError` if it is malformed."""
        if message.kind == Topic.JUDGED:
            judgement = decode_judged(message.payload)
            self.judged[judgement.boot_id, judgement.grasp] = judgement
        elif message.kind == Topic.OUTCOME:
            outcome = decode_outcome(message.payload)
            grasp = outcome.grasp_boot_id or outcome.boot_id, outcome.grasp
            self.told.add(grasp)
            judged = self.judged.get(grasp)
            if judged is None:
                self.found.unjoined += 1
            elif judged.repaired:
                self.found.repaired += grasp not in self.found.grasps
            else:
                shape = len(self.found.fingers), ELECTRODES
                counts = np.array(judged.counts, dtype=np.uint16).reshape(shape)
                slipped = outcome.outcome == "slip"
                self.found.grasps[grasp] = Grasp(counts, slipped, outcome.object)


def write(out: TextIO, found: Export, object_name: str) -> None:
    """Write the table, one row a grasp: object, 1 for slip or 0 for stable, counts by finger.

    `object_name` is for grasps of which no object was told. Raises `OSError`.
    """
    writer = csv.writer(out, lineterminator="\n")
    names = [name for finger in found.fingers for name in electrode_columns(finger)]
    writer.writerow([OBJECT, SLIPPED, *names])
    for grasp in found.grasps.values():
        name = object_name if grasp.object_name is None else grasp.object_name
        writer.writerow([name, int(grasp.slipped), *grasp.counts.ravel().tolist()])
