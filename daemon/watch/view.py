"""The state of one hand, from its messages and the time since the last one."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import msgspec
from msgspec import structs

from graspd.daemon.judge.reasons import (
    ADVICE,
    OPEN,
    WATCHED_LIFT,
    Decision,
    GateState,
    Need,
    Reason,
    need_of,
    parts_to_act_on,
    to_act_on,
)
from graspd.daemon.process.sleep import boottime_ns
from graspd.daemon.publish.messages import (
    MESSAGES,
    GateMessage,
    OutcomeMessage,
    State,
    Status,
    Tactile,
    Verdict,
)
from graspd.daemon.watch import figures
from graspd.daemon.watch.feed import Feed
from graspd.daemon.watch.figures import SUPERVISED, counted, doubt, rests_on, stillness
from graspd.daemon.watch.hand import Fingers, GraspLog
from graspd.daemon.watch.snapshot import Line, Link, Snapshot, Tone

TICK_S = 0.02
"""Time between two looks at the feeds, s, which is the resolution of silence."""
SNAPSHOTS_HZ = 10
"""Number of snapshots a second."""
OVERLOADED = Line(
    "overloaded",
    "the PC is too busy to judge each reading: end other programs, or use a smaller model",
)
LATE_SHARE = 0.05
"""Share of late readings in a second above which they are a problem."""
FOLLOW = frozenset({Reason.SEQUENCE_GAP, Reason.STALE, Reason.HELD})
"""Reasons that an overload causes."""
NO_VERDICT, LEANS = "no verdict yet", "leans to stable"
"""Headlines other than the verdicts."""
NO_READINGS = "no readings"
"""Text for the daemon's state `silent`. In the viewer "silent" means that no message comes."""
NO_MESSAGE = "no message has come yet: is graspd running on this endpoint?"
LATE = "the daemon is there and says nothing: top shows whether this computer is too busy"
SECONDS = 300
SECOND_NS = 1_000_000_000
LATE_UNKNOWNS = 3
"""Number of `silence_ms` for which an `unknown` verdict is shown without a newer message.

A daemon without readings sends the next `unknown` only after `silence_ms`.
"""
PROMPT_NS = 50_000_000
"""Longest time that a message may have waited here and still serve to compare the clocks, ns."""
AGE_MAX_MS = 1e12
"""Largest age of a reading in calculations, ms (30 years); a larger one may be infinite in ns."""
CATCHING_UP_NS = 1_000_000_000
"""Time to reconnect after the viewer itself stood still, ns."""
NO_SHARE = -1
"""Value in place of a probability for a second that has none."""
TONE_CODE = {
    Tone.SLIP: "x",
    Tone.TROUBLE: "t",
    Tone.SILENT: ".",
    Tone.LEARNING: "u",
    Tone.STABLE: "s",
    Tone.LEANS: "l",
    Tone.WAITING: "w",
}
"""Letter of each tone in `Snapshot.history`."""


class History:
    """Keeps the tones and the highest p_slip of each of the last `SECONDS` seconds.

    A tone is the colour class of the verdict that is shown.
    """

    def __init__(self) -> None:
        self.seconds: deque[tuple[str, int]] = deque(maxlen=SECONDS)
        """Tones and highest probability of slip of each second, the oldest first.

        Tones are letters of `TONE_CODE`, each once, the latest last; "" for a second without any.
        The probability is in %; `NO_SHARE` if there was none.
        """
        self._newest = 0
        """Number of the last second."""

    def add(self, now_ns: int, tone: Tone, p_slip: float | None) -> None:
        """Add what is shown at `now_ns`; a `p_slip` of None adds no probability."""
        second, code = now_ns // SECOND_NS, TONE_CODE[tone]
        steps = min(second - self._newest, SECONDS) if self.seconds else 1
        self.seconds.extend([("", NO_SHARE)] * steps)
        self._newest = second
        codes, highest = self.seconds.pop()
        share = NO_SHARE if p_slip is None else round(100 * p_slip)
        self.seconds.append((codes.replace(code, "") + code, max(share, highest)))


