"""Decoders of the daemon's messages. Each raises `msgspec.DecodeError`."""

from __future__ import annotations

import msgspec

from daemon.publish.messages import GateMessage, Status, Tactile, Verdict

decode_verdict = msgspec.json.Decoder(Verdict).decode
decode_gate = msgspec.json.Decoder(GateMessage).decode
decode_tactile = msgspec.json.Decoder(Tactile).decode
decode_status = msgspec.json.Decoder(Status).decode
