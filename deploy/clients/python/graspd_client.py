"""May the hand lift? Client of a graspd daemon: its newest verdict, or `unknown` without one.

One file to copy: it needs Linux, Python 3.9 or newer and pyzmq, and nothing of graspd itself. The
messages are those of deploy/wire/README.md, version 1.

    with Client("ipc:///run/graspd/right.ipc", ask_endpoint=ASK) as client:
        if answer := client.may_i_lift(0.5):
            client.tell(answer.verdict, Outcome.HELD if lift() else Outcome.SLIPPED)

Only ZeroMQ's own thread runs in the background. Use an object only in the thread that made
it. Only `verdict(wait_s)`, `may_i_lift(deadline_s)`, `wait_for_grasp(deadline_s)`,
`wait_for_slide(timeout_s)` and `tell(..., wait_s)` wait, at most for the given time, and `close`,
for up to 0.2 s. `AsyncClient` has the same for asyncio.
"""

from __future__ import annotations

import json
import logging
import os
import re
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import zmq
from zmq.auth import load_certificate

__all__ = [
    "AsyncClient",
    "Client",
    "Counts",
    "Decision",
    "FingerState",
    "Keys",
    "LiftAnswer",
    "Outcome",
    "OutcomeAnswer",
    "Risk",
    "SlideAnswer",
    "Verdict",
]

VERSION = 1  # version of the messages; others are not understood
INTEGER_MAX = 2**60  # largest integer in a message: 36 years in ns
REAL_MAX = 1e12  # largest number or age in a message: thirty years in ms
WAIT_MAX_S = 1e9  # longest wait of a call: thirty years
# A verdict has 0.7 kB, at most 3; a peer that sends more is not a daemon and is disconnected.
MESSAGE_MAX_BYTES = 1 << 16
OPENINGS_MAX = 100  # most lists and objects in a message; a verdict has ten
QUEUE_MAX = 1000  # messages that wait to be read: ten seconds at 100 Hz
# A client that reads nothing for longer reconnects, because its queue is old and full.
READ_WITHIN_NS = 5_000_000_000
# Shortest and longest time without a message after which a client reconnects. libzmq does not
# retry after a refusal, but the daemon may admit the client by then.
QUIET_NS, QUIET_MAX_NS = 1_000_000_000, 10_000_000_000
# The computer has slept if its two clocks differ by more. A sleep takes seconds, the
# scheduler a moment between two looks at the clocks.
SLEPT_NS = 50_000_000
# Longest wait in one piece while the clock of another computer is not known, and so the error of
# the time when its message came.
SLICE_MS = 10
# Most by which a message's time may be in the future while the clocks count as the same.
CLOCK_SLACK_NS = 1_000_000
# Largest drift between two computers' clocks: NTP slews by 5e-4, a bad crystal is off by 1e-4.
DRIFT = 1e-3
# Largest total drift while the daemon's clock is not known; beyond it verdicts are unknown. A delay
# that grows as slowly looks the same.
DRIFT_MAX_NS = 20_000_000
# Time between two questions for the daemon's clock, and after one that was not answered.
CLOCK_EVERY_NS, CLOCK_RETRY_NS = 1_000_000_000, 10_000_000_000
FORMER_MAX = 16  # most ended starts of the daemon that are remembered
# On TCP: time between two heartbeats, and time without one until reconnecting.
HEARTBEAT_MS, HEARTBEAT_TIMEOUT_MS = 1000, 3000
NAME_BYTES = 16  # length of a client's random name, with which its routing ids begin
OBJECT_MAX = 64  # most characters of an object's name
LIFTS_MAX = 256  # lifts that are remembered, as in graspd
WARN_EVERY = 10  # unreported lifts for each warning
# Longest wait at closing until graspd has received that no lift follows, and most connections that
# say so at a time.
TAKE_BACK_MS, LEAVING_MAX = 200, 4

# The only reasons with which a grasp may be lifted under supervision: they come from [risk].
_WITHHELD = {"unproven", "low-confidence"}
# Pattern of an object's name that the daemon accepts.
_OBJECT = re.compile(rf"[A-Za-z0-9_][A-Za-z0-9_.-]{{0,{OBJECT_MAX - 1}}}")
_OBJECT_IS = f"1 to {OBJECT_MAX} ASCII letters, digits, _, -, ., the first no - and no ."

_T = TypeVar("_T")
Waits = Generator[int, None, _T]
"""A call in steps: yields the longest time to wait for a message, ms, before the next step."""

log = logging.getLogger("graspd_client")


class Decision(str, Enum):  # noqa: UP042 - StrEnum needs Python 3.11
    """graspd's decision about a grasp; equal to the wire's word and printed like it."""

    UNKNOWN = "unknown"
    STABLE = "stable"
    SLIP = "slip"

    def __str__(self) -> str:
        return str(self.value)


class FingerState(str, Enum):  # noqa: UP042 - StrEnum needs Python 3.11
    """State of a finger; equal to the wire's word and printed like it."""

    FREE = "free"
    TOUCH = "touch"
    SLIDE = "slide"

    def __str__(self) -> str:
        return str(self.value)


class Outcome(Enum):
    """How a lift ended; `Outcome("held")` is the same as `Outcome("stable")`. A bool is refused."""

    HELD = "stable"
    SLIPPED = "slip"
    NOT_LIFTED = "not-lifted"

    @classmethod
    def _missing_(cls, value: object) -> Outcome | None:
        return {"held": cls.HELD, "slipped": cls.SLIPPED}.get(str(value))


@dataclass(frozen=True)
class Risk:
    """Outcomes of `stable` lifts: number of `lifts` with a known outcome, and of `slips` among
    them."""

    target: float | None  # share of slips that is allowed; None: no risk is set
    lifts: int
    slips: int
    outstanding: int  # outcomes that can still come
    bound: float | None  # upper bound of `slips`; each outstanding lift may add one
    warm_up_left: int  # outcomes missing until most grasps need no supervision
    announced: int = 0  # grasps answered `stable` to `lift`, less those taken back
    awaited: int = 0  # announced lifts without an outcome; too many forbid `stable`


