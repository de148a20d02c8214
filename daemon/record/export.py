"""Recorded grasps whose lift is known, as a table in the layout of the BioTac SP Stability Set.

A row holds the very counts that were judged: the medians of fresh sweeps, or the reading, by the
gate of the scene that was recorded.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TextIO

import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon.judge.health import Health
from daemon.judge.median import FreshMedian
from daemon.publish.messages import Verdict, decode_outcome, decode_verdict
from daemon.record.mcap import McapRecording
from daemon.record.player import tactile_reading
from drivers.base import ELECTRODES, RecordingError, TactileReading
from drivers.recordings.csv_columns import OBJECT, SLIPPED, electrode_columns
from drivers.recordings.csv_rows import open_recording

MEDIAN_SWEEPS: Final = 3

GraspId = tuple[str, int]
"""Boot id and number."""


@dataclass(frozen=True, slots=True, eq=False)
class Grasp:
    """One grasp as it was judged last before its lift."""

    counts: NDArray[np.uint16]
    """Shape (fingers, 24)."""
    verdict: Verdict
    slipped: bool
    object_name: str | None = None
    """What was lifted, if the controller has told it."""


@dataclass(slots=True)
class Export:
    """What recordings hold."""

    fingers: tuple[str, ...] = ()
    grasps: dict[GraspId, Grasp] = field(default_factory=dict)
    """In the order in which they were told of."""
    without_outcome: int = 0
    """Grasps that were judged, and of whose lift nobody told."""
    repaired: int = 0
    """Grasps with an outcome that are left out: electrodes had to be replaced for judging."""
    unjoined: int = 0
    """Outcomes of grasps whose judgement is not in the recordings."""
    cut_off: int = 0
    """Files that end without an end."""


def collect(paths: Sequence[Path]) -> Export:
    """The grasps of recordings, given in the order of time. Raises `RecordingError`."""
    found = Export()
    judged: dict[GraspId, tuple[NDArray[np.uint16], Verdict]] = {}
    told: dict[GraspId, bool] = {}
    boot_id = ""
    run: _Run | None = None
    for path in paths:
        with open_recording(path) as stream:
            recording = McapRecording(path, stream)
            header = recording.header
            if found.fingers and header.fingers != found.fingers:
                raise RecordingError(path, f"has other fingers than {paths[0]}")
            found.fingers = header.fingers
            if run is None or header.boot_id != boot_id:
                run, boot_id = _Run(path, header.fingers, header.texts), header.boot_id
            for message in recording:
                try:
                    _take(run, message.kind, message.payload, judged, told, found)
                except (msgspec.DecodeError, ValueError, OverflowError) as error:
                    raise RecordingError(path, f"a {message.kind} message: {error}") from error
            found.cut_off += recording.cut_off
    found.without_outcome = len(judged.keys() - told.keys())
    return found


def _take(
    run: _Run,
    kind: str,
    payload: bytes,
    judged: dict[GraspId, tuple[NDArray[np.uint16], Verdict]],
    told: dict[GraspId, bool],
    found: Export,
) -> None:
    """Take in one message. Raises `msgspec.DecodeError`, `ValueError` or `OverflowError`."""
    if kind == "tactile":
        run.feel(tactile_reading(payload, found.fingers))
    elif kind == "verdict":
        verdict = decode_verdict(payload)
        counts = run.counts_of(verdict)
        if counts is not None:
            judged[verdict.boot_id, verdict.grasp] = counts, verdict
    elif kind == "outcome":
        outcome = decode_outcome(payload)
        grasp = outcome.boot_id, outcome.grasp
        told[grasp] = True
        if grasp not in judged:
            found.unjoined += 1
            return
        counts, verdict = judged[grasp]
        if verdict.repaired:
            found.repaired += grasp not in found.grasps
        else:
            slipped = outcome.outcome == "slip"
            found.grasps[grasp] = Grasp(counts, verdict, slipped, outcome.object)


class _Run:
    """Follows the readings of one start of the daemon, as its judge did."""

    def __init__(self, path: Path, fingers: tuple[str, ...], texts: Mapping[str, str]) -> None:
        """Raises `RecordingError` if the file does not say how it judged."""
        try:
            gate = json.loads(texts["scene"])["gate"]
            every = gate["mode"] == "every"
            self._gap_ns = round(gate["gap_ms"] * 1e6)
        except (KeyError, TypeError, ValueError) as error:
            raise RecordingError(path, "does not say how it was judged") from error
        self._single = every or gate.get("sweeps", MEDIAN_SWEEPS) != MEDIAN_SWEEPS
        self._health = Health(len(fingers))
        self._fresh = FreshMedian((len(fingers), ELECTRODES))
        self._usable_ns: int | None = None
        self._usable = np.ones((len(fingers), ELECTRODES), dtype=np.bool_)
        self._latest: TactileReading | None = None
        self._sound = False

    def feel(self, reading: TactileReading) -> None:
        """Take in a reading, as `daemon.judge.grip` does."""
        latest, self._latest = self._latest, reading
        if latest is not None and reading.seq != latest.seq + 1:
            self._fresh.reset()  # what is not in the recording was judged too
        watched = self._health.watch(reading)
        self._sound = not (watched.reasons or watched.broken.any())
        if watched.reasons:
            return
        last_ns, self._usable_ns = self._usable_ns, reading.t_ns
        if last_ns is not None and not 0 <= reading.t_ns - last_ns <= self._gap_ns:
            self._fresh.reset()
        self._usable = ~watched.broken
        self._fresh.push(reading.counts, self._usable)

    def counts_of(self, verdict: Verdict) -> NDArray[np.uint16] | None:
        """What a verdict was made of, shape (fingers, 24); None if it judged nothing.

        None too where the recording lacks the sweeps before it, or an electrode of it is broken.
        """
        latest = self._latest
        if not verdict.judged or latest is None or latest.t_ns != verdict.t_mono_ns:
            return None
        if not self._sound:  # some of the counts are none, whatever the verdict made of them
            return None
        if self._single:
            return latest.counts
        return self._fresh.counts if self._fresh.is_full(self._usable) else None


def write(out: TextIO, found: Export, object_name: str) -> int:
    """Write the table; how many rows. `object_name` is that of grasps without one."""
    writer = csv.writer(out, lineterminator="\n")
    names = [name for finger in found.fingers for name in electrode_columns(finger)]
    writer.writerow([OBJECT, SLIPPED, *names])
    for row in rows(found, object_name):
        writer.writerow(row)
    return len(found.grasps)


def rows(found: Export, object_name: str) -> Iterator[list[object]]:
    """The cells of each grasp: object, 1 for slip or 0 for stable, counts finger by finger."""
    for grasp in found.grasps.values():
        name = object_name if grasp.object_name is None else grasp.object_name
        yield [name, int(grasp.slipped), *grasp.counts.ravel().tolist()]
