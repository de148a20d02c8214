"""Everything that is shown of one hand at one moment."""

from __future__ import annotations

from enum import StrEnum

import msgspec

from graspd.daemon.watch.fingers import FingerImage


class Tone(StrEnum):
    """The verdict in seven kinds, each with its own colour."""

    STABLE = "stable"
    LEANS = "leans"
    """`stable`, but lifts have not shown it yet."""
    SLIP = "slip"
    LEARNING = "learning"
    """Unknown, and to be lifted under supervision."""
    WAITING = "waiting"
    """Unknown as expected: nothing is grasped, or not settled."""
    TROUBLE = "trouble"
    """Unknown: something is wrong or unusual."""
    SILENT = "silent"
    """Unknown: no message arrives."""


class Line(msgspec.Struct, frozen=True):
    """A reason and advice, or a figure and its value."""

    what: str
    advice: str


class JudgedGrasp(msgspec.Struct, frozen=True, kw_only=True):
    """The last verdict of a grasp, which may not hold any more."""

    verdict: str
    p_slip: float | None
    boot_id: str
    """Start of the daemon that numbered it."""
    grasp: int
    ago_s: float
    ended: str | None
    """`stable` or `slip`, if it was told."""
    lift: str
    """`held`, `slipped`, `not told`, or `-`."""
    supervised: bool
    held: bool


class Snapshot(msgspec.Struct, frozen=True, kw_only=True):
    """The state of one hand."""

    endpoint: str
    link: str
    hand: str | None
    t: float
    """Wall-clock seconds since 1970."""
    last_t: float | None
    """Arrival of the last verdict, and time of a silent hand's figures."""
    tone: Tone
    verdict: str
    """`stable`, `slip` or `unknown`."""
    headline: str
    """The verdict, that it leans to stable, or that none has come yet."""
    evidence: str
    """Empty before the first message."""
    p_slip: float | None
    why: list[Line]
    grasp: int | None
    gate: str | None
    contact: list[str] | None
    """Fingers that touch; None: not known."""
    still: str
    """In words; `-`: not known."""
    grasps: list[JudgedGrasp]
    """Judged ones, the newest first."""
    counts: dict[str, int]
    """Since watch began, by the last verdict of each."""
    fingers: list[FingerImage]
    joints: dict[str, float]
    """rad."""
    health: list[Line]
    """Problems, and what to do about each."""
    not_well: str
    """Problems in a few words; empty: no problem, or not known."""
    state: str | None
    """`running`, `silent` or `stopping`."""
    model: str | None
    learning: list[Line]
    timing: list[Line]
    session: list[Line]
    drivers: list[Line]
    history: list[str]
    """Tones of the last 300 seconds, the oldest first; see `TONE_CODE`."""
    history_p: list[int]
    """Highest probability of slip in each, %; -1: none."""