@dataclass(frozen=True)
class Verdict:
    """Verdict on the grasp. True in an `if` exactly when it is stable and needs no person.

    `decision` is `stable`, `slip` or `unknown`. `reasons` say why it is unknown: the daemon's, or
    one of those in deploy/clients/README.md. `p_slip` is the probability of slip after learning
    from `outcomes` lifts, `p_slip_model` that of the model alone; both are None when unknown.
    `grasp` is the number of the contact episode, `age_ms` the time since the reading's last byte,
    from another computer estimated. `supervised`: graspd would learn from the lift; lift only while
    a person watches.
    `early`: it was judged when nothing moved fast, but something might still slide slowly.
    `still_ms` is for how long the hand has been still, ms: from 100 on nothing moves fast, from 240
    on nothing slides slowly either. `motion` is the motion of each finger, in units of its own
    noise; `motion_limits` is the largest motion that counts as still. `fingers` has the state of
    each finger. Each is None if not known; a state is never known from a reading older than
    `max_age_ms`. `owner` is `you` if you report the outcome of the lift, `another` if another
    controller does, which may be lifting. `boot_id` names the daemon's start, `seq` numbers the
    messages since. `risk` is None if graspd neither learns nor has a `[risk]`. Fields that no
    message has given yet are None.
    """

    decision: Decision
    reasons: tuple[str, ...] = ()
    p_slip: float | None = None
    grasp: int | None = None
    seq: int | None = None
    boot_id: str | None = None
    age_ms: float | None = None
    p_slip_model: float | None = None
    outcomes: int = 0
    supervised: bool = False
    risk: Risk | None = None
    early: bool = False
    still_ms: float | None = None
    motion: dict[str, float | None] | None = field(default=None, hash=False)
    motion_limits: dict[str, float] | None = field(default=None, hash=False)
    fingers: dict[str, FingerState | None] | None = field(default=None, hash=False)
    owner: str | None = None

    def __bool__(self) -> bool:
        return self.decision == Decision.STABLE and not self.supervised

    def unknown(self, *reasons: str) -> Verdict:
        """Return the same verdict as `unknown` for these reasons, which forbids a lift."""
        held_back = replace(self, decision=Decision.UNKNOWN, reasons=reasons, supervised=False)
        return replace(held_back, p_slip=None, p_slip_model=None)


@dataclass(frozen=True)
class LiftAnswer:
    """Whether to lift. True in an `if` exactly when the hand may."""

    verdict: Verdict
    """Verdict that decided. Its reasons may also be `no-answer`, `late` and `not-still`."""
    waited_s: float
    supervised: bool = False
    """True if the hand may lift only while a person watches; only if asked by `supervised=True`."""

    def __bool__(self) -> bool:
        return bool(self.verdict) or self.supervised


@dataclass(frozen=True)
class SlideAnswer:
    """Result of watching a lift by its fingers. True in an `if` when the lift must be stopped."""

    verdict: Verdict
    """Newest verdict; its `fingers` and `reasons` say what is known."""
    waited_s: float
    sliding: tuple[str, ...] = ()
    """Fingers along which something slides."""
    held: bool = False
    """True if fingers touched, all of them until the timeout, and nothing slid."""

    def __bool__(self) -> bool:
        return not self.held


@dataclass(frozen=True)
class OutcomeAnswer:
    """Answer to a reported outcome. True in an `if` exactly when graspd has accepted it."""

    why: str = ""
    """Why it was not accepted: the daemon's text, or a reason of deploy/clients/README.md."""

    def __bool__(self) -> bool:
        return not self.why


@dataclass
class Counts:
    """Numbers of messages since the client was made."""

    messages: int = 0  # new messages of this hand
    lost: int = 0  # messages missing by gaps in `seq`
    repeats: int = 0  # messages that were known already
    malformed: int = 0  # messages and answers that are not understood
    restarts: int = 0  # restarts of the daemon
    former: int = 0  # messages of an earlier start of the daemon


class Keys(NamedTuple):
    """CURVE keys, Z85: the daemon's public key, and the client's own pair."""

    server_key: bytes
    public_key: bytes
    secret_key: bytes

    @classmethod
    def load(cls, server: Path, own: Path) -> Keys:
        """Return the keys in the daemon's `.key` and the client's `.key_secret` file (`graspd
        keys`).

        Raises `OSError` or `ValueError`.
        """
        public, secret = load_certificate(own)
        if secret is None:
            raise ValueError(f"{own} has no secret key")
        return cls(load_certificate(server)[0], public, secret)


