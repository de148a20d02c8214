"""What goes along with the loop and is told what happens there: sockets, session keeper, recorder,
printer, realtime mode, service manager."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Concatenate, Literal, ParamSpec, Protocol, TypeVar

from daemon.judge.pipeline import Judgement
from daemon.publish.messages import Status, Verdict
from drivers.base import JointReading, TactileReading

P = ParamSpec("P")
R = TypeVar("R")

Answer = Callable[[str | None], None]
"""Takes None for yes, or why not."""
CONTRADICTS = "contradicts: another outcome of this grasp was told before"
"""Why an outcome is not taken: what was told first stays."""


class Requests(Protocol):
    """Takes what others want of the loop."""

    def ask(self) -> None:
        """Somebody wants a verdict, by which to decide whether to lift."""

    def outcome(
        self,
        boot_id: str,
        grasp: int,
        outcome: Literal["stable", "slip"],
        object_name: str | None = None,
    ) -> str | None:
        """The lift of a grasp has ended so; None if that is of use, else why not."""

    def keep(self, answer: Answer) -> None:
        """Call `answer` once what was told is kept, or is known not to be."""


class Companion:
    """Base class: a companion overrides the hooks that concern it.

    Hooks are called in the loop's thread, in the order of the companions: they must not block, and
    what they raise ends the loop.
    """

    def filenos(self) -> list[int]:
        """Descriptors that end the loop's wait when they become readable."""
        return []

    def due_ns(self) -> int | None:
        """When the loop's wait is to end at the latest, monotonic ns; None if that is open."""
        return None

    def before_wait(self, requests: Requests) -> None:
        """The loop is about to wait. What has come from outside goes to `requests`."""

    def before_readings(self) -> None:
        """Readings are about to be judged, or a status is about to be made."""

    def on_joints(self, reading: JointReading) -> None:
        """Joint angles have come."""

    def on_skipped(self) -> None:
        """Readings before the next one were left out, because they came too fast."""

    def on_asked(self) -> None:
        """Somebody has asked for a verdict."""

    def on_outcome(
        self, grasp: int, outcome: Literal["stable", "slip"], object_name: str | None
    ) -> None:
        """The outcome of a judged grasp was told and published."""

    def keep(self, answer: Answer) -> None:
        """Call `answer` once what was told until now is on the disk, or is known not to be."""

    def on_answer(self, verdict: Verdict, payload: bytes) -> None:
        """A verdict is about to be told that answers who has asked; `payload` is it, encoded."""

    def on_verdict(self, verdict: Verdict, payload: bytes, reading: TactileReading | None) -> None:
        """A verdict was published; `reading` is what it is about, None where nothing has come."""

    def on_judged(self, judgement: Judgement) -> None:
        """The network judged a reading, and the verdict was published."""

    def on_status(self, status: Status) -> None:
        """A status was published: once a second, and at the end."""

    def after_round(self) -> None:
        """Drivers, timers and messages have been seen to, once."""

    def counters_by_part(self) -> dict[str, dict[str, int]]:
        """What was counted since the start, for the status, under the names of the parts."""
        return {}


def overridden(
    companions: Iterable[Companion], hook: Callable[Concatenate[Any, P], R]
) -> tuple[Callable[P, R], ...]:
    """A hook of `Companion`, bound to each companion that overrides it: the others cost nothing."""
    name = hook.__name__
    return tuple(
        getattr(companion, name)
        for companion in companions
        if getattr(type(companion), name) is not hook
    )