class View:
    """Makes a `Snapshot` of one hand at any time from its messages, in constant memory."""

    def __init__(
        self,
        endpoint: str,
        hand: str | None = None,
        look: str = "",
        doctor: str = "graspd doctor SCENE",
        wall: Callable[[], float] = time.time,
    ) -> None:
        """`hand`: its name; None: the first whose message arrives.

        `look`, `doctor`: advice for a person if no message, or no reading, comes.
        `wall`: returns seconds since 1970.
        """
        self.link = Link.CONNECTING
        self.stood_still = 0, 0
        """Begin and end of the viewer's own last pause, ns."""
        self._endpoint = endpoint
        self._hand = hand
        self._look, self._doctor = look, doctor
        self._wall = wall
        self._verdict: Verdict | None = None
        self._verdict_ns = 0
        """Time of arrival of the last verdict, ns."""
        self._clocks_ns: int | None = None
        """Smallest difference so far of a verdict's arrival here and its time on the daemon's
        clock, ns."""
        self._gate: GateState | None = None
        self._status: Status | None = None
        self._grasps = GraspLog()
        self._fingers = Fingers()
        self._lost = self._late = 0
        """`_lost`: missing or malformed messages. `_late`: late readings of the last second."""
        self._history = History()

    def take(
        self, topic: bytes, payload: bytes, earliest_ns: int, latest_ns: int | None = None
    ) -> None:
        """Take in a message that arrived between `earliest_ns` and `latest_ns`, monotonic.

        `latest_ns` None: it arrived at `earliest_ns`.
        """
        now_ns = earliest_ns
        kind, _, hand = topic.decode("ascii", "replace").partition(".")
        if kind not in MESSAGES or (self._hand is not None and hand != self._hand):
            return
        try:
            message = msgspec.json.decode(payload, type=MESSAGES[kind])
        except (msgspec.DecodeError, UnicodeDecodeError):
            self._lost += 1
            return
        self._hand = hand
        match message:
            case Verdict():
                self._take_verdict(message, earliest_ns, latest_ns or earliest_ns)
            case GateMessage():
                self._gate = message.state
            case Tactile():
                fits = self._fingers.take(message, now_ns, self._resting())
                self._lost += not fits
            case OutcomeMessage():
                self._grasps.end(message)
            case Status():
                self._late = _late(self._status, message)
                self._status = message

    def _take_verdict(self, verdict: Verdict, earliest_ns: int, latest_ns: int) -> None:
        last = self._verdict
        if last is not None and verdict.boot_id == last.boot_id:
            if verdict.seq <= last.seq:
                return  # an old or repeated message does not show that the daemon lives
            self._lost += verdict.seq - last.seq - 1
        elif last is not None:
            self._clocks_ns = None
        now_ns = self._arrival_ns(verdict, earliest_ns, latest_ns)
        self._verdict, self._verdict_ns, self._gate = verdict, now_ns, verdict.gate
        self._grasps.take(verdict, now_ns)
        if Reason.NOT_TARED in verdict.reasons and verdict.fingers is not None:
            self._fingers.forget(name for name, state in verdict.fingers.items() if state is None)

    def _arrival_ns(self, verdict: Verdict, earliest_ns: int, latest_ns: int) -> int:
        """Return when a verdict arrived, ns, estimated by its own time, as it may have waited."""
        sent_ns = verdict.t_mono_ns + round(min(verdict.age_ms, AGE_MAX_MS) * 1e6)
        if self._verdict_ns < self.stood_still[1]:
            self._clocks_ns = None  # one of the clocks may have stopped in a sleep of the computer
        if latest_ns - earliest_ns <= PROMPT_NS:
            way_ns = latest_ns - sent_ns
            self._clocks_ns = way_ns if self._clocks_ns is None else min(self._clocks_ns, way_ns)
        if self._clocks_ns is None:
            return earliest_ns
        return min(max(sent_ns + self._clocks_ns, earliest_ns), latest_ns)

    def snapshot(self, now_ns: int) -> Snapshot:
        """Return everything to show at `now_ns`. Call it `SNAPSHOTS_HZ` times a second."""
        tone, why = self._verdict_now(now_ns)
        silent = tone is Tone.SILENT
        last, status = self._verdict, self._status
        verdict = None if silent else last
        judged = verdict if tone in {Tone.STABLE, Tone.LEANS, Tone.SLIP} else None
        p_slip = None if judged is None else judged.p_slip
        word = "unknown" if judged is None else judged.verdict.value
        if not (silent and self._is_catching_up(now_ns)):
            self._history.add(now_ns, tone, p_slip)
        wall_t = self._wall()
        health = [] if status is None or silent else _health(status, self._late)
        return Snapshot(
            endpoint=self._endpoint,
            link=self.link,
            hand=self._hand,
            t=wall_t,
            last_t=None if last is None else wall_t - (now_ns - self._verdict_ns) / 1e9,
            tone=tone,
            headline=NO_VERDICT if last is None else LEANS if tone is Tone.LEANS else word,
            evidence="" if verdict is None else rests_on(verdict),
            p_slip=p_slip,
            why=why,
            grasp=None if last is None else last.grasp,
            gate=None if self._gate is None or silent else self._gate.value,
            contact=None if verdict is None or verdict.contact is None else list(verdict.contact),
            still=stillness(None if verdict is None else verdict.still_ms),
            grasps=self._grasps.last(now_ns, None if silent else self._held()),
            fingers=[] if verdict is None else self._fingers.images(verdict, status, now_ns),
            joints={} if silent else self._fingers.joints(now_ns),
            health=health,
            not_well=_not_well(health, why),
            state=None if status is None or silent else _state(status),
            model=None if last is None else f"{last.model} {last.model_sha}",
            learning=figures.learning(last, status),
            timing=figures.timing(last, status, self._lost),
            history=[codes for codes, _ in self._history.seconds],
            history_p=[share for _, share in self._history.seconds],
        )

    def _verdict_now(self, now_ns: int) -> tuple[Tone, list[Line]]:
        """Return the tone and the reasons to show now; after too long a silence, `SILENT`."""
        verdict = self._verdict
        if verdict is None:
            return Tone.SILENT, [Line("silent", NO_MESSAGE), *self._where_to_look()]
        if now_ns - self._verdict_ns > verdict.silence_ms * 1e6 * (
            1 if verdict.valid else LATE_UNKNOWNS
        ):
            return Tone.SILENT, [self._silence(now_ns), *self._where_to_look()]
        if verdict.verdict is Decision.UNKNOWN:
            return self._unknown(verdict)
        also = [SUPERVISED] if verdict.supervised else []
        if verdict.session_calibrated is False:
            also.append(Line("less sure", ADVICE[Reason.NOT_CALIBRATED]))
        if verdict.verdict is Decision.SLIP:
            what = "do not lift unsupervised" if verdict.supervised else "do not lift"
            return Tone.SLIP, [Line(what, "it is judged to slip; grasp again"), *also]
        why_not = doubt(verdict)
        if why_not is not None or verdict.supervised:
            return Tone.LEANS, [*([] if why_not is None else [why_not]), *also]
        return Tone.STABLE, [Line("lift", "it is judged to hold"), *also]

    def _unknown(self, verdict: Verdict) -> tuple[Tone, list[Line]]:
        reasons = to_act_on(verdict.reasons)
        if self._is_overloaded() and FOLLOW.intersection(reasons):
            rest = [reason for reason in reasons if reason not in FOLLOW]
            return Tone.TROUBLE, [OVERLOADED, *map(_line, rest)]
        why = [_line(reason) for reason in reasons]
        if Reason.STALE in reasons:
            why.append(Line("look", self._doctor))
        if verdict.supervised and WATCHED_LIFT.issuperset(reasons):
            return Tone.LEARNING, [SUPERVISED, *why]
        return Tone.TROUBLE if need_of(reasons) is Need.ACT else Tone.WAITING, why

    def _is_overloaded(self) -> bool:
        status = self._status
        return status is not None and status.overloaded and status.state is State.RUNNING

    def _silence(self, now_ns: int) -> Line:
        stopped_ns, went_on_ns = self.stood_still
        stood_ns = went_on_ns - max(stopped_ns, self._verdict_ns)
        if stood_ns <= 0:
            return Line("silent", f"no message for {_duration(now_ns - self._verdict_ns)}")
        held_up = f"this viewer itself stood still for {_duration(stood_ns)}"
        if self._is_catching_up(now_ns):
            return Line("held up", f"{held_up} and connects again")
        return Line("silent", f"no message since; {held_up}")

    def _is_catching_up(self, now_ns: int) -> bool:
        _, went_on_ns = self.stood_still
        return self._verdict_ns < went_on_ns and now_ns - went_on_ns < CATCHING_UP_NS

    def _where_to_look(self) -> list[Line]:
        lines = [Line("link", self.link)]
        if self.link is Link.CONNECTED:
            return [*lines, Line("look", LATE)]
        if self._look and not self.link.is_turned_away:
            lines.append(Line("look", self._look))
        return lines

    def _resting(self) -> Sequence[str]:
        """Return the tared fingers while the gate says that nothing touches, else none."""
        if self._status is None or self._gate is not GateState.IDLE:
            return ()
        return self._status.tared or ()

    def _held(self) -> tuple[str, int] | None:
        verdict = self._verdict
        return None if verdict is None or self._gate in OPEN else (verdict.boot_id, verdict.grasp)