class _Hand:
    """Base of both clients: verdicts of one hand. Its calls are `Waits` that subclasses run."""

    def __init__(
        self,
        endpoint: str,
        hand: str = "right",
        max_age_ms: float = 100.0,
        *,
        ask_endpoint: str | None = None,
        same_computer: bool | None = None,
        keys: Keys | None = None,
        max_p_slip: float = 0.5,
    ) -> None:
        """`endpoint`: that of the scene's `[publish]`. `hand`: the scene's `hand.name`.

        `max_age_ms`: largest age of a reading that permits a lift, ms.

        `ask_endpoint` (`[ask]`): socket at which `may_i_lift` asks for a judgement and `tell`
        reports. `same_computer`: True if the daemon's monotonic clock is also the client's. None:
        True for `ipc://` and loopback addresses, so pass False for a tunnel. `max_p_slip`: a
        `stable` with this `p_slip` or more counts as unknown; pass the scene's `slip_threshold` if
        it is above 0.5. `keys`: None for no encryption. Raises `zmq.ZMQError` for a wrong endpoint,
        `TypeError` for one that is not text, and `ValueError` for an invalid age or probability.
        """
        for name, text in (("endpoint", endpoint), ("hand", hand), ("ask_endpoint", ask_endpoint)):
            if not isinstance(text, str) and (name, text) != ("ask_endpoint", None):
                raise TypeError(f"{name} must be a text, not {text!r}")
        if not (_is_amount(max_age_ms) and max_age_ms > 0.0):
            raise ValueError(f"max_age_ms must be above 0 and finite, not {max_age_ms!r}")
        if not (_is_amount(max_p_slip) and 0.0 < max_p_slip <= 1.0):
            raise ValueError(f"max_p_slip must be above 0 and at most 1, not {max_p_slip!r}")
        if same_computer is None:
            same_computer = is_same_computer(endpoint)
        topic = f"verdict.{hand}".encode()
        self._newest = Newest(topic, round(max_age_ms * 1e6), same_computer, max_p_slip)
        self._max_age_ns = round(max_age_ms * 1e6)
        self._asks = ask_endpoint is not None
        self._closed = self._behind = False
        self._pid = os.getpid()
        self._turn = threading.Lock()
        """Lock that a running call holds."""
        self._lifts: dict[tuple[str, int], bool] = {}
        """Grasps whose lift was allowed, the oldest first; True if graspd has the outcome."""
        self._last = self._telling = "", 0
        """Last grasp that was allowed to be lifted, and the one whose outcome is being reported."""
        self._told = OutcomeAnswer("no-answer")
        self._forgotten, self._warn_at = 0, 1
        self._returned = "", 0
        """Grasp that `wait_for_grasp` returned last."""
        self._link = _Link(endpoint, topic, ask_endpoint, keys)
        # A garbage-collected context would wait for its sockets, which it no longer knows.
        weakref.finalize(self, _close_in, os.getpid(), self._link).atexit = False
        self._compares_clocks = self._asks and not same_computer
        self._clock_asked_ns: int | None = None
        self._clock_due_ns = 0
        self._read_ns = self._empty_ns = self._heard_ns = time.monotonic_ns()
        self._quiet_ns, self._slept_ns = QUIET_NS, _slept_ns()

    @property
    def counts(self) -> Counts:
        """Return the numbers of messages so far."""
        return self._newest.counts

    @property
    def unreported(self) -> int:
        """Number of lifts, before the last allowed one, of which graspd has no outcome.

        graspd cannot learn from them. With `[risk]` a lift that was asked for and is never reported
        counts as a slip. The logger `graspd_client` warns of the first one and every ten later.
        """
        untold = (key != self._last for key, told in self._lifts.items() if not told)
        return self._forgotten + sum(untold)

    def __reduce__(self) -> str:
        raise TypeError("a client belongs to its process: make one in each process")

    def _verdict(self, due_ns: int) -> Waits[Verdict]:
        while not self._closed and not self._drain() and (yield from self._wait(due_ns)):
            pass
        if self._closed:
            return Verdict(Decision.UNKNOWN, ("closed",))
        if self._behind:
            return Verdict(Decision.UNKNOWN, ("behind",))
        return self._newest.at(time.monotonic_ns())

    def _may_i_lift(
        self, deadline_s: float, supervised: bool, still_ms: float | None
    ) -> Waits[LiftAnswer]:
        if still_ms is not None and not _is_amount(still_ms):
            raise ValueError(f"still_ms must be 0 or more and finite, not {still_ms!r}")
        began_ns = time.monotonic_ns()
        due_ns = _due_ns("deadline_s", deadline_s)
        asking = self._link.asking if self._asks and not self._closed else None
        question = _Question(self._newest, asking, supervised is True, still_ms)
        allowed = False
        try:
            decided = question.decided((yield from self._verdict(0)))
            while not question.is_over(decided) and (yield from self._wait(due_ns)):
                decided = question.decided((yield from self._verdict(0)))
                if time.monotonic_ns() > due_ns and question.permits(decided):
                    decided = decided.unknown("late")
            allowed = question.permits(decided)
        finally:
            self._link.asking.hang_up(lifts=allowed)
        decided = question.at_the_end(decided)
        waited_s = (time.monotonic_ns() - began_ns) / 1e9
        answer = LiftAnswer(decided, waited_s, supervised is True and decided.supervised)
        if answer:
            self._allow(_key(decided))
        return answer

    def _wait_for_grasp(self, deadline_s: float, supervised: bool) -> Waits[Verdict | None]:
        due_ns = _due_ns("deadline_s", deadline_s)
        while True:
            said = yield from self._verdict(due_ns)
            is_judged = said.decision != Decision.UNKNOWN
            is_judged |= supervised is True and said.supervised
            if is_judged and not said.early and _key(said) != self._returned:
                self._returned = _key(said)
                return said
            if self._closed or time.monotonic_ns() >= due_ns:
                return None

    def _wait_for_slide(self, timeout_s: float) -> Waits[SlideAnswer]:
        began_ns = sure_ns = time.monotonic_ns()
        due_ns = _due_ns("timeout_s", timeout_s)
        touched: set[str] = set()
        grasp, is_first = ("", 0), True
        while True:
            newest = yield from self._verdict(0)
            now_ns = time.monotonic_ns()
            touching = _feeling(newest, FingerState.TOUCH)
            felt = set((newest.fingers or {}).items())
            if not is_first:  # messages before the first look are from before the lift
                felt |= self._newest.passed
            is_first = False
            sliding = tuple(sorted(finger for finger, state in felt if state == FingerState.SLIDE))
            free = {finger for finger, state in felt if state == FingerState.FREE}
            if not touched:
                touched, grasp = set(touching), _key(newest)
            lost = not touched.isdisjoint(free) or (touching and _key(newest) != grasp)
            if touched and touched.issubset(touching):
                sure_ns = now_ns - round((newest.age_ms or 0.0) * 1e6)
            is_old = now_ns - sure_ns > self._max_age_ns
            ends = bool(sliding or lost or is_old or self._closed)
            if ends or not (yield from self._wait(due_ns, sure_ns + self._max_age_ns + 1)):
                waited_s = (now_ns - began_ns) / 1e9
                return SlideAnswer(newest, waited_s, sliding, held=bool(touched) and not ends)

    def _tell(
        self, lifted_on: Verdict, how: Outcome | str, object_name: str | None, wait_s: float
    ) -> Waits[OutcomeAnswer]:
        telling = _telling(lifted_on, Outcome(how), object_name)
        if not self._asks:
            raise ValueError("an outcome needs an ask_endpoint")
        due_ns = _due_ns("wait_s", wait_s)
        if self._closed:
            return OutcomeAnswer("closed")
        self._hear()
        self._link.telling.hang_up()
        self._link.telling.ask(telling)
        self._told, self._telling = OutcomeAnswer("no-answer"), _key(lifted_on)
        if Outcome(how) is not Outcome.NOT_LIFTED:
            self._newest.end(self._telling)
        self._drain()
        while self._telling[1] and (yield from self._wait(due_ns)):
            self._drain()
        return self._told

    def close(self) -> None:
        """Close the sockets, in up to 0.2 s. May be called again; every verdict is then unknown.

        A running call in another task ends at once and closes them, one in another thread at its
        next message, or without one after up to 10 s.
        """
        if not self._closed and os.getpid() == self._pid:
            self._closed = True
            self._allow(("", 0))
            self._close_if_idle()

    def _close_if_idle(self) -> None:
        if self._turn.acquire(blocking=False):
            self._link.close()
            self._turn.release()

    def _refuse_fork(self) -> None:
        """Raise `RuntimeError` after a fork: ZeroMQ's thread is the parent's."""
        if os.getpid() != self._pid:
            raise RuntimeError(
                f"this client is of process {self._pid}: make another one in this process, "
                f"{os.getpid()}, after the fork"
            )

    @contextmanager
    def _one_call(self, steps: Waits[Any]) -> Iterator[None]:
        """Allow no other call during the block, and close `steps`, this call's, at its end.

        Raises `RuntimeError` after a fork and during another call.
        """
        self._refuse_fork()
        if not self._turn.acquire(blocking=False):
            raise RuntimeError("another call is under way: one call at a time, or two clients")
        try:
            yield
        finally:
            try:
                steps.close()
            finally:
                self._turn.release()
                if self._closed:
                    self._close_if_idle()

    def _allow(self, lift: tuple[str, int]) -> None:
        """Note that the hand may lift this grasp (its `_key`); ("", 0): none. The outcome of the
        lift before is now overdue."""
        self._last = lift
        if lift[1]:
            self._lifts[lift] = False  # also if it was told as not lifted before
        if len(self._lifts) > LIFTS_MAX:
            self._forgotten += not self._lifts.pop(next(iter(self._lifts)))
        if self.unreported >= self._warn_at:
            self._warn_at = self.unreported + WARN_EVERY
            log.warning("%d lifts were allowed, and their outcome not told", self.unreported)

    def _hear(self) -> None:
        """Take in the answer to an outcome, if it has arrived."""
        payload = self._link.telling.answer()
        if payload is None:
            return
        self._link.telling.hang_up()
        self._told = _taken(payload)
        self.counts.malformed += self._told.why == "malformed"
        if self._told and self._telling in self._lifts:
            self._lifts[self._telling] = True
        self._telling = "", 0

    def _compare_clocks(self) -> None:
        """Ask another computer's daemon for its clock if that is due, and take in the answer."""
        if not self._compares_clocks:
            return
        calling, now_ns = self._link.timing, time.monotonic_ns()
        if self._clock_asked_ns is not None and (payload := calling.answer()) is not None:
            told_ns = _told_clock(payload)
            if told_ns is None:
                self.counts.malformed += 1
            else:
                self._newest.compare_clocks(self._clock_asked_ns, told_ns)
                self._clock_due_ns = self._clock_asked_ns + CLOCK_EVERY_NS
            self._clock_asked_ns = None
        if now_ns >= self._clock_due_ns:
            if self._clock_asked_ns is not None:
                calling.hang_up()  # a late answer must not be mistaken for one to this question
            self._clock_asked_ns, self._clock_due_ns = now_ns, now_ns + CLOCK_RETRY_NS
            calling.ask(b"clock")

    def _drain(self) -> bool:
        """Read waiting messages, at most `QUEUE_MAX`, without blocking; return True if one was new.

        Also takes in answers to outcomes and clock questions, and reconnects after a long silence.
        """
        self._forget_what_is_old()
        self._hear()
        self._compare_clocks()
        new, heard_ns, self._behind = False, self._heard_ns, True
        self._newest.passed.clear()
        for _ in range(QUEUE_MAX):
            before_ns = time.monotonic_ns()
            frames = self._link.receive()
            if frames is None:
                self._empty_ns = before_ns
                self._behind = False
                break
            self._heard_ns = time.monotonic_ns()
            new |= self._newest.take(frames, self._empty_ns, self._heard_ns)
        self._read_ns = time.monotonic_ns()
        if self._heard_ns != heard_ns:
            self._quiet_ns = QUIET_NS
        elif self._read_ns - heard_ns > max(self._quiet_ns, self._newest.silence_ns):
            self._quiet_ns = min(2 * self._quiet_ns, QUIET_MAX_NS)
            self._connect_anew()
        return new

    def _forget_what_is_old(self) -> None:
        """Forget the newest message after a sleep of the computer, in which the monotonic clock
        stops. Reconnect then, and after a long time without reading."""
        slept_ns = _slept_ns()
        slept = slept_ns - self._slept_ns > SLEPT_NS
        self._slept_ns = max(self._slept_ns, slept_ns)
        if slept:
            self._newest.forget("slept")
        if slept or time.monotonic_ns() - self._read_ns > READ_WITHIN_NS:
            self._connect_anew()

    def _connect_anew(self) -> None:
        self._link.renew()
        self._link.timing.hang_up()
        self._clock_asked_ns, self._clock_due_ns = None, 0
        self._empty_ns = self._heard_ns = time.monotonic_ns()

    def _wait(self, due_ns: int, look_ns: int | None = None) -> Waits[bool]:
        """Wait for a message, at most until `look_ns` (None: `due_ns`), perhaps less; return True.

        From `due_ns` on and once closed return False at once. Both times are monotonic.
        """
        now_ns = time.monotonic_ns()
        if now_ns >= due_ns or self._closed:
            return False
        if self._newest.needs_arrival:
            look_ns = now_ns + SLICE_MS * 1_000_000
        quiet_ns = self._heard_ns + max(self._quiet_ns, self._newest.silence_ns) + 1
        wake_ns = min(due_ns, quiet_ns, due_ns if look_ns is None else look_ns)
        if self._compares_clocks:
            wake_ns = min(wake_ns, self._clock_due_ns)
        yield max(wake_ns - now_ns, 0) // 1_000_000
        return True


