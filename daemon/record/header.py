"""The header of each file of a recording."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Self

import msgspec

from graspd.drivers.base import FINGERS
from graspd.models.session_statistics import SessionState

_TEXTS: Final = ("boot_id", "model", "model_sha256", "judge", "trust")
"""Fields written as text, or as base64 if they are bytes; all others are JSON."""
_OLDER: Final = {"trust": "", "says_judged": "false"}
"""Values of the fields that older recordings lack."""


class RecordingHeader(msgspec.Struct, frozen=True, kw_only=True):
    """Description of the run, and its state, so that one file alone can be replayed."""

    fingers: tuple[str, ...]
    """Fingers in the order of a reading's rows."""
    joints: bool
    """True if the hand had joint angles."""
    boot_id: str
    scene: dict[str, dict[str, Any]]
    """Sections `hand`, `model`, `gate`, `session`, `learn` and `risk`."""
    model: str
    model_sha256: str
    file: int = 0
    """Number of the file in the run; one is skipped after a failure of the disk."""
    wall_minus_monotonic_ns: int = 0
    """Wall time less the daemon's monotonic time, ns."""
    judge: bytes = b""
    """State of the judge, from `graspd.daemon.judge.memory.encode`; empty: not known."""
    axis_ns: int = 0
    """Difference `t_ns` less `made_ns` of the readings, ns; 0 for live readings."""
    session: SessionState | None = None
    """Statistics of the session; None for a model without a session."""
    trust: bytes = b""
    """State of learning, from `graspd.daemon.trust.trust.encode`; empty without learning."""
    says_judged: bool = True
    """True if the file has `judged` messages."""

    def texts(self) -> dict[str, str]:
        """Return the fields as texts, for a metadata record of MCAP."""
        return {
            name: value if name in _TEXTS else msgspec.json.encode(value).decode()
            for name, value in msgspec.to_builtins(self).items()
        }

    @classmethod
    def of(cls, texts: Mapping[str, str]) -> Self:
        """Return the header in `texts`. Raises `KeyError` or `ValueError`."""
        texts = {**_OLDER, **texts}
        fields: dict[str, Any] = {name: texts[name] for name in cls.__struct_fields__}
        fields["session"] = fields["session"] or "null"  # older recordings have this
        for name in fields.keys() - _TEXTS:
            fields[name] = msgspec.json.decode(fields[name])
        header = msgspec.convert(fields, cls)
        if not header.fingers or not set(header.fingers) <= set(FINGERS):
            raise ValueError(f"no fingers of a hand: {header.fingers}")
        return header
