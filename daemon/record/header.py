"""The header of each file of a recording."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Self

import msgspec

from graspd.drivers.base import FINGERS
from graspd.models.session_statistics import SessionState

_TEXTS: Final = ("boot_id", "model", "model_sha256", "judge", "trust")
"""Fields that are texts, or bytes in base64; the others are JSON."""
_OLDER: Final = {"trust": "", "says_judged": "false"}
"""Fields that older recordings lack."""


class RecordingHeader(msgspec.Struct, frozen=True, kw_only=True):
    """Describes the run that wrote the file. Its state lets the file be judged alone."""

    fingers: tuple[str, ...]
    """In the order of a reading's rows."""
    joints: bool
    """True if the hand had joint angles."""
    boot_id: str
    scene: dict[str, dict[str, Any]]
    """Sections `hand`, `model`, `gate`, `session`, `learn` and `risk`."""
    model: str
    model_sha256: str
    file: int = 0
    """Number within the run; skips one where the disk failed."""
    wall_minus_monotonic_ns: int = 0
    """Log times less the daemon's monotonic times, ns."""
    judge: bytes = b""
    """From `graspd.daemon.judge.memory.encode`; empty if not known."""
    axis_ns: int = 0
    """`t_ns` less `made_ns` of the readings, ns; 0 for live readings."""
    session: SessionState | None = None
    """None if the model needs none."""
    trust: bytes = b""
    """From `graspd.daemon.trust.trust.encode`; empty if nothing learns."""
    says_judged: bool = True
    """True if the file has `judged` messages."""

    def texts(self) -> dict[str, str]:
        """Return the fields as texts, for a metadata record."""
        return {
            name: value if name in _TEXTS else msgspec.json.encode(value).decode()
            for name, value in msgspec.to_builtins(self).items()
        }

    @classmethod
    def of(cls, texts: Mapping[str, str]) -> Self:
        """Read a header back. Raises `KeyError` or `ValueError`."""
        texts = {**_OLDER, **texts}
        fields: dict[str, Any] = {name: texts[name] for name in cls.__struct_fields__}
        fields["session"] = fields["session"] or "null"  # as older recordings have it
        for name in fields.keys() - _TEXTS:
            fields[name] = msgspec.json.decode(fields[name])
        header = msgspec.convert(fields, cls)
        if not header.fingers or not set(header.fingers) <= set(FINGERS):
            raise ValueError(f"no fingers of a hand: {header.fingers}")
        return header