class Client(_Hand):
    """Subscribes to the verdicts of one hand. Use it in one thread, and close it."""

    def verdict(self, wait_s: float = 0.0) -> Verdict:
        """Return the newest verdict; wait at most `wait_s` seconds for a new message.

        Raises `ValueError` for an invalid time.
        """
        return self._finish(self._verdict(_due_ns("wait_s", wait_s)))

    def may_i_lift(
        self, deadline_s: float, *, supervised: bool = False, still_ms: float | None = None
    ) -> LiftAnswer:
        """Return whether the current grasp may be lifted, within `deadline_s` seconds from now.

        Waits for a fresh `stable` or `slip`. With an ask endpoint it asks the daemon, and the
        answer and the newest message of the same grasp must both say `stable`; after an unknown
        answer it asks again. Everything else until the deadline is a no. `supervised`: pass True
        only while a person watches. A grasp from which graspd asks to learn, in the warm-up and
        sometimes later, may then be lifted if it is not `early`; the answer has `supervised`.
        `still_ms`: time, ms, for which the hand must have been still; a daemon that does not report
        it gets a no. None: `stable` is enough, even if `early`, because its scene allows that.

        Raises `ValueError` for an invalid time.
        """
        return self._finish(self._may_i_lift(deadline_s, supervised, still_ms))

    def wait_for_grasp(self, deadline_s: float, *, supervised: bool = False) -> Verdict | None:
        """Return the verdict on the next grasp once it is judged for sure; None: none in time.

        Waits at most `deadline_s` seconds for a `stable` or `slip` of a grasp that this method has
        not returned before. With `supervised` it also returns grasps to be lifted while a person
        watches. It never returns an `early` verdict. It asks nothing: call `may_i_lift` before the
        lift. Raises `ValueError` for an invalid time.
        """
        return self._finish(self._wait_for_grasp(deadline_s, supervised))

    def wait_for_slide(self, timeout_s: float) -> SlideAnswer:
        """Watch over a lift: wait until something slides, at most `timeout_s` seconds.

        It ends at once when a finger has the state `slide`, when one that touched at first is
        `free`, and when another grasp begins. It also ends when for `max_age_ms` no reading showed
        that all fingers that touched at first still do, as something may slide unseen. Raises
        `ValueError` for an invalid time.
        """
        return self._finish(self._wait_for_slide(timeout_s))

    def tell(
        self,
        lifted_on: Verdict,
        how: Outcome | str,
        object_name: str | None = None,
        wait_s: float = 2.0,
    ) -> OutcomeAnswer:
        """Report how the lift made on the verdict `lifted_on` ended, and the name of the object.

        Report `Outcome.NOT_LIFTED` if no lift followed a yes; otherwise graspd waits for an
        outcome. Waits at most `wait_s` seconds: graspd answers once the outcome is on its disk.
        Later calls take in a late answer; without one, report again. Raises `ValueError` without an
        ask endpoint, for a verdict without a grasp, for an invalid outcome or time, and for a name
        that is not 1 to 64 letters (ASCII), digits, `_`, `-`, `.`, or that begins with one of the
        last two.
        """
        return self._finish(self._tell(lifted_on, how, object_name, wait_s))

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()

    def _finish(self, steps: Waits[_T]) -> _T:
        with self._one_call(steps):
            while True:
                try:
                    timeout_ms = next(steps)
                except StopIteration as end:
                    result: _T = end.value
                    return result
                self._link.wait(timeout_ms)


