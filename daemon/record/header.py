"""The header of each file of a recording: scene, model, and the judge's state at its beginning."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Self

import msgspec

from drivers.base import FINGERS
from models.session_statistics import SessionState

_TEXTS: Final = ("boot_id", "model", "model_sha256", "judge", "trust")
"""Fields that are texts, or bytes in base64; the others are JSON."""
_OLDER: Final = {"trust": "", "says_judged": "false"}
"""Fields that older recordings lack."""


class RecordingHeader(msgspec.Struct, frozen=True, kw_only=True):
    """Describes the run that wrote the file. Its state lets the file be judged alone."""

    fingers: tuple[str, ...]
    """Fingers of a reading, in the order of its rows."""
    joints: bool
    """True if the hand had joint angles."""
    boot_id: str
    """As in the verdicts of the run."""
    scene: dict[str, dict[str, Any]]
    """The scene's sections `hand`, `model`, `gate`, `session`, `learn` and `risk`, by name."""
    model: str
    """Name of the model that judged."""
    model_sha256: str
    file: int = 0
    """Number of the file within its run, from 0; skips one where the disk failed."""
    wall_minus_monotonic_ns: int = 0
    """To subtract from the file's log times, wall time, for the daemon's monotonic time, ns."""
    judge: bytes = b""
    """The judge's state, from `daemon.judge.memory.encode`; empty if not known."""
    axis_ns: int = 0
    """`t_ns` less `made_ns` of the readings, ns; 0 for live readings."""
    session: SessionState | None = None
    """Statistics of the session; None if the model needs none."""
    trust: bytes = b""
    """What outcomes have taught, from `daemon.trust.trust.encode`; empty if nothing learns."""
    says_judged: bool = True
    """True if the file has `judged` messages."""

    def texts(self) -> dict[str, str]:
        """Return the fields as texts, for the metadata record of an MCAP file."""
        return {
            name: value if name in _TEXTS else msgspec.json.encode(value).decode()
            for name, value in msgspec.to_builtins(self).items()
        }

    @classmethod
    def of(cls, texts: Mapping[str, str]) -> Self:
        """Read a header back from its `texts`.

        Raises `KeyError` for a field that is missing and `ValueError` for a wrong one.
        """
        texts = {**_OLDER, **texts}
        fields: dict[str, Any] = {name: texts[name] for name in cls.__struct_fields__}
        fields["session"] = fields["session"] or "null"  # as older recordings have it
        for name in fields.keys() - _TEXTS:
            fields[name] = msgspec.json.decode(fields[name])
        header = msgspec.convert(fields, cls)
        if not header.fingers or not set(header.fingers) <= set(FINGERS):
            raise ValueError(f"no fingers of a hand: {header.fingers}")
        return header
