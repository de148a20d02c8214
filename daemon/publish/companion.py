"""Companions of the loop, which it tells what happens: sockets, session keeper, recorder, printer,
realtime mode, service manager."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import Enum
from typing import Any, Concatenate, NamedTuple, ParamSpec, Protocol, TypeVar

from daemon.judge.pipeline import Judgement
from daemon.publish.messages import Status, Verdict
from daemon.trust.lift_book import GraspId, LiftBook, Report
from drivers.base import Reading, TactileReading

P = ParamSpec("P")
R = TypeVar("R")

Answer = Callable[[str | None], None]
"""Takes None for yes, or why not."""
REPEATED = "repeated"
"""Answers an outcome that is known and kept already: nothing was written or published again."""


def at_once(answer: Answer) -> None:
    """Answer yes: outcomes are kept nowhere."""
    answer(None)


class LoopEvent(Enum):
    """What a replay must know besides the readings, to judge them the same way."""

    ASKED = "asked"
    """A controller has asked for a verdict."""
    SKIPPED = "skipped"
    """Readings before the next one were skipped, because they came too fast."""


class PublishedVerdict(NamedTuple):
    """A verdict that was published."""

    judgement: Judgement
    verdict: Verdict
    payload: bytes
    """The verdict, encoded."""
    reading: TactileReading | None
    """What the verdict is about; None after silence."""
    is_answer: bool
    """True if this is the verdict that controllers who ask wait for."""
    grasp: GraspId
    lifts: LiftBook
    """Where a peer that asked to lift the grasp claims it."""


class Requests(Protocol):
    """Takes what peers want of the loop."""

    def ask(self) -> None:
        """Ask for a verdict, by which a controller decides whether to lift."""

    def outcome(self, report: Report, answer: Answer) -> None:
        """Tell how the lift of a grasp has ended.

        `answer` is called with None once the outcome is on the disk, with `REPEATED`, or with the
        reason why the outcome is refused or not kept.
        """


class Companion:
    """Base class: a companion overrides the hooks that concern it.

    Hooks are called in the loop's thread, in the order of the companions: they must not block, and
    what they raise ends the loop.
    """

    def before_wait(self, requests: Requests) -> None:
        """Pass on to `requests` what has come from outside; the loop waits after this."""

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
        """Counts since the start, for the status, by the name of the part."""
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