class AsyncClient(_Hand):
    """`Client` for asyncio: the same rules, with methods to await where `Client` waits.

    A call sleeps until a socket wakes the loop, and may be cancelled. A second call meanwhile
    raises `RuntimeError`.
    """

    _woken: Any = None  # future of the waiting task

    async def verdict(self, wait_s: float = 0.0) -> Verdict:
        """As `Client.verdict`."""
        return await self._finish(self._verdict(_due_ns("wait_s", wait_s)))

    async def may_i_lift(
        self, deadline_s: float, *, supervised: bool = False, still_ms: float | None = None
    ) -> LiftAnswer:
        """As `Client.may_i_lift`."""
        return await self._finish(self._may_i_lift(deadline_s, supervised, still_ms))

    async def wait_for_grasp(
        self, deadline_s: float, *, supervised: bool = False
    ) -> Verdict | None:
        """As `Client.wait_for_grasp`."""
        return await self._finish(self._wait_for_grasp(deadline_s, supervised))

    async def wait_for_slide(self, timeout_s: float) -> SlideAnswer:
        """As `Client.wait_for_slide`."""
        return await self._finish(self._wait_for_slide(timeout_s))

    async def tell(
        self,
        lifted_on: Verdict,
        how: Outcome | str,
        object_name: str | None = None,
        wait_s: float = 2.0,
    ) -> OutcomeAnswer:
        """As `Client.tell`."""
        return await self._finish(self._tell(lifted_on, how, object_name, wait_s))

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_details: object) -> None:
        self.close()

    async def _finish(self, steps: Waits[_T]) -> _T:
        with self._one_call(steps):
            while True:
                try:
                    timeout_ms = next(steps)
                except StopIteration as end:
                    result: _T = end.value
                    return result
                await self._sleep(max(timeout_ms, 1) / 1e3)

    async def _sleep(self, timeout_s: float) -> None:
        """Sleep until a message or an answer waits, up to `timeout_s`."""
        import asyncio  # only here: it takes time

        loop, sockets = asyncio.get_running_loop(), self._link.sockets
        descriptors = [each.FD for each in sockets]
        self._woken = loop.create_future()
        for descriptor in descriptors:
            loop.add_reader(descriptor, self._wake)
        timer = loop.call_later(timeout_s, self._wake)
        # The descriptor only signals later messages. Reading `EVENTS` rearms it.
        if any(int(each.EVENTS) & zmq.POLLIN for each in sockets):
            self._wake()
        try:
            await self._woken
        finally:
            timer.cancel()
            self._refuse_fork()  # the loop's selector is also the parent's
            for descriptor in descriptors:
                loop.remove_reader(descriptor)

    def _wake(self) -> None:
        waits = self._woken is not None and not self._woken.done()
        if waits and not self._woken.get_loop().is_closed():
            self._woken.set_result(None)

    def close(self) -> None:
        """As `Client.close`; a waiting task is woken. May block the loop for up to 0.2 s."""
        super().close()
        self._wake()


class _Message(NamedTuple):
    """Used fields of a verdict message."""

    verdict: Verdict  # without its age
    read_ns: int  # time of the reading's last byte, by the daemon's monotonic clock
    published_ns: int  # time of sending the message, by the same clock
    silence_ns: int


