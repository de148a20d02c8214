"""The content of a viewer for one hand at one moment."""

from __future__ import annotations

from enum import StrEnum

import msgspec

from graspd.daemon.judge.reasons import FingerState, Need


class Tone(StrEnum):
    """Kind of verdict that is shown; each has its own colour."""

    STABLE = "stable"
    LEANS = "leans"
    """`stable`, but doubtful, as by too few outcomes, or to be lifted under supervision."""
    SLIP = "slip"
    LEARNING = "learning"
    """`unknown`; a supervised lift is asked for."""
    WAITING = "waiting"
    """`unknown`, as expected: nothing is grasped, or the grasp has not settled."""
    TROUBLE = "trouble"
    """`unknown`, because something is wrong or unusual."""
    SILENT = "silent"
    """`unknown`, because no message arrives."""


class Link(StrEnum):
    """State of the connection to a daemon, in words for a person."""

    CONNECTING = "connecting"
    CONNECTED = "connected"
    NOT_CONNECTED = "not connected"
    NO_SOCKET = "not connected: the socket does not exist, no daemon runs there"
    NO_DAEMON = "not connected: no daemon publishes verdicts on this socket"
    NOT_ALLOWED = "not connected: this user may not open the socket; join the group graspd"
    NEEDS_KEY = "turned away: the daemon wants a key (--keys), or is not graspd"
    UNKNOWN_KEY = "turned away: the daemon does not know this key"
    TAKES_NO_KEYS = "turned away: this daemon takes no keys"
    WRONG_DAEMON = "turned away: is the daemon's key right?"

    @property
    def is_turned_away(self) -> bool:
        """True if the daemon is there and refuses this viewer."""
        return self in TURNED_AWAY


TURNED_AWAY = frozenset({Link.NEEDS_KEY, Link.UNKNOWN_KEY, Link.TAKES_NO_KEYS, Link.WRONG_DAEMON})


class Line(msgspec.Struct, frozen=True):
    """A line of two texts: a reason and advice, or the name of a figure and its value."""

    what: str
    advice: str
    need: Need = Need.ACT
    """Whether a person has to act, if the line reports a problem."""


class FingerMotion(msgspec.Struct, frozen=True, kw_only=True):
    """Motion of a finger, in units of its own noise."""

    now: float | None
    """Motion now; None: not known."""
    limit: float
    """Largest motion that counts as still; 0: not known."""


class FingerImage(msgspec.Struct, frozen=True, kw_only=True):
    """Picture of one finger."""

    name: str
    from_rest: bool
    """True if levels are relative to the resting counts, False: to the finger's median."""
    levels: list[int]
    """Level of each pixel, 12 rows of 11, as `levels_of` returns them."""
    deepest: int
    """Largest fall of an electrode, counts."""
    marked: list[int]
    """Pixels of electrodes that are broken or repaired."""
    broken: str
    """Numbers of the broken and repaired electrodes, from 1, as text; empty: none."""
    motion: FingerMotion | None
    """Motion; None: the finger is free, or the daemon has no gate."""
    state: FingerState | None
    """State; None: not known."""


class JudgedGrasp(msgspec.Struct, frozen=True, kw_only=True):
    """A grasp and its last judgement, which may no longer hold."""

    verdict: str
    p_slip: float | None
    boot_id: str
    """Id of the daemon's start, from which `grasp` counts."""
    grasp: int
    ago_s: float
    lift: str
    """`held`, `slipped` or `not reported`; `-`: no lift was permitted."""
    supervised: bool
    held: bool


class Snapshot(msgspec.Struct, frozen=True, kw_only=True):
    """The state of one hand."""

    endpoint: str
    link: Link
    hand: str | None
    t: float
    """Time of the snapshot, wall-clock seconds since 1970."""
    last_t: float | None
    """Time at which the last verdict arrived, as `t`; None: no verdict yet."""
    tone: Tone
    headline: str
    """Largest word on the screen: the verdict, "leans to stable", or that none has come yet."""
    evidence: str
    """Result of `figures.rests_on`; empty while no message comes."""
    p_slip: float | None
    why: list[Line]
    """Reasons of the verdict; a few words, `what` of the first line, are shown beside it."""
    grasp: int | None
    gate: str | None
    contact: list[str] | None
    """Fingers that touch; None: not known."""
    still: str
    """Time without motion, as text; `-`: not known."""
    grasps: list[JudgedGrasp]
    """Latest judged grasps, the newest first."""
    fingers: list[FingerImage]
    joints: dict[str, float]
    """Angle of each joint, rad."""
    health: list[Line]
    """Parts that are not as they should be, first those to act on."""
    not_well: str
    """Parts to act on in a few words, except those in `why`; empty: none, or not known."""
    state: str | None
    """`running`, `no readings` or `stopping`; None: not known."""
    model: str | None
    learning: list[Line]
    timing: list[Line]
    history: list[str]
    """Tones of each of the last 300 seconds, the oldest first, as letters of `TONE_CODE`."""
    history_p: list[int]
    """Highest probability of slip in each second of `history`, %; -1: none."""
