"""Faults that a twin injects into its link on request; each one is counted."""

from __future__ import annotations

import dataclasses
from collections import Counter
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class LinkFaults:
    """Faults that a twin injects; by default none. Raises `ValueError` for a value out of range.

    Chances are per frame. Fingers and electrodes are numbered as in a reading, from 0.
    """

    bit_flip_probability: float = 0.0
    """Chance that one random bit of a frame flips."""
    drop_probability: float = 0.0
    duplicate_probability: float = 0.0
    reorder_probability: float = 0.0
    """Chance that a frame is sent after the next frame."""
    one_byte_at_a_time: bool = False
    burst_frames: int = 1
    """Number of frames that are collected and then sent at once."""
    disconnect_every_frames: int | None = None
    """Number n: the link breaks in the middle of every n-th frame. None: never."""
    wrong_version: bool = False
    """True if the twin claims a later version of the protocol."""
    dead_electrodes: tuple[tuple[int, int], ...] = ()
    """Pairs (finger, electrode) that always read 0."""
    unplugged_fingers: tuple[int, ...] = ()
    stuck_clock: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name.endswith("_probability") and not 0.0 <= value <= 1.0:
                raise ValueError(f"{field.name} is {value}, must be in 0..1")
        if self.burst_frames < 1:
            raise ValueError(f"burst_frames is {self.burst_frames}, must be at least 1")
        if self.disconnect_every_frames is not None and self.disconnect_every_frames < 1:
            raise ValueError("disconnect_every_frames must be at least 1")

    def refuse(self, link: str, *names: str) -> None:
        """Raise `ValueError` if a fault in `names` is set: a twin of `link` cannot show them."""
        for name in names:
            if getattr(self, name) != getattr(LinkFaults(), name):
                raise ValueError(f"{link} cannot show the fault {name.replace('_', '-')}")


class LinkFaultInjector:
    """Damage a twin's frames; `injected` counts the faults by name."""

    def __init__(self, faults: LinkFaults, spared_bytes: int = 0) -> None:
        """`spared_bytes`: bytes at the front of a frame without bit flips."""
        self.faults = faults
        self._spared_bytes = spared_bytes
        self.injected: Counter[str] = Counter()
        self._random = np.random.default_rng(faults.seed)
        self._held_back: bytes | None = None
        self._burst: list[bytes] = []
        self._frames = 0

    def spoil(self, frame: bytes, *, waits: bool = True) -> list[bytes]:
        """Return the frames to send now, with faults.

        `waits`: False if the frame must not be held back; it is sent after those that were.
        """
        faults = self.faults
        if self._happens(faults.drop_probability, "drop"):
            return []
        if self._happens(faults.bit_flip_probability, "bit_flip"):
            frame = self._flipped(frame)
        frames = [frame]
        if self._happens(faults.duplicate_probability, "duplicate"):
            frames.append(frame)
        if not waits:
            return [*self.flush(), *frames]
        if self._held_back is not None:
            frames.append(self._held_back)
            self._held_back = None
        elif self._happens(faults.reorder_probability, "reorder"):
            self._held_back = frames.pop(0)
        if faults.burst_frames == 1:
            return frames
        self._burst += frames
        if len(self._burst) < faults.burst_frames:
            return []
        burst, self._burst = self._burst, []
        self.injected["burst"] += 1
        return burst

    def flush(self) -> list[bytes]:
        """Return the frames that were held back; send them now."""
        held = self._burst
        if self._held_back is not None:
            held.append(self._held_back)
        self._burst, self._held_back = [], None
        return held

    def breaks_here(self) -> bool:
        """Return True if the link breaks in the next frame. Call once per frame."""
        self._frames += 1
        every = self.faults.disconnect_every_frames
        if every is None or self._frames % every:
            return False
        self.injected["disconnect"] += 1
        return True

    def _happens(self, probability: float, name: str) -> bool:
        if probability == 0.0 or self._random.random() >= probability:
            return False
        self.injected[name] += 1
        return True

    def _flipped(self, frame: bytes) -> bytes:
        at = int(self._random.integers(self._spared_bytes * 8, len(frame) * 8))
        spoiled = bytearray(frame)
        spoiled[at // 8] ^= 1 << at % 8
        return bytes(spoiled)