def _state(status: Status) -> str:
    return NO_READINGS if status.state is State.SILENT else status.state.value


def _line(reason: Reason) -> Line:
    return Line(reason.value, ADVICE[reason], need_of([reason]))


def _late(former: Status | None, status: Status) -> int:
    """Return the number of late readings between two statuses; 0 if acceptable or not known."""
    if former is None or former.boot_id != status.boot_id:
        return 0
    late = status.late_readings - former.late_readings
    elapsed_s = (status.t_mono_ns - former.t_mono_ns) / 1e9
    return late if late > LATE_SHARE * status.readings_hz * elapsed_s else 0


def _health(status: Status, late: int) -> list[Line]:
    """Return lines on overload or `late` readings, then one per reason with all its parts.

    Reasons are in the order in which to act.
    """
    lines = [OVERLOADED] if status.overloaded else []
    if late and not status.overloaded:
        lines.append(
            Line("late", f"the PC is too busy: {counted(late, 'late verdict')} in a second")
        )
    for reason, names in parts_to_act_on(status.health).items():
        line = _line(reason)
        lines.append(structs.replace(line, what=f"{', '.join(names)} {line.what}"))
    return lines


def _not_well(health: Sequence[Line], why: Sequence[Line]) -> str:
    """Return in a few words the parts to act on, except those in the verdict's reasons."""
    said = {line.advice for line in why}
    acts = [line.what for line in health if line.need is Need.ACT and line.advice not in said]
    more = f" and {len(acts) - 1} more" if len(acts) > 1 else ""
    return f"not well: {acts[0]}{more}" if acts else ""


def _duration(span_ns: int) -> str:
    span_ms = span_ns / 1e6
    return f"{span_ms:.0f} ms" if span_ms < 1e4 else f"{span_ms / 1e3:.0f} s"


class HandFeed(NamedTuple):
    """The messages of one hand, and the view that takes them."""

    feed: Feed
    view: View


def snapshots(hands: Sequence[HandFeed], is_over: Callable[[], bool]) -> Iterator[list[Snapshot]]:
    """Yield a snapshot of each hand ten times a second until `is_over()`, which waits a tick."""
    due_s = 0.0
    while not is_over():
        for feed, view in hands:
            for topic, payload in feed.take():
                view.take(topic, payload, feed.empty_ns, feed.looked_ns)
            view.link, view.stood_still = feed.link, feed.stood_still
        if time.monotonic() >= due_s:
            due_s = max(due_s + 1 / SNAPSHOTS_HZ, time.monotonic() + TICK_S)
            yield [view.snapshot(boottime_ns()) for _, view in hands]
