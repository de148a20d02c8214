"""Candump text through the decoder of the CAN board."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from drivers.base import Reading
from drivers.can.driver import CanBridgeDriver
from drivers.can.frames import LOST, CanFrame
from drivers.recordings.candump import LINE_MAX, frame_of
from drivers.recordings.csv_rows import open_recording


class CanCapture(CanBridgeDriver):
    """The driver of the board, fed by hand: no bus is opened, and its clock is that of the file."""

    def __init__(self, fingers: Sequence[str], **options: Any) -> None:  # noqa: ANN401
        """`options` as those of `CanBridgeDriver`. Raises `ValueError`."""
        self._now_ns = 0
        super().__init__("virtual", "capture", fingers, clock=self._now, **options)

    def _now(self) -> int:
        return self._now_ns

    def begin(self) -> None:
        """Forget all that came."""
        self.open()

    def _try_to_open(self) -> None:
        self._link.greeting()

    def feed(self, t_ns: int, record: object) -> Sequence[Reading]:
        """The readings that one frame completes."""
        if not isinstance(record, CanFrame):
            return ()
        self._now_ns = t_ns
        self._mind_silence()
        readings, trouble = self._take([(record, t_ns, t_ns)])
        self.counters.frames += not record.flags & LOST
        self._mind_silence()
        if trouble is not None:
            self._decoder.interrupt()
        return readings


def frames_of(path: Path) -> Iterator[tuple[int, CanFrame]]:
    """Times, ns, and frames of a file; other lines are passed over. Raises `RecordingError`."""
    with open_recording(path) as stream:
        while line := stream.readline(LINE_MAX + 1):
            found = frame_of(line.decode("ascii", "replace"))
            if found is not None:
                yield found