class Newest:
    """State of a hand by its newest message; it has neither socket nor clock."""

    def __init__(
        self, topic: bytes, max_age_ns: int, same_computer: bool, max_p_slip: float = 0.5
    ) -> None:
        """`topic`: the hand's topic; messages with another are ignored. `max_age_ns`: largest age
        of a reading that permits a lift, ns. `same_computer`, `max_p_slip`: those of the client."""
        self.counts = Counts()
        self.passed: set[tuple[str, FingerState | None]] = set()
        """Each finger with each state that it had in the messages of the last look."""
        self._topic, self._max_age_ns, self._same_computer = topic, max_age_ns, same_computer
        self._max_p_slip = max_p_slip
        self._message: _Message | None = None
        self._published_ns: int | None = None
        """When the message was published, or an estimate (own clock), ns; None: not known."""
        self._why = "no-message"
        """Reason why no message is known."""
        self._boot_id: str | None = None
        self._seq = -1
        self._former: deque[str] = deque(maxlen=FORMER_MAX)
        self._ended: dict[tuple[str, int], None] = {}
        """Grasps whose outcome was reported, the oldest first, at most `LIFTS_MAX`."""
        self._best: tuple[int, int] | None = None
        """Smallest difference of arrival and publication, given the drift since, and its time, ns;
        None: none."""
        self._least_ns = 0
        """Smallest of these differences ever, whatever the drift, ns."""
        self._bound: tuple[int, int] | None = None
        """Lower bound of the clocks' difference by the daemon's answer, and its time, ns."""

    @property
    def silence_ns(self) -> int:
        """Longest silence before the grasp is unknown, ns; 0 without a message."""
        return 0 if self._message is None else self._message.silence_ns

    @property
    def needs_arrival(self) -> bool:
        """Return True if the age of the next message is computed from its arrival."""
        knows_clock = self._same_computer or self._bound is not None
        return not knows_clock and self._best is not None

    def forget(self, why: str) -> None:
        """Forget the message and the clocks' difference; still recognise repeats. `why`: reason to
        give until the next message."""
        self._message, self._why = None, why
        self._best = self._bound = None

    def compare_clocks(self, asked_ns: int, told_ns: int) -> None:
        """Note that the daemon's clock read `told_ns` at some time after `asked_ns` (own clock)."""
        least_ns = asked_ns - told_ns
        if self._bound is not None:
            least_ns = max(least_ns, self._at_least(self._bound, asked_ns))
        self._bound = least_ns, asked_ns

    @staticmethod
    def _at_least(bound: tuple[int, int], now_ns: int) -> int:
        """Return the least difference of own and daemon's clock at `now_ns`, ns: that of `bound`
        (difference, its time) less the drift since."""
        return bound[0] - round((now_ns - bound[1]) * DRIFT)

    def take(self, frames: Sequence[bytes], empty_ns: int, now_ns: int) -> bool:
        """Take in a message that arrived after `empty_ns` and by `now_ns` (own clock).

        Return True for a new one, understood or not; False for a repeat, or one of another hand or
        of an earlier start of the daemon.
        """
        if not frames or frames[0] != self._topic:
            return False
        found = self.read(frames[1] if len(frames) == 2 else b"")
        if isinstance(found, str):
            self._message, self._why = None, found
            return True
        if not self._is_new(found):
            return False
        self.counts.messages += 1
        self.passed.update((found.verdict.fingers or {}).items())
        self._message = found
        self._published_ns = found.published_ns
        if not self._same_computer:
            self._published_ns = self._by_arrival(found.published_ns, empty_ns, now_ns)
        return True

    def at(self, now_ns: int) -> Verdict:
        """Return the verdict that holds at `now_ns` (own clock)."""
        message = self._message
        if message is None:
            return Verdict(Decision.UNKNOWN, (self._why,))
        age_ns = 0 if self._published_ns is None else now_ns - self._published_ns
        reading_age_ns = age_ns + message.published_ns - message.read_ns
        said = replace(message.verdict, age_ms=reading_age_ns / 1e6)
        if self._published_ns is None:
            return _unfelt(said).unknown("joining")
        if age_ns < -CLOCK_SLACK_NS or self._may_have_crept():
            return _unfelt(said).unknown("clock")
        if age_ns > message.silence_ns:
            return _unfelt(said).unknown("silent")
        if reading_age_ns > self._max_age_ns:
            said = _unfelt(said)
            counts_on_it = said.decision != Decision.UNKNOWN or said.supervised
            return said.unknown("stale") if counts_on_it else said
        return self.if_open(said)

    def end(self, grasp: tuple[str, int]) -> None:
        """Note that the outcome of a grasp was reported, so it must not be lifted again."""
        self._ended.pop(grasp, None)
        self._ended[grasp] = None
        if len(self._ended) > LIFTS_MAX:
            del self._ended[next(iter(self._ended))]

    def if_open(self, said: Verdict) -> Verdict:
        """Return the verdict, as unknown if the outcome of its grasp was reported."""
        is_offered = said.decision != Decision.UNKNOWN or said.supervised
        ended = is_offered and _key(said) in self._ended
        return said.unknown("outcome-told") if ended else said

    def read(self, payload: bytes) -> _Message | str:
        """Parse a message or an answer; count one not understood, and return why: `malformed` or
        `version`."""
        try:
            told = _parsed(payload)
            if _number(told, "v") == VERSION:
                return self._if_sure(_message(told))
            why = "version"
        except (ValueError, KeyError, RecursionError):
            why = "malformed"
        self.counts.malformed += 1
        return why

    def _if_sure(self, found: _Message) -> _Message:
        """Return the message, as unknown if it is `stable` with a `p_slip` that is too high."""
        said = found.verdict
        slips = said.p_slip is not None and said.p_slip >= self._max_p_slip
        if said.decision == Decision.STABLE and slips:
            return found._replace(verdict=said.unknown("p-slip"))
        return found

    def _is_new(self, found: _Message) -> bool:
        boot_id, seq = found.verdict.boot_id or "", found.verdict.seq or 0
        if boot_id != self._boot_id:
            if boot_id in self._former or self._is_older(found):
                self.counts.former += 1
                return False
            if self._boot_id is not None:
                self._former.append(self._boot_id)
                self.counts.restarts += 1
                self._best = self._bound = None
            self._boot_id, self._seq = boot_id, seq
            return True
        if seq <= self._seq:
            self.counts.repeats += 1
            return False
        self.counts.lost += seq - self._seq - 1
        self._seq = seq
        return True

    def _is_older(self, found: _Message) -> bool:
        """Return True if a message of another start was sent before the known one; always False if
        the daemon has another clock."""
        known_ns = self._published_ns if self._same_computer else None
        return known_ns is not None and found.published_ns < known_ns

    def _by_arrival(self, published_ns: int, empty_ns: int, now_ns: int) -> int | None:
        """Return when a message was sent (own clock): after a clock comparison the earliest time
        possible, else as if the fastest message took no time. None for the first one, which may
        have been kept for late subscribers. `empty_ns`: as in `take`."""
        difference_ns = now_ns - published_ns
        if self._bound is not None:  # the bound holds however long it waited here
            return min(published_ns + self._at_least(self._bound, now_ns), now_ns)
        if self._best is None:
            self._best, self._least_ns = (difference_ns, now_ns), difference_ns
            return None
        best_ns, at_ns = self._best
        late_ns = difference_ns - best_ns - round((now_ns - at_ns) * DRIFT)
        if late_ns <= 0:
            self._best = difference_ns, now_ns
            self._least_ns = min(self._least_ns, difference_ns)
        return min(empty_ns, now_ns - max(late_ns, 0))

    def _may_have_crept(self) -> bool:
        """Return True if clocks seem to drift by over `DRIFT_MAX_NS`: the delay may have grown."""
        if self._bound is not None or self._best is None:
            return False
        return self._best[0] - self._least_ns > DRIFT_MAX_NS


class _Question:
    """`may_i_lift`: asks one question at a time until the newest message confirms an answer that
    permits a lift."""

    def __init__(
        self, newest: Newest, asking: _Call | None, supervised: bool, still_ms: float | None
    ) -> None:
        self._newest, self._asking, self._supervised = newest, asking, supervised
        self._still_ms = still_ms
        self._asked = self._heard = self._may_be_announced = False
        self._asked_of: str | None = None
        """Start of the daemon that was asked last; None: nothing was asked."""
        self._answer: Verdict | None = None
        """Answer that the newest message must confirm; None: no answer yet."""
        self._refusal: Verdict | None = None
        """Last answer, if it permits no lift."""

    def permits(self, said: Verdict) -> bool:
        """Return True if a verdict lets the hand lift."""
        return bool(said) or (self._supervised and said.supervised)

    def is_over(self, said: Verdict) -> bool:
        """Return True for `slip` or a verdict that permits a lift: waiting can end."""
        return said.decision == Decision.SLIP or self.permits(said)

    def decided(self, newest: Verdict) -> Verdict:
        """Return the newest verdict if it confirms the answer, else an unknown; ask if needed.

        An answered `slip` is returned at once. Without an ask endpoint `newest` decides alone. A
        restart of the daemon loses questions and voids answers, so another start is asked again;
        nothing is asked before its first message.
        """
        newest = self._if_still(newest)
        if self._asking is None:
            return newest
        payload = self._asking.answer() if self._asked else None
        if payload is not None:
            self._asked, self._heard = False, True
            answer = self._newest.read(payload)
            self._may_be_announced = isinstance(answer, str) or _was_stable(answer.verdict)
            said = Verdict(Decision.UNKNOWN)
            if not isinstance(answer, str):
                said = self._if_still(self._newest.if_open(answer.verdict))
            if said.decision == Decision.SLIP and not self.permits(said):
                return said
            self._answer, self._refusal = (said, None) if self.permits(said) else (None, said)
        if self._answer is not None and _reaches(newest, self._answer):
            same = (newest.grasp, newest.supervised) == (
                self._answer.grasp,
                self._answer.supervised,
            )
            if same and self.permits(newest):
                return replace(newest, owner=self._answer.owner)
            self._answer = None
        if newest.boot_id not in (None, self._asked_of):
            self._asked, self._answer = False, None
            self._may_be_announced = self._asked_of is not None
        if not self._asked and self._answer is None and newest.boot_id is not None:
            if self._may_be_announced:
                self._asking.hang_up(lifts=False)
            self._asked, self._may_be_announced = self._asking.ask(b"lift"), False
            self._asked_of = newest.boot_id
        if newest.decision == Decision.UNKNOWN and not self.permits(newest):
            return newest
        return self._refused(newest)

    def at_the_end(self, said: Verdict) -> Verdict:
        """Return the verdict, with the reason `no-answer` too if it decides nothing and the daemon
        answered no question."""
        if self._asking is None or self._heard or said.seq is None or self.is_over(said):
            return said
        return replace(said, reasons=tuple(dict.fromkeys([*said.reasons, "no-answer"])))

    def _refused(self, newest: Verdict) -> Verdict:
        """Return the newest verdict as unknown, with the reasons and the owner of the answer that
        refused its grasp; without such an answer for its own reasons, or else `no-answer`."""
        refusal = self._refusal
        if refusal is None or _key(refusal) != _key(newest):
            return newest.unknown(*(newest.reasons or ("no-answer",)))
        reasons = refusal.reasons or newest.reasons or ("no-answer",)
        return replace(newest.unknown(*reasons), owner=refusal.owner)

    def _if_still(self, said: Verdict) -> Verdict:
        """Return the verdict, as unknown if it permits a lift but the hand was not still long
        enough. A lift under supervision must not be early; any lift needs `still_ms` of
        stillness."""
        if not self.permits(said):
            return said
        least_ms, is_early = self._still_ms, said.supervised and said.early
        still = least_ms is None or (said.still_ms is not None and said.still_ms >= least_ms)
        return said if still and not is_early else said.unknown("not-still")


