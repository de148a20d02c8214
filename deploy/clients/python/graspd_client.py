"""May the hand lift? The newest verdict of a graspd daemon, and `unknown` where there is none.

One file to copy: it needs Linux, Python 3.9 or newer and pyzmq, and nothing of graspd itself. The
messages are those of deploy/wire/README.md, version 1.

    with Graspd("ipc:///run/graspd/right.ipc") as graspd:
        if graspd.may_i_lift(0.5):
            lift()

Nothing here runs by itself but ZeroMQ's own thread, and an object belongs to the thread that made
it. Only `verdict(wait_s)`, `may_i_lift(deadline_s)` and `outcome(..., wait_s)` wait, and no longer
than they are told.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import zmq
from zmq.auth import load_certificate

VERSION = 1  # of the messages; what has another is not understood
STABLE, SLIP, UNKNOWN = "stable", "slip", "unknown"
CODES = {UNKNOWN: 0, STABLE: 1, SLIP: 2}
INTEGER_MAX = 2**60  # of a message: as a time, 36 years in ns
MILLISECONDS_MAX = 1e12  # of a message: thirty years
# A verdict has 0.6 kB, at most 3; a peer that sends more is no daemon and is disconnected.
MESSAGE_MAX_BYTES = 1 << 16
QUEUE_MAX = 1000  # messages that wait to be read: ten seconds at 100 Hz
# Whoever has read nothing for longer connects anew: what waits is old, and what is new is lost.
READ_WITHIN_NS = 5_000_000_000
# Whoever hears nothing for so long connects anew, at first and at most: who was turned away once
# is not tried again by libzmq, and may be let in by now.
QUIET_NS, QUIET_MAX_NS = 1_000_000_000, 10_000_000_000
# The computer has slept if its clocks have moved apart by more. A sleep takes seconds, the
# scheduler a moment between two looks at the clocks.
SLEPT_NS = 50_000_000
# Longest wait in one piece: so well is it known when a message came from another computer.
SLICE_MS = 10
# What a message may come from the future by before the clocks are taken for different ones.
CLOCK_SLACK_NS = 1_000_000
# By which two computers' clocks may run apart: NTP slews by 5e-4, a bad crystal is off by 1e-4.
DRIFT = 1e-3
FORMER_MAX = 16  # starts of the daemon that are remembered as over
# On TCP: between two signs of life, and when a daemon that gives none is connected to anew.
HEARTBEAT_MS, HEARTBEAT_TIMEOUT_MS = 1000, 3000
# Name of an object: printable ASCII but blank, quotes and comma.
OBJECT = re.compile(r"[!#-&(-+\--~]{1,64}")


@dataclass(frozen=True)
class Verdict:
    """What is known of the grasp. True in an `if` exactly when it is stable.

    `verdict` is `stable`, `slip` or `unknown`. `reasons` say why it is unknown: the daemon's, or
    one of those in deploy/clients/README.md. `p_slip` is the probability of slip, None when
    unknown, `grasp` the number of the contact episode, `age_ms` the time since the reading's last
    byte, ms, at least. What is not known before the first message is None.
    """

    verdict: str
    reasons: tuple[str, ...] = ()
    p_slip: float | None = None
    grasp: int | None = None
    seq: int | None = None
    boot_id: str | None = None
    age_ms: float | None = None

    def __bool__(self) -> bool:
        return self.verdict == STABLE

    def unknown(self, *reasons: str) -> Verdict:
        """The same, but unknown."""
        return replace(self, verdict=UNKNOWN, reasons=reasons, p_slip=None)


@dataclass(frozen=True)
class LiftAnswer:
    """Whether to lift. True in an `if` exactly when the hand may."""

    verdict: Verdict
    """What it was decided by; besides its usual reasons `no-answer` and `late`."""
    waited_s: float

    def __bool__(self) -> bool:
        return bool(self.verdict)


@dataclass(frozen=True)
class OutcomeAnswer:
    """Whether graspd has taken how a lift ended. True in an `if` exactly when it has."""

    why: str = ""
    """Why not: the daemon's words, or `no-answer`, `malformed`, `version` or `closed`."""

    def __bool__(self) -> bool:
        return not self.why


@dataclass
class Counts:
    """What came since the start."""

    messages: int = 0  # new ones of this hand
    lost: int = 0  # gaps in `seq`, in messages
    repeats: int = 0  # messages that were known already
    malformed: int = 0  # messages that are not understood, answers too
    restarts: int = 0  # times that the daemon was started anew
    former: int = 0  # messages of a start that is over


