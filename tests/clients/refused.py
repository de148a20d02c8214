"""What no client may lift on: `golden/refused.json`, one table for the tests of both languages.

A case is what comes after one another, each as a verdict that all is well with but for its
`change`, for the field that it is `without`, or for the time of its reading, `later_ms`. Its
`frames` after the topic are that payload, changed as text (Latin-1: each character is a byte).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.clients.messages import ADDED, MS, TOPIC, verdict

CASES: list[dict[str, Any]] = json.loads(
    (Path(__file__).parent / "golden" / "refused.json").read_text()
)
NAMES: list[str] = [case["name"] for case in CASES]


def well(read_ns: int, seq: int = 0) -> dict[str, Any]:
    """A message that a lift may rely on, of a reading at that time."""
    return verdict(seq, read_ns, **ADDED)


def came(case: dict[str, Any], read_ns: int) -> list[list[bytes]]:
    """The messages of a case, one after the other, where it is `read_ns`."""
    return [_frames(each, read_ns) for each in case["came"]]


def _frames(each: dict[str, Any], read_ns: int) -> list[bytes]:
    message = well(read_ns + each.get("later_ms", 0) * MS) | each.get("change", {})
    message.pop(each.get("without"), None)
    payload = json.dumps(message)
    sent = [_changed(payload, how) for how in each.get("frames", [{}])]
    return [each.get("topic", TOPIC.decode()).encode(), *sent]


def _changed(payload: str, how: dict[str, Any]) -> bytes:
    if "text" in how:
        payload = how["text"] * how.get("times", 1)
    if "swap" in how:
        former, new = how["swap"]
        if payload.count(former) != 1:
            raise ValueError(f"{former} is not there once")
        payload = payload.replace(former, new)
    whole: str = how.get("prepend", "") + payload + how.get("append", "")
    whole += " " * how.get("pad", 0)
    return whole[: len(whole) - how.get("cut", 0)].encode("latin-1")