def _was_stable(said: Verdict) -> bool:
    """Return True if the daemon said `stable`, even if the client refused its `p_slip`."""
    return said.decision == Decision.STABLE or said.reasons == ("p-slip",)


def _reaches(newest: Verdict, answer: Verdict) -> bool:
    """Return True if the newest message is at least as new as the answer, and the daemon did not
    restart between them."""
    return newest.boot_id == answer.boot_id and (newest.seq or 0) >= (answer.seq or 0)


class _Link:
    """The sockets of a client."""

    def __init__(self, endpoint: str, topic: bytes, ask: str | None, keys: Keys | None) -> None:
        self._endpoint, self._topic, self._keys = endpoint, topic, keys
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._name, self._calls = b"g" + os.urandom(NAME_BYTES - 1), 0
        self._leaving: deque[zmq.Socket[bytes]] = deque()
        self.asking, self.telling, self.timing = (_Call(self, ask or "") for _ in range(3))
        try:
            self._socket = self.connected(zmq.SUB, endpoint)
            if ask is not None:  # at once, to refuse a wrong endpoint
                self.asking.socket = self.connected(zmq.DEALER, ask)
        except BaseException:
            self._context.destroy(0)
            raise

    def receive(self) -> list[bytes] | None:
        """Return the next message; None: none waits."""
        try:
            return self._socket.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return None

    @property
    def sockets(self) -> list[zmq.Socket[bytes]]:
        """Return the sockets on which a message or an answer may arrive."""
        sockets = (self._socket, self.asking.socket, self.telling.socket, self.timing.socket)
        return [each for each in sockets if each is not None]

    def wait(self, timeout_ms: int) -> None:
        """Wait until a message or an answer waits, up to `timeout_ms`."""
        zmq.zmq_poll([(each, zmq.POLLIN) for each in self.sockets], timeout_ms)

    def renew(self) -> None:
        """Reconnect the subscriber, and drop its waiting messages."""
        self._socket.close(0)
        self._socket = self.connected(zmq.SUB, self._endpoint)

    def leave(self, socket: zmq.Socket[bytes]) -> None:
        """Keep a socket open, so that its last message is sent. Beyond `LEAVING_MAX` close the
        oldest, even if its message was not."""
        self._leaving.append(socket)
        if len(self._leaving) > LEAVING_MAX:
            self._leaving.popleft().close(0)

    def close(self) -> None:
        while self._leaving:
            self._leaving.popleft().close()
        self._context.destroy(0)

    def connected(self, kind: int, endpoint: str) -> zmq.Socket[bytes]:
        made = self._context.socket(kind)
        made.linger = 0
        made.rcvhwm = QUEUE_MAX
        made.maxmsgsize = MESSAGE_MAX_BYTES
        if self._keys is not None:
            made.curve_serverkey, made.curve_publickey, made.curve_secretkey = self._keys
        if endpoint.startswith("tcp://"):
            made.ipv6 = "[" in endpoint
            made.heartbeat_ivl, made.heartbeat_timeout = HEARTBEAT_MS, HEARTBEAT_TIMEOUT_MS
        if kind == zmq.SUB:
            made.subscribe(self._topic)
        else:  # the name identifies the client, the number after it the connection
            self._calls += 1
            made.routing_id = self._name + self._calls.to_bytes(8, "big")
        made.connect(endpoint)
        return made


def _close_in(process: int, link: _Link) -> None:
    """Close the sockets of a dropped client; do nothing unless this is the process of that id."""
    if os.getpid() == process:
        link.close()


class _Call:
    """Requests of one kind to the daemon, one at a time, on a socket of their own."""

    def __init__(self, link: _Link, endpoint: str) -> None:
        self._link, self._endpoint = link, endpoint
        self.socket: zmq.Socket[bytes] | None = None

    def ask(self, question: bytes) -> bool:
        """Send a question; False: it is lost, as the peer has turned this client away."""
        if self.socket is None:
            self.socket = self._link.connected(zmq.DEALER, self._endpoint)
        try:
            self.socket.send(question, zmq.NOBLOCK)
        except zmq.Again:  # a refused handshake ends the connection, and libzmq makes no other
            self.hang_up()
            return False
        return True

    def answer(self) -> bytes | None:
        """Return the answer; None if none has come yet, b"" if it is not a single frame."""
        try:
            frames = [] if self.socket is None else self.socket.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return None
        return None if self.socket is None else frames[0] if len(frames) == 1 else b""

    def hang_up(self, *, lifts: bool = True) -> None:
        """Close the socket, so that a late answer is not mistaken for one to the next question.

        `lifts`: False tells the daemon that no lift follows, so it awaits no outcome.
        """
        leaving, self.socket = self.socket, None
        if leaving is None:
            return
        if lifts:
            leaving.close(0)
        else:
            leaving.linger = TAKE_BACK_MS
            with suppress(zmq.Again):  # turned away: no question has arrived either
                leaving.send(b"not-lifting", zmq.NOBLOCK)
            self._link.leave(leaving)


def is_same_computer(endpoint: str) -> bool:
    """Return True for an `ipc://` or loopback endpoint, which only a tunnel makes another
    computer's."""
    return endpoint.startswith(("ipc://", "tcp://127.", "tcp://[::1]", "tcp://localhost:"))


def _due_ns(name: str, seconds: float) -> int:
    """Return the monotonic time when a wait of `seconds` ends, ns. Raises `ValueError` for an
    invalid wait, which names the argument `name`."""
    if not _is_amount(seconds, WAIT_MAX_S):
        raise ValueError(f"{name} must be 0 or more and finite, not {seconds!r}")
    return time.monotonic_ns() + round(seconds * 1e9)


def _is_amount(value: object, most: float = REAL_MAX) -> bool:
    """Return True if `value` is a number from 0 to `most`."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return False
    return not value < 0 and bool(value <= most)


def _slept_ns() -> int:
    """Return how long the computer has slept, plus a constant, ns: the difference of two clocks."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns()