class Keys(NamedTuple):
    """CURVE keys, Z85: the daemon's public one, and one's own two."""

    server: bytes
    public: bytes
    secret: bytes

    @classmethod
    def load(cls, server: Path, own: Path) -> Keys:
        """From the daemon's `.key` and one's own `.key_secret` file (`graspd keys`).

        Raises `OSError` or `ValueError`.
        """
        public, secret = load_certificate(own)
        if secret is None:
            raise ValueError(f"{own} has no secret key")
        return cls(load_certificate(server)[0], public, secret)


class Graspd:
    """Subscribes to the verdicts of one hand. Use it in one thread, and close it."""

    def __init__(
        self,
        endpoint: str,
        hand: str = "right",
        max_age_ms: float = 100.0,
        *,
        ask_endpoint: str | None = None,
        same_computer: bool | None = None,
        keys: Keys | None = None,
    ) -> None:
        """`max_age_ms` is how old a reading may be that a lift relies on, ms.

        With `ask_endpoint` (`[ask]`), `may_i_lift` asks for a judgement as well, and `outcome` has
        somebody to tell. `same_computer`
        says whether the daemon's monotonic clock is one's own; unless given, it is with `ipc://`
        and on loopback addresses: say False through a tunnel. Raises `zmq.ZMQError` for an endpoint
        that is none, and `ValueError` for an age that is none.
        """
        if not 0.0 < max_age_ms < math.inf:
            raise ValueError(f"max_age_ms must be above 0 and finite, not {max_age_ms}")
        if same_computer is None:
            same_computer = is_same_computer(endpoint)
        topic = f"verdict.{hand}".encode()
        self._newest = Newest(topic, round(max_age_ms * 1e6), same_computer)
        self._asks = ask_endpoint is not None
        self._closed = self._behind = False
        self._link = _Link(endpoint, topic, ask_endpoint, keys)
        self._read_ns = self._empty_ns = self._heard_ns = time.monotonic_ns()
        self._quiet_ns, self._slept_ns = QUIET_NS, _slept_ns()

    @property
    def counts(self) -> Counts:
        """What came so far."""
        return self._newest.counts

    def verdict(self, wait_s: float = 0.0) -> Verdict:
        """The newest verdict; waits at most `wait_s` seconds for a new message."""
        if self._closed:
            return Verdict(UNKNOWN, ("closed",))
        due_ns = time.monotonic_ns() + round(wait_s * 1e9)
        while not self._drain() and self._wait(due_ns):
            pass
        if self._behind:
            return Verdict(UNKNOWN, ("behind",))
        return self._newest.at(time.monotonic_ns())

    def may_i_lift(self, deadline_s: float) -> LiftAnswer:
        """Whether the current grasp is stable, known within `deadline_s` seconds from now.

        Waits for a fresh `stable`, or `slip`. With an ask endpoint the daemon is asked, and the
        answer and the newest message of the same grasp must both say so; an unknown answer is asked
        for again. Whatever else happens until the deadline is a no.
        """
        if not 0.0 <= deadline_s < math.inf:
            raise ValueError(f"the deadline must be 0 s or more and finite, not {deadline_s}")
        began_ns = time.monotonic_ns()
        due_ns = began_ns + round(deadline_s * 1e9)
        question = _Question(self._newest, self._link, self._asks and not self._closed)
        try:
            decided = question.decided(self.verdict())
            while decided.verdict == UNKNOWN and not self._closed and self._wait(due_ns):
                decided = question.decided(self.verdict())
                if time.monotonic_ns() > due_ns and decided:
                    decided = decided.unknown("late")
        finally:
            self._link.hang_up()
        return LiftAnswer(decided, (time.monotonic_ns() - began_ns) / 1e9)

    def outcome(
        self,
        lifted_on: Verdict,
        slipped: bool,
        object_name: str | None = None,
        wait_s: float = 0.5,
    ) -> OutcomeAnswer:
        """Tell how the lift ended that was made on a verdict, and what was lifted.

        Waits at most `wait_s` seconds for the answer; without one tell it again, the later counts.
        Raises `ValueError` without an ask endpoint, for a verdict that is of no grasp, and for a
        name that is no 1 to 64 printable ASCII characters without blank, quotes and comma.
        """
        telling = _telling(lifted_on, slipped, object_name)
        if not self._asks:
            raise ValueError("an outcome needs an ask_endpoint")
        if self._closed:
            return OutcomeAnswer("closed")
        due_ns = time.monotonic_ns() + round(wait_s * 1e9)
        try:
            self._link.ask(telling)
            payload = self._link.answer()
            while payload is None and self._wait(due_ns):
                self._drain()
                payload = self._link.answer()
        finally:
            self._link.hang_up()
        if payload is None:
            return OutcomeAnswer("no-answer")
        taken = _taken(payload)
        self.counts.malformed += taken is None
        return OutcomeAnswer("malformed") if taken is None else taken

    def close(self) -> None:
        """Close the sockets. May be called again; every verdict is unknown from then on."""
        if not self._closed:
            self._closed = True
            self._link.close()

    def __enter__(self) -> Graspd:
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()

    def _drain(self) -> bool:
        """Read all that waits, without waiting; whether there was anything new."""
        self._forget_what_is_old()
        new, heard_ns, self._behind = False, self._heard_ns, True
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
        """What came or waits since before a sleep of the computer, or a long time without a look.

        While the computer sleeps the monotonic clock stands still: all would look fresh.
        """
        slept_ns = _slept_ns()
        slept = slept_ns - self._slept_ns > SLEPT_NS
        self._slept_ns = max(self._slept_ns, slept_ns)
        if slept:
            self._newest.forget("slept")
        if slept or time.monotonic_ns() - self._read_ns > READ_WITHIN_NS:
            self._connect_anew()

    def _connect_anew(self) -> None:
        self._link.renew()
        self._empty_ns = self._heard_ns = time.monotonic_ns()

    def _wait(self, due_ns: int) -> bool:
        """Wait for a message, but not for long; False when it is time to end."""
        left_ns = due_ns - time.monotonic_ns()
        if left_ns <= 0:
            return False
        self._link.wait(min(left_ns // 1_000_000, SLICE_MS))
        return True


class _Message(NamedTuple):
    """What matters of a verdict message."""

    verdict: Verdict  # without its age
    read_ns: int  # by the daemon's monotonic clock: when the reading's last byte came ...
    published_ns: int  # ... and when the message went out
    silence_ns: int


class Newest:
    """What the newest message says; no socket and no clock of its own."""

    def __init__(self, topic: bytes, max_age_ns: int, same_computer: bool) -> None:
        """`topic` is the hand's; other messages are passed over."""
        self.counts = Counts()
        self._topic, self._max_age_ns, self._same_computer = topic, max_age_ns, same_computer
        self._message: _Message | None = None
        self._published_ns: int | None = None
        """Of the message, by one's own clock: not later than then; None while that is not known."""
        self._why = "no-message"
        """Why there is no message."""
        self._boot_id: str | None = None
        self._seq = -1
        self._former: deque[str] = deque(maxlen=FORMER_MAX)
        self._best: tuple[int, int] | None = None
        """The fastest way of a message so far, as the difference of the clocks, and when, ns."""

    @property
    def silence_ns(self) -> int:
        """For how long no message may come; 0 without one."""
        return 0 if self._message is None else self._message.silence_ns

    def forget(self, why: str) -> None:
        """What came is not known any more, nor how the clocks differ; repeats stay repeats."""
        self._message, self._why, self._best = None, why, None

    def take(self, frames: Sequence[bytes], empty_ns: int, now_ns: int) -> bool:
        """Take in a message, which came after `empty_ns` and not after `now_ns` (own clock).

        Whether it is a new one. A repeated one is not; one that is not understood is.
        """
        if not frames or frames[0] != self._topic:
            return False
        found = self.read(frames[1] if len(frames) == 2 else b"")
        if isinstance(found, str):
            self._message, self._why = None, found
            return True
        if not self._is_new(found.verdict):
            return False
        self.counts.messages += 1
        self._message = found
        self._published_ns = found.published_ns
        if not self._same_computer:
            self._published_ns = self._by_arrival(found.published_ns, empty_ns, now_ns)
        return True

    def at(self, now_ns: int) -> Verdict:
        """What is known at a time (own clock)."""
        message = self._message
        if message is None:
            return Verdict(UNKNOWN, (self._why,))
        age_ns = 0 if self._published_ns is None else now_ns - self._published_ns
        reading_age_ns = age_ns + message.published_ns - message.read_ns
        said = replace(message.verdict, age_ms=reading_age_ns / 1e6)
        if self._published_ns is None:
            return said.unknown("joining")
        if age_ns < -CLOCK_SLACK_NS:
            return said.unknown("clock")
        if age_ns > message.silence_ns:
            return said.unknown("silent")
        if said.verdict != UNKNOWN and reading_age_ns > self._max_age_ns:
            return said.unknown("stale")
        return said

    def read(self, payload: bytes) -> _Message | str:
        """A message or an answer; `malformed` or `version` for what is not understood, counted."""
        found = _read(payload)
        self.counts.malformed += isinstance(found, str)
        return found

    def _is_new(self, said: Verdict) -> bool:
        boot_id, seq = said.boot_id or "", said.seq or 0
        if boot_id != self._boot_id:
            if boot_id in self._former:
                self.counts.former += 1
                return False
            if self._boot_id is not None:
                self._former.append(self._boot_id)
                self.counts.restarts += 1
            self._boot_id, self._seq, self._best = boot_id, seq, None
            return True
        if seq <= self._seq:
            self.counts.repeats += 1
            return False
        self.counts.lost += seq - self._seq - 1
        self._seq = seq
        return True

    def _by_arrival(self, published_ns: int, empty_ns: int, now_ns: int) -> int | None:
        """When a message went out, by one's own clock: what it took longer than the fastest is age.

        None for the first: it may have been kept for those who come late.
        """
        difference_ns = now_ns - published_ns
        if self._best is None:
            self._best = difference_ns, now_ns
            return None
        best_ns, at_ns = self._best
        late_ns = difference_ns - best_ns - round((now_ns - at_ns) * DRIFT)
        if late_ns <= 0:
            self._best = difference_ns, now_ns
        return min(empty_ns, now_ns - max(late_ns, 0))


class _Question:
    """One question at a time, until the newest message confirms a stable answer."""

    def __init__(self, newest: Newest, link: _Link, asks: bool) -> None:
        self._newest, self._link, self._asks = newest, link, asks
        self._asked = False
        self._stable: Verdict | None = None
        """The answer that is to be confirmed."""

    def decided(self, newest: Verdict) -> Verdict:
        """The newest message, if it confirms the answer; unknown otherwise. Asks if need be."""
        if not self._asks:
            return newest
        payload = self._link.answer() if self._asked else None
        if payload is not None:
            self._asked = False
            answer = self._newest.read(payload)
            said = Verdict(UNKNOWN) if isinstance(answer, str) else answer.verdict
            if said.verdict == SLIP:
                return said
            self._stable = said if said else None
        if self._stable is not None and _reaches(newest, self._stable):
            if newest and newest.grasp == self._stable.grasp:
                return newest
            self._stable = None
        if not self._asked and self._stable is None:
            self._link.ask()
            self._asked = True
        return newest.unknown(*(newest.reasons or ("no-answer",)))


def _reaches(newest: Verdict, answer: Verdict) -> bool:
    """Whether the message that is the answer is no longer to come."""
    return newest.boot_id == answer.boot_id and (newest.seq or 0) >= (answer.seq or 0)


class _Link:
    """The sockets."""

    def __init__(self, endpoint: str, topic: bytes, ask: str | None, keys: Keys | None) -> None:
        self._endpoint, self._topic, self._ask, self._keys = endpoint, topic, ask, keys
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._asking: zmq.Socket[bytes] | None = None
        try:
            self._socket = self._connected(zmq.SUB, endpoint)
        except BaseException:
            self._context.destroy(0)
            raise

    def receive(self) -> list[bytes] | None:
        """The next message, if one waits."""
        try:
            return self._socket.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return None

    def wait(self, timeout_ms: int) -> None:
        """Until a message or an answer waits, so long at most."""
        wanted = [each for each in (self._socket, self._asking) if each is not None]
        zmq.zmq_poll([(each, zmq.POLLIN) for each in wanted], timeout_ms)

    def renew(self) -> None:
        """Connect anew, and forget what waits."""
        self._socket.close(0)
        self._socket = self._connected(zmq.SUB, self._endpoint)

    def ask(self, question: bytes = b"judge") -> None:
        if self._ask is not None:
            if self._asking is None:
                self._asking = self._connected(zmq.DEALER, self._ask)
            self._asking.send(question, zmq.NOBLOCK)

    def answer(self) -> bytes | None:
        """The answer, if it is there; empty if it is none."""
        try:
            frames = [] if self._asking is None else self._asking.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return None
        return frames[0] if len(frames) == 1 else b""

    def hang_up(self) -> None:
        """An answer that is late must not be taken for one to the next question."""
        if self._asking is not None:
            self._asking.close(0)
            self._asking = None

    def close(self) -> None:
        self._context.destroy(0)

    def _connected(self, kind: int, endpoint: str) -> zmq.Socket[bytes]:
        made = self._context.socket(kind)
        made.linger = 0
        made.rcvhwm = QUEUE_MAX
        made.maxmsgsize = MESSAGE_MAX_BYTES
        if self._keys is not None:
            made.curve_serverkey, made.curve_publickey, made.curve_secretkey = self._keys
        if endpoint.startswith("tcp://"):
            made.heartbeat_ivl, made.heartbeat_timeout = HEARTBEAT_MS, HEARTBEAT_TIMEOUT_MS
        if kind == zmq.SUB:
            made.subscribe(self._topic)
        made.connect(endpoint)
        return made


def is_same_computer(endpoint: str) -> bool:
    """Whether an endpoint can only be of this computer."""
    return endpoint.startswith(("ipc://", "tcp://127.", "tcp://[::1]", "tcp://localhost:"))


def _slept_ns() -> int:
    """How long the computer has slept, and something constant: only the first clock counts that."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns()


def _read(payload: bytes) -> _Message | str:
    """A verdict message; `malformed` or `version` for what is not understood or contradicts."""
    try:
        told = _parsed(payload)
        return _message(told) if _number(told, "v") == VERSION else "version"
    except (ValueError, KeyError, RecursionError):
        return "malformed"


def _parsed(payload: bytes) -> dict[str, Any]:
    """A JSON object. Raises `ValueError` or `RecursionError`."""
    told = json.loads(payload.decode())
    json.dumps(told, allow_nan=False)  # refuses what is no JSON and no number
    if not isinstance(told, dict):
        raise ValueError
    return told


def _message(told: dict[str, Any]) -> _Message:
    verdict, reasons = told["verdict"], told["reasons"]
    known = verdict in (STABLE, SLIP)
    p_slip = _number(told, "p_slip", 1, (int, float)) if known else told["p_slip"]
    fits = (
        isinstance(verdict, str)
        and _number(told, "verdict_code") == CODES.get(verdict)
        and told["valid"] is known
        and (known or p_slip is None)
        and isinstance(reasons, list)
        and all(isinstance(reason, str) for reason in reasons)
        and bool(reasons) is not known
        and isinstance(told["boot_id"], str)
    )
    if not fits:
        raise ValueError
    boot_id, seq, grasp = told["boot_id"], _number(told, "seq"), _number(told, "grasp")
    read_ns = _number(told, "t_mono_ns")
    age_ms, silence_ms = (
        _number(told, name, MILLISECONDS_MAX, (int, float)) for name in ("age_ms", "silence_ms")
    )
    said = Verdict(verdict, tuple(reasons), p_slip, grasp, seq, boot_id)
    return _Message(said, read_ns, read_ns + round(age_ms * 1e6), round(silence_ms * 1e6))


def _telling(lifted_on: Verdict, slipped: bool, object_name: str | None) -> bytes:
    """What to send. Raises `ValueError`."""
    if not lifted_on.boot_id or not lifted_on.grasp:
        raise ValueError("nothing was lifted on a verdict that is of no grasp")
    words = ["outcome", lifted_on.boot_id, str(lifted_on.grasp), SLIP if slipped else STABLE]
    if object_name is not None:
        if OBJECT.fullmatch(object_name) is None:
            raise ValueError(f"{object_name!r} is no name of an object")
        words.append(object_name)
    return " ".join(words).encode()


def _taken(payload: bytes) -> OutcomeAnswer | None:
    """The answer to an outcome; None for what is not understood."""
    try:
        told = _parsed(payload)
        if _number(told, "v") != VERSION:
            return OutcomeAnswer("version")
        said, why = told["ok"], "" if told["ok"] is True else told["why"]
    except (ValueError, KeyError, RecursionError):
        return None
    fits = isinstance(said, bool) and isinstance(why, str) and bool(why) is not said
    return OutcomeAnswer(why) if fits else None


def _number(
    told: dict[str, Any], name: str, most: float = INTEGER_MAX, kinds: tuple[type, ...] = (int,)
) -> Any:  # noqa: ANN401
    """Of one of these kinds, of which bool is none, from 0 to `most`."""
    value = told[name]
    if type(value) not in kinds or not 0 <= value <= most:
        raise ValueError
    return value
