"""Companions of the loop: sockets, session keeper, recorder, printer, realtime mode, systemd."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import Enum
from typing import Any, Concatenate, NamedTuple, ParamSpec, Protocol, TypeVar

from graspd.daemon.judge.pipeline import Judgement
from graspd.daemon.publish.messages import Status, Verdict
from graspd.daemon.trust.lift_book import GraspId, LiftBook, Report
from graspd.drivers.base import Reading, TactileReading

P = ParamSpec("P")
R = TypeVar("R")

Answer = Callable[[str | None], None]
"""Takes None for yes, or why not."""
REPEATED = "repeated"
"""Answers an outcome that is known and kept already."""


def at_once(answer: Answer) -> None:
    """Answer yes: outcomes are kept nowhere."""
    answer(None)


class LoopEvent(Enum):
    """Event that a replay needs besides the readings."""

    ASKED = "asked"
    SKIPPED = "skipped"
    """Readings before the next one were skipped."""
    ANNOUNCED = "announced"
    """A controller asked whether it may lift, and the answer was `stable`."""


class PublishedVerdict(NamedTuple):
    """A verdict that was published."""

    judgement: Judgement
    verdict: Verdict
    payload: bytes
    """JSON."""
    reading: TactileReading | None
    """None after silence."""
    is_answer: bool
    """True if controllers who ask wait for this verdict."""
    grasp: GraspId
    lifts: LiftBook


class Requests(Protocol):
    """Takes what peers want of the loop."""

    def ask(self) -> None:
        """Ask for a verdict, by which a controller decides whether to lift."""

    def outcome(self, report: Report, answer: Answer) -> None:
        """Tell how a lift has ended; `answer` gets None once that is on the disk.
        Else `answer` gets `REPEATED`, or why the outcome is refused or not kept."""


class Companion:
    """Base class: a companion overrides the hooks that concern it.
    The loop's thread calls them: they must not block, and what they raise ends the loop."""

    def before_wait(self, requests: Requests) -> None:
        """Pass on to `requests` what has come from outside."""

    def due_ns(self) -> int | None:
        """Latest end of the loop's wait, monotonic ns; None: no limit."""
        return None

    def filenos(self) -> list[int]:
        """Return the descriptors that end the loop's wait when they become readable."""
        return []

    def on_reading(self, reading: Reading) -> None:
        """A reading has come, and is neither judged nor skipped yet."""

    def on_event(self, event: LoopEvent) -> None:
        """Something has happened before the next reading."""

    def on_verdict(self, published: PublishedVerdict) -> None:
        """A verdict was published."""

    def on_outcome(self, report: Report) -> None:
        """The outcome of a judged grasp was published."""

    def on_status(self, status: Status) -> None:
        """A status was published: once a second, and at the end."""

    def after_round(self) -> None:
        """The loop has been once around: drivers, timers and messages."""

    @property
    def counters(self) -> dict[str, dict[str, int]]:
        """Counts since the start, by the name of the part."""
        return {}


def hooks(
    companions: Iterable[Companion], hook: Callable[Concatenate[Any, P], R]
) -> tuple[Callable[P, R], ...]:
    """Return a hook of `Companion`, bound to each companion that overrides it."""
    name = hook.__name__
    return tuple(
        getattr(companion, name)
        for companion in companions
        if getattr(type(companion), name) is not hook
    )
