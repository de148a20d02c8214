"""Everything that is shown of one hand at one moment: the terminal draws it, the page gets JSON."""

from __future__ import annotations

from enum import StrEnum

import msgspec

from daemon.watch.fingers import FingerImage


class Tone(StrEnum):
    """The verdict in seven kinds, each with its own colour."""

    STABLE = "stable"
    LEANS = "leans"
    """`stable`, but lifts have not yet shown that this promise is kept."""
    SLIP = "slip"
    LEARNING = "learning"
    """Unknown, and to be lifted while a person watches."""
    WAITING = "waiting"
    """Unknown as expected: nothing is grasped, or the grasp has not settled yet."""
    TROUBLE = "trouble"
    """Unknown, because something is wrong or unusual."""
    SILENT = "silent"
    """Unknown, because no message arrives."""


class Line(msgspec.Struct, frozen=True):
    """A label and its text: a reason and advice, or a figure and its value."""

    what: str
    advice: str


class JudgedGrasp(msgspec.Struct, frozen=True, kw_only=True):
    """The last verdict of a grasp, which may not hold any more."""

    verdict: str
    p_slip: float | None
    grasp: int
    ago_s: float
    ended: str | None
    """How the lift ended, if the controller has told it: `stable` or `slip`."""
    lift: str
    """The same in short words: `held`, `slipped`, `not told`, or `-`."""
    supervised: bool
    """True if it was to be lifted while a person watches."""
    held: bool
    """True while the hand still holds it."""


class Snapshot(msgspec.Struct, frozen=True, kw_only=True):
    """The state of one hand."""

    endpoint: str
    link: str
    """State of the connection, in words."""
    hand: str | None
    t: float
    """Wall-clock seconds since 1970 on this computer."""
    last_t: float | None
    """Arrival of the last verdict, likewise; the figures of a silent hand are of that time."""
    tone: Tone
    verdict: str
    """`stable`, `slip` or `unknown`; unknown too when no message arrives."""
    headline: str
    """The verdict as it is shown: a `stable` without evidence only leans to stable."""
    evidence: str
    """What the verdict rests on; empty before the first message."""
    p_slip: float | None
    why: list[Line]
    """Reasons of the verdict, with advice."""
    grasp: int | None
    gate: str | None
    contact: list[str] | None
    """Fingers that touch; None: not known."""
    still: str
    """How long the hand has been still, in words; `-`: not known."""
    grasps: list[JudgedGrasp]
    """The last judged grasps, the newest first."""
    counts: dict[str, int]
    """Grasps since watch began, by the last verdict of each."""
    fingers: list[FingerImage]
    joints: dict[str, float]
    """Angles, rad."""
    health: list[Line]
    """What is wrong with the hand, and what to do."""
    state: str | None
    """Of the daemon: `running`, `silent` or `stopping`."""
    model: str | None
    learning: list[Line]
    timing: list[Line]
    session: list[Line]
    drivers: list[Line]
    """Counters of the drivers that are not 0, and versions."""
    history: list[str]
    """Tones of each of the last 300 seconds, the oldest first, as letters; see `TONE_CODE`."""
    history_p: list[int]
    """Highest probability of slip of each of these seconds, %; -1: none."""
