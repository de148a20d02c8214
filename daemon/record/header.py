"""The header of each file of a recording: which scene and model judge, and in which state."""

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
    """The state where a file begins: with it the file is judged alike without those before it."""

    judge: bytes = b""
    """The judge's state, as `daemon.judge.memory.encode` gives it; empty if it is not known."""
    axis_ns: int = 0
    """`t_ns` less `made_ns` of the readings, ns; 0 for live readings."""
    session: SessionState | None = None
    """Statistics of the session; None if the model needs none."""
    trust: bytes = b""
    """What outcomes have taught, as `daemon.trust.trust.encode` gives it; empty if nothing learns.
    """


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingHeader:
    """What a file says about the run of the daemon that wrote it."""

    fingers: tuple[str, ...]
    """Fingers of a reading, in the order of its rows."""
    joints: bool
    """Whether the hand had joint angles."""
    boot_id: str
    """As in the verdicts of the run."""
    scene: dict[str, dict[str, Any]]
    """The scene's sections `hand`, `model`, `gate`, `session`, `learn` and `risk`, by name."""
    model: str
    """Name of the model that judged."""
    model_sha256: str
    file: int = 0
    """Number of the file within its run, from 0; skips one where the disk has failed."""
    wall_minus_monotonic_ns: int = 0
    """To subtract from the file's log times, wall time, for the daemon's monotonic time, ns."""
    known: Known = Known()
    says_judged: bool = True
    """Whether the file has `judged` messages."""

    def texts(self) -> dict[str, str]:
        """The fields as texts, for the metadata record of an MCAP file."""
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
            "trust": base64.b64encode(self.known.trust).decode(),
            "says_judged": json.dumps(self.says_judged),
        }

    @classmethod
    def of(cls, texts: Mapping[str, str]) -> Self:
        """Read a header back from what `texts` gave, as it stands in an MCAP file.

        Raises `KeyError` for a field that is missing and `ValueError` for a wrong one.
        """
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
                trust=base64.b64decode(texts.get("trust", "")),
            ),
            says_judged=texts.get("says_judged") == "true",
        )
