"""Base class of the loop's companions, such as sockets or recorder; what they get and call."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from enum import Enum, StrEnum
from typing import Any, Concatenate, Final, NamedTuple, ParamSpec, Protocol, TypeVar

from graspd.daemon.judge.pipeline import Judgement
from graspd.daemon.judge.reasons import Reason
from graspd.daemon.publish.messages import Status, Verdict
from graspd.daemon.trust.lift_book import GraspId, LiftBook, Report
from graspd.drivers.base import Reading, TactileReading

P = ParamSpec("P")
R = TypeVar("R")


class Told(StrEnum):
    """Result of reporting an outcome. On the wire, the `why` of a refusal begins with its value."""

    KEPT = "kept"
    REPEATED = "repeated"
    """The outcome was known before, and is on the disk."""
    UNKNOWN_START = "unknown boot_id"
    UNKNOWN_GRASP = "unknown grasp"
    NOT_YOURS = "not yours"
    CONTRADICTS = "contradicts"
    MALFORMED = "malformed"
    NOT_KEPT = "not kept"
    BUSY = "busy"


class Reply(NamedTuple):
    """Answer to a peer that reported an outcome."""

    told: Told
    detail: str = ""
    """Why the outcome is refused, as text for a person; empty if it is taken."""


KEPT: Final = Reply(Told.KEPT)
Answer = Callable[[Reply], None]
"""Function that is called with the reply to a peer."""


def at_once(answer: Answer) -> None:
    """Answer at once that the outcome is kept. Used where outcomes are not saved."""
    answer(KEPT)


class LoopEvent(Enum):
    """Event, other than a reading, that changes later verdicts; recordings contain it."""

    ASKED = "asked"
    SKIPPED = "skipped"
    """Readings before the next one were skipped."""
    ANNOUNCED = "announced"
    """A controller that asked may lift, as the verdict is `stable` or `supervised`."""
    TAKEN_BACK = "taken-back"
    """No lift follows an announcement."""


class PublishedVerdict(NamedTuple):
    """A verdict that was published."""

    judgement: Judgement
    verdict: Verdict
    payload: bytes
    """The verdict as JSON."""
    reading: TactileReading | None
    """Reading that was judged; None: the verdict reports silence."""
    is_answer: bool
    """True if this verdict answers the controllers that asked."""
    grasp: GraspId
    lifts: LiftBook
    keep: Callable[[Answer], None] = at_once
    """Calls its argument, with a `Reply`, once the state at this verdict is saved or cannot be."""


class Requests(Protocol):
    """Interface of the loop for requests of peers."""

    def ask(self) -> None:
        """Request a judgement for a controller that decides whether to lift."""

    def silence(self) -> None:
        """Publish an `unknown` verdict, as no reading has come."""

    def outcome(self, report: Report, answer: Answer) -> None:
        """Report the outcome of a lift; `answer` is called once it is on the disk, or refused."""


class Companion:
    """Base class of the loop's companions; each overrides the hooks that it needs.

    The loop calls them in its own thread. They must not block. An exception ends the loop.
    """

    filenos: Sequence[int] = ()
    """Current descriptors that end the loop's wait when they become readable."""

    def before_wait(self, requests: Requests) -> int | None:
        """Act before the loop waits, for example pass messages of peers on to `requests`.

        Return the latest end of the wait, monotonic ns; None: no limit.
        """
        return None

    def on_reading(self, reading: Reading) -> None:
        """A reading has come. A tactile one is judged, or skipped, after this call."""

    def on_event(self, event: LoopEvent, grasp: GraspId | None = None) -> None:
        """An event has come before the next reading. `grasp`: announced or taken back, or None."""

    def on_verdict(self, published: PublishedVerdict) -> None:
        """A verdict was published."""

    def on_outcome(self, report: Report) -> None:
        """The outcome of a judged grasp was published."""

    def on_status(self, status: Status) -> None:
        """A status was published: once a second, and at the end."""

    def after_round(self) -> None:
        """One round of the loop is over: its wait, the readings, timers and messages."""

    @property
    def counters(self) -> dict[str, dict[str, int]]:
        """Counts since the start, for the status: by part, then by name of the count."""
        return {}

    @property
    def health(self) -> dict[str, Reason]:
        """Current problems, for the status: the reason by part, such as `publish`; {}: none."""
        return {}


def hooks(
    companions: Iterable[Companion], hook: Callable[Concatenate[Any, P], R]
) -> tuple[Callable[P, R], ...]:
    """Return the companions' methods that override `hook`, a method of `Companion`, in order."""
    name = hook.__name__
    return tuple(
        getattr(companion, name)
        for companion in companions
        if getattr(type(companion), name) is not hook
    )
