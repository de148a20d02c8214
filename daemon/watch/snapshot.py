"""All that is shown at one moment; the terminal draws it, and the page gets it as JSON."""

from __future__ import annotations

from enum import StrEnum

import msgspec

from daemon.watch.fingers import FingerImage


class Tone(StrEnum):
    """The verdict in seven kinds, a colour each, that an operator tells apart at a glance."""

    STABLE = "stable"
    LEANS = "leans"
    """Called `stable`, but lifts have not shown yet that this is a promise that is kept."""
    SLIP = "slip"
    LEARNING = "learning"
    """Unknown, and to be lifted while a person watches."""
    WAITING = "waiting"
    """Unknown, as it should be: nothing is grasped, or the grasp has not settled yet."""
    TROUBLE = "trouble"
    """Unknown, because something is wrong or out of the ordinary."""
    SILENT = "silent"
    """Unknown, because no message comes."""


TONE_CODE = {
    Tone.STABLE: "s",
    Tone.LEANS: "l",
    Tone.SLIP: "x",
    Tone.LEARNING: "u",
    Tone.WAITING: "w",
    Tone.TROUBLE: "t",
    Tone.SILENT: ".",
}
"""In `Snapshot.history`."""
WORST_FIRST = (
    *(Tone.SLIP, Tone.TROUBLE, Tone.SILENT, Tone.LEARNING),
    *(Tone.STABLE, Tone.LEANS, Tone.WAITING),
)
"""Of several moments in one column, the first of these is shown."""
MOMENTS = 300
"""Seconds that the timeline goes back: five minutes."""


class Line(msgspec.Struct, frozen=True):
    """Something to know, and what to do about it."""

    what: str
    advice: str


class Judged(msgspec.Struct, frozen=True, kw_only=True):
    """What a grasp was judged to be last, which may not stand any more."""

    verdict: str
    p_slip: float | None
    grasp: int
    ago_s: float
    ended: str | None
    """How the lift ended, if the controller has told it: `stable` or `slip`."""
    lift: str
    """The same in short words, for the eye: `held`, `slipped`, `not told`, or `-`."""
    supervised: bool
    """Whether it was to be lifted while a person watches."""
    held: bool
    """Whether it is still the grasp of the hand; else it is past."""


class Session(msgspec.Struct, frozen=True, kw_only=True):
    """How far the session is calibrated."""

    grasps: int
    calibrated: bool


class Timing(msgspec.Struct, frozen=True, kw_only=True):
    """Rates as they arrive here, delays as the daemon tells them."""

    verdicts_hz: float
    readings_hz: float | None
    age_ms: float | None
    p50_us: float | None
    p99_us: float | None
    max_us: float | None
    jitter_p99_us: float | None
    late: int | None
    worst_age_ms: float | None
    lost: int
    """Verdicts that did not arrive, by gaps of `seq`."""
    not_understood: int
    """Messages that are not of this version, or not of graspd."""


class Snapshot(msgspec.Struct, frozen=True, kw_only=True):
    """What is known now."""

    endpoint: str
    link: str
    hand: str | None
    t: float
    """Wall-clock seconds since 1970 here."""
    last_t: float | None
    """The same of the last verdict's arrival: of a silent hand, all figures are of then."""
    tone: Tone
    verdict: str
    """`stable`, `slip` or `unknown`; unknown too when no message comes."""
    headline: str
    """The same as it is to be shown: a `stable` that is no promise only leans to it."""
    evidence: str
    """What the verdict rests on; empty before the first message."""
    learning: list[Line]
    """How learning goes, what matters most first."""
    p_slip: float | None
    why: list[Line]
    grasp: int | None
    gate: str | None
    contact: list[str] | None
    still: str
    """For how long the hand has been still, in words; `-` where nobody says."""
    judged: Judged | None
    """The newest of `grasps`."""
    grasps: list[Judged]
    """The last grasps, the newest first."""
    fingers: list[FingerImage]
    joints: dict[str, float]
    """Angles, rad."""
    health: list[Line]
    repaired: list[str]
    session: Session | None
    timing: Timing
    state: str | None
    """Of the daemon: `running`, `silent` or `stopping`."""
    counts: dict[str, int]
    """Grasps seen here, by the verdict that each had last."""
    drivers: dict[str, dict[str, int]]
    model: str | None
    versions: dict[str, str]
    history: list[str]
    """Tones of each second of the last five minutes, the oldest second and the worst tone first;
    see `TONE_CODE`."""
    history_p: list[int]
    """The same for the highest probability of slip, %; -1 where there is none."""
