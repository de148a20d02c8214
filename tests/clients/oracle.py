"""What a client may say, by definition: no state, all that came is looked at anew each time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec

from tests.clients.messages import MS, TOPIC

MAX_AGE_NS = 100 * MS
CLOCK_SLACK_NS = MS
MAX_P_SLIP = 0.5
"""A stable grasp slips less likely than not."""
WITHHELD = {"unproven", "low-confidence"}
"""What alone may be against a grasp that is to be lifted under supervision."""
Whole = Annotated[int, msgspec.Meta(ge=0, le=2**60)]
Duration = Annotated[float, msgspec.Meta(ge=0.0, le=1e12)]

SAME_THING = {
    ("stable", 1, True, True, False),
    ("slip", 2, True, True, False),
    ("unknown", 0, False, False, True),
}
"""Verdict, code, validity, whether there is a probability, and reasons: what fits together."""


Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


class RiskTold(msgspec.Struct):
    """What lifts came to; all of it is needed."""

    target: Share | None
    lifts: Whole
    slips: Whole
    outstanding: Whole
    bound: Duration | None
    warm_up_left: Whole
    announced: Whole = 0
    awaited: Whole = 0


class Former(msgspec.Struct):
    """A message, as far as a lift relied on it before there were outcomes."""

    v: Literal[1]
    boot_id: str
    seq: Whole
    t_mono_ns: Whole
    grasp: Whole
    verdict: Literal["stable", "slip", "unknown"]
    verdict_code: int
    p_slip: Share | None
    valid: bool
    reasons: list[str]
    age_ms: Duration
    silence_ms: Duration


class Told(Former):
    """A message, as far as a lift relies on it."""

    p_slip_model: Share | None = None
    outcomes: Whole = 0
    supervised: bool = False
    risk: RiskTold | None = None
    early: bool = False
    still_ms: Duration | None = None
    motion: dict[str, Duration | None] | None = None
    motion_limits: dict[str, Duration] | None = None
    fingers: dict[str, Literal["free", "touch", "slide"] | None] | None = None
    owner: str | None = None

    @property
    def teaches(self) -> bool:
        """Whether it may be lifted while a person watches."""
        return self.supervised and set(self.reasons) <= WITHHELD and self.is_sure

    @property
    def is_sure(self) -> bool:
        """Whether it does not call stable what more likely slips."""
        return self.verdict != "stable" or self.p_slip is None or self.p_slip < MAX_P_SLIP

    @property
    def published_ns(self) -> int:
        """When it went out, by the daemon's clock."""
        return self.t_mono_ns + round(self.age_ms * 1e6)


def told(payload: bytes) -> Told | None:
    """None for what is not understood, or contradicts itself."""
    try:
        found = msgspec.json.decode(payload, type=Told)
    except msgspec.DecodeError:
        return None
    whole = (found.verdict, found.verdict_code, found.valid)
    fits = (*whole, found.p_slip is not None, bool(found.reasons)) in SAME_THING
    fits &= found.p_slip is not None or found.p_slip_model is None
    fits &= found.risk is None or found.risk.slips <= found.risk.lifts
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
    """Whether all that came says so, and nobody need watch."""
    message = newest(came)
    known = message is not None and message.verdict == "stable" and not message.teaches
    known &= message is not None and message.is_sure
    return known and message is not None and is_fresh(message, now_ns)


def has_been_still(message: Told, still_ms: float | None) -> bool:
    """Whether it says that the hand has been still for so long, if anybody wants to know."""
    if still_ms is None:
        return True
    return message.still_ms is not None and message.still_ms >= still_ms


def is_to_be_watched(came: Sequence[Sequence[bytes]], now_ns: int) -> bool:
    """Whether all that came says that it may be lifted while a person watches."""
    message = newest(came)
    return message is not None and message.teaches and is_fresh(message, now_ns)


def _is_repeat(message: Told, known: Sequence[Told]) -> bool:
    return any(k.boot_id == message.boot_id and k.seq >= message.seq for k in known)


def _is_over(message: Told, known: Sequence[Told]) -> bool:
    """Whether another start came after this one's, or is known by something that is newer."""
    if not known or known[-1].boot_id == message.boot_id:
        return False
    came_before = message.boot_id in [each.boot_id for each in known]
    return came_before or message.published_ns < known[-1].published_ns
