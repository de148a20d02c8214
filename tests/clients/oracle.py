"""What a client may say, by definition: no state, all that came is looked at anew each time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec

from tests.clients.messages import MS, TOPIC

MAX_AGE_NS = 100 * MS
CLOCK_SLACK_NS = MS
Whole = Annotated[int, msgspec.Meta(ge=0, le=2**60)]
Duration = Annotated[float, msgspec.Meta(ge=0.0, le=1e12)]

SAME_THING = {
    ("stable", 1, True, True, False),
    ("slip", 2, True, True, False),
    ("unknown", 0, False, False, True),
}
"""Verdict, code, validity, whether there is a probability, and reasons: what fits together."""


class Told(msgspec.Struct):
    """A message, as far as a lift relies on it."""

    v: Literal[1]
    boot_id: str
    seq: Whole
    t_mono_ns: Whole
    grasp: Whole
    verdict: Literal["stable", "slip", "unknown"]
    verdict_code: int
    p_slip: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] | None
    valid: bool
    reasons: list[str]
    age_ms: Duration
    silence_ms: Duration


def told(payload: bytes) -> Told | None:
    """None for what is not understood, or contradicts itself."""
    try:
        found = msgspec.json.decode(payload, type=Told)
    except msgspec.DecodeError:
        return None
    whole = (found.verdict, found.verdict_code, found.valid)
    fits = (*whole, found.p_slip is not None, bool(found.reasons)) in SAME_THING
    return found if fits else None


def newest(came: Sequence[Sequence[bytes]]) -> Told | None:
    """The newest message of those that came; None if it is not understood, or nothing came."""
    kept: list[Told | None] = []
    for sent in came:
        if not sent or sent[0] != TOPIC:
            continue
        message = told(sent[1]) if len(sent) == 2 else None
        known = [each for each in kept if each is not None]
        if message is None or not (_is_repeat(message, known) or _is_over(message, known)):
            kept.append(message)
    return kept[-1] if kept else None


def is_fresh(message: Told, now_ns: int) -> bool:
    """Whether one may rely on it, with the daemon's own clock."""
    age_ns = now_ns - message.t_mono_ns
    silent_ns = age_ns - round(message.age_ms * 1e6)
    in_time = -CLOCK_SLACK_NS <= silent_ns <= round(message.silence_ms * 1e6)
    return in_time and age_ns <= MAX_AGE_NS


def is_stable(came: Sequence[Sequence[bytes]], now_ns: int) -> bool:
    """Whether all that came says so."""
    message = newest(came)
    return message is not None and message.verdict == "stable" and is_fresh(message, now_ns)


def _is_repeat(message: Told, known: Sequence[Told]) -> bool:
    return any(k.boot_id == message.boot_id and k.seq >= message.seq for k in known)


def _is_over(message: Told, known: Sequence[Told]) -> bool:
    """Whether another start came after this one's."""
    starts = [each.boot_id for each in known]
    return message.boot_id in starts and starts[-1] != message.boot_id