def _parsed(payload: bytes) -> dict[str, Any]:
    """Return the JSON object in a payload. Raises `ValueError` or `RecursionError` for any other,
    too long or deep, or with repeated keys."""
    openings = payload.count(b"[") + payload.count(b"{")
    if len(payload) > MESSAGE_MAX_BYTES or openings > OPENINGS_MAX:
        raise ValueError
    told = json.loads(payload.decode(), object_pairs_hook=_once)
    # Refuses other text than JSON, numbers that JSON lacks, and other bytes than UTF-8.
    json.dumps(told, allow_nan=False, ensure_ascii=False).encode()
    if not isinstance(told, dict):
        raise ValueError
    return told


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the pairs as an object. Raises `ValueError` for a repeated key: readers disagree."""
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError
    return found


def _message(told: dict[str, Any]) -> _Message:
    reasons, supervised = told["reasons"], told.get("supervised", False)
    decision = Decision(told["verdict"])
    known = decision != Decision.UNKNOWN
    fits = (
        _number(told, "verdict_code") == list(Decision).index(decision)
        and told["valid"] is known
        and (told["p_slip"] is not None) is known
        and (known or told.get("p_slip_model") is None)
        and isinstance(reasons, list)
        and all(isinstance(reason, str) for reason in reasons)
        and bool(reasons) is not known
        and isinstance(told["boot_id"], str)
        and isinstance(supervised, bool)
    )
    if not fits:
        raise ValueError
    told = {"p_slip_model": None, "outcomes": 0, "risk": None, **told}  # older daemons lack these
    read_ns, seq, grasp, outcomes = _numbers(told, "t_mono_ns", "seq", "grasp", "outcomes")
    age_ms, silence_ms = _real(told, "age_ms"), _real(told, "silence_ms")
    p_slip, p_model = (_maybe(told, name, 1) for name in ("p_slip", "p_slip_model"))
    said = Verdict(decision, tuple(reasons), p_slip, grasp, seq, told["boot_id"])
    supervised = supervised and _WITHHELD.issuperset(reasons)
    said = replace(said, p_slip_model=p_model, outcomes=outcomes, supervised=supervised)
    said = replace(said, risk=None if told["risk"] is None else _risk(told["risk"]))
    said = _with_stillness(said, told)
    return _Message(said, read_ns, read_ns + round(age_ms * 1e6), round(silence_ms * 1e6))


def _with_stillness(said: Verdict, told: dict[str, Any]) -> Verdict:
    """Return the verdict with the message's fields from `early` on, which older daemons lack."""
    told = {"early": False, "still_ms": None, "motion": None, "motion_limits": None, **told}
    told = {"fingers": None, "owner": None, **told}
    if not isinstance(told["early"], bool) or not isinstance(told["owner"], (str, type(None))):
        raise ValueError
    return replace(
        said,
        early=told["early"],
        still_ms=_maybe(told, "still_ms"),
        motion=_by_finger(told["motion"], _maybe),
        motion_limits=_by_finger(told["motion_limits"], _real),
        fingers=_by_finger(told["fingers"], _finger_state),
        owner=told["owner"],
    )


def _by_finger(told: Any, read: Callable[[dict[str, Any], str], Any]) -> Any:  # noqa: ANN401
    """Return `told`, an object by finger, with values as `read(told, finger)`; None for null."""
    if told is None:
        return None
    if not isinstance(told, dict):
        raise ValueError
    return {finger: read(told, finger) for finger in told}


def _finger_state(told: dict[str, Any], finger: str) -> FingerState | None:
    return None if told[finger] is None else FingerState(told[finger])


def _feeling(said: Verdict, state: FingerState) -> tuple[str, ...]:
    """Return the fingers in this state."""
    return tuple(finger for finger, felt in (said.fingers or {}).items() if felt == state)


def _unfelt(said: Verdict) -> Verdict:
    """Return the verdict with the state of all fingers unknown."""
    return replace(said, fingers=None if said.fingers is None else dict.fromkeys(said.fingers))


def _risk(told: Any) -> Risk:  # noqa: ANN401
    if not isinstance(told, dict):
        raise ValueError
    told = {"announced": 0, "awaited": 0, **told}  # older daemons lack these
    lifts, slips, out, left = _numbers(told, "lifts", "slips", "outstanding", "warm_up_left")
    announced, awaited = _numbers(told, "announced", "awaited")
    if slips > lifts:
        raise ValueError
    target, bound = _maybe(told, "target", 1), _maybe(told, "bound")
    return Risk(target, lifts, slips, out, bound, left, announced, awaited)


def _telling(lifted_on: Verdict, how: Outcome, object_name: str | None) -> bytes:
    """Return the message that reports an outcome. Raises `ValueError` without a grasp, or for a
    wrong name."""
    boot_id, grasp = _key(lifted_on)
    if not boot_id or not grasp:
        raise ValueError("nothing was lifted on a verdict that is of no grasp")
    words = ["outcome", boot_id, str(grasp), how.value]
    if object_name is not None:
        if _OBJECT.fullmatch(object_name) is None:
            raise ValueError(f"{object_name!r}: no name of an object: {_OBJECT_IS}")
        words.append(object_name)
    return " ".join(words).encode()


def _key(lifted_on: Verdict) -> tuple[str, int]:
    """Return `boot_id` and number of the verdict's grasp; "" or 0 in place of None."""
    return lifted_on.boot_id or "", lifted_on.grasp or 0


def _taken(payload: bytes) -> OutcomeAnswer:
    """Return the answer to an outcome, with `malformed` or `version` if it is not understood."""
    try:
        told = _parsed(payload)
        if _number(told, "v") != VERSION:
            return OutcomeAnswer("version")
        said, why = told["ok"], "" if told["ok"] is True else told["why"]
    except (ValueError, KeyError, RecursionError):
        return OutcomeAnswer("malformed")
    fits = isinstance(said, bool) and isinstance(why, str) and bool(why) is not said
    return OutcomeAnswer(why if fits else "malformed")


def _told_clock(payload: bytes) -> int | None:
    """Return the daemon's clock, ns; None if the answer is not understood."""
    try:
        told = _parsed(payload)
        return _number(told, "t_mono_ns") if _number(told, "v") == VERSION else None
    except (ValueError, KeyError, RecursionError):
        return None


def _numbers(told: dict[str, Any], *names: str) -> list[int]:
    return [_number(told, name) for name in names]


def _real(told: dict[str, Any], name: str, most: float = REAL_MAX) -> float:
    return float(_number(told, name, most, (int, float)))


def _maybe(told: dict[str, Any], name: str, most: float = REAL_MAX) -> float | None:
    return None if told[name] is None else _real(told, name, most)


def _number(
    told: dict[str, Any], name: str, most: float = INTEGER_MAX, kinds: tuple[type, ...] = (int,)
) -> Any:  # noqa: ANN401
    """Return the field `name`. Raises `ValueError` if it is not of `kinds` and from 0 to `most`."""
    value = told[name]
    if type(value) not in kinds or not 0 <= value <= most:
        raise ValueError
    return value
