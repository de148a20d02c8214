"""What stands in front of each file of a recording: how the run judges, and what it knew there."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import msgspec

from drivers.base import FINGERS
from models.session_statistics import SessionState


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """What was known where a file begins, so that it is judged alike without those before it."""

    judge: bytes = b""
    """The judge's memory, by `daemon.judge.memory.encode`; empty: nothing is known."""
    axis_ns: int = 0
    """`t_ns` less `made_ns` of the readings, ns; 0 of live ones."""
    session: SessionState | None = None
    """None of a model that needs none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingHeader:
    """What a file says about the daemon that wrote it."""

    fingers: tuple[str, ...]
    """Rows of a reading."""
    joints: bool
    """Whether the hand had joint angles."""
    boot_id: str
    scene: dict[str, dict[str, Any]]
    """Those sections of the scene that say how readings are judged."""
    model: str
    """Name of the model that judged."""
    model_sha256: str
    file: int = 0
    """Number of the file within its run, from 0; one is left out where the disk failed."""
    wall_minus_monotonic_ns: int = 0
    """Log times are wall time; less this they are the daemon's monotonic time, ns."""
    known: Known = Known()
    says_judged: bool = True
    """Whether the counts that were judged are recorded too."""

    def texts(self) -> dict[str, str]:
        """The texts of the file's metadata record."""
        session = self.known.session
        return {
            "fingers": json.dumps(self.fingers),
            "joints": json.dumps(self.joints),
            "boot_id": self.boot_id,
            "scene": json.dumps(self.scene),
            "model": self.model,
            "model_sha256": self.model_sha256,
            "file": str(self.file),
            "wall_minus_monotonic_ns": str(self.wall_minus_monotonic_ns),
            "judge": base64.b64encode(self.known.judge).decode(),
            "axis_ns": str(self.known.axis_ns),
            "session": "" if session is None else msgspec.json.encode(session).decode(),
            "says_judged": json.dumps(self.says_judged),
        }

    @classmethod
    def of(cls, texts: Mapping[str, str]) -> Self:
        """What `texts` has made texts of. Raises `KeyError` or `ValueError`."""
        fingers = msgspec.json.decode(texts["fingers"], type=tuple[str, ...])
        session = texts["session"]
        if not fingers or not set(fingers) <= set(FINGERS):
            raise ValueError(f"no fingers of a hand: {fingers}")
        return cls(
            fingers=fingers,
            joints=texts["joints"] == "true",
            boot_id=texts["boot_id"],
            scene=msgspec.json.decode(texts["scene"], type=dict[str, dict[str, Any]]),
            model=texts["model"],
            model_sha256=texts["model_sha256"],
            file=int(texts["file"]),
            wall_minus_monotonic_ns=int(texts["wall_minus_monotonic_ns"]),
            known=Known(
                judge=base64.b64decode(texts["judge"]),
                axis_ns=int(texts["axis_ns"]),
                session=msgspec.json.decode(session, type=SessionState) if session else None,
            ),
            says_judged=texts.get("says_judged") == "true",
        )
