"""Decoders of the daemon's messages, and the golden ones, which clients must understand."""

from __future__ import annotations

from pathlib import Path

import msgspec

from graspd.daemon.publish.messages import MESSAGES, Message, Status, Tactile, Verdict

GOLDEN = Path(__file__).parents[1] / "daemon" / "publish" / "golden"

decode_verdict = msgspec.json.Decoder(Verdict).decode
decode_tactile = msgspec.json.Decoder(Tactile).decode
decode_status = msgspec.json.Decoder(Status).decode


def golden(name: str) -> Message:
    """Return a golden message by its file's name without suffix, which begins with its kind."""
    kind = name.partition("_")[0]
    return msgspec.json.decode((GOLDEN / f"{name}.json").read_bytes(), type=MESSAGES[kind])


GOLDEN_STATUS = decode_status((GOLDEN / "status.json").read_bytes())
GOLDEN_VERDICT = decode_verdict((GOLDEN / "verdict_stable.json").read_bytes())
