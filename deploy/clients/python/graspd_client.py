"""May the hand lift? The newest verdict of a graspd daemon, and `unknown` where there is none.

One file to copy: it needs Python 3.9 or newer and pyzmq, and nothing of graspd itself. The messages
are those of deploy/wire/README.md, version 1.

    with Graspd("ipc:///run/graspd/right.ipc") as graspd:
        if graspd.may_i_lift(0.5):
            lift()

Nothing here runs by itself but ZeroMQ's own thread, and an object belongs to the thread that made
it. Only `verdict(wait_s)` and `may_i_lift(deadline_s)` wait, and no longer than they are told.
"""

from __future__ import annotations

import json
import math
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import zmq
from zmq.auth import load_certificate

VERSION = 1
"""Of the messages; what has another is not understood."""
STABLE, SLIP, UNKNOWN = "stable", "slip", "unknown"
CODES = {UNKNOWN: 0, STABLE: 1, SLIP: 2}
INTEGER_MAX = 2**60
"""Of a message: as a time, 36 years in ns."""
MESSAGE_MAX_BYTES = 1 << 16
"""A verdict has 0.6 kB, at most 3; a peer that sends more is no daemon and is disconnected."""
QUEUE_MAX = 1000
"""Messages that wait to be read: ten seconds at 100 Hz."""
READ_WITHIN_NS = 5_000_000_000
"""Whoever has read nothing for longer connects anew: what waits is old, and what is new is lost."""
SLICE_MS = 10
"""Longest wait in one piece: so well is it known when a message came from another computer."""
CLOCK_SLACK_NS = 1_000_000
"""What a message may come from the future by before the clocks are taken for different ones."""
DRIFT = 1e-3
"""By which two computers' clocks may run apart: NTP slews by 5e-4, a bad crystal is off by 1e-4."""
FORMER_MAX = 16
"""Starts of the daemon that are remembered as over."""
HEARTBEAT_MS, HEARTBEAT_TIMEOUT_MS = 1000, 3000
"""On TCP: between two signs of life, and when a daemon that gives none is connected to anew, ms."""


@dataclass(frozen=True)
class Verdict:
    """What is known of the grasp. True in an `if` exactly when it is stable."""

    verdict: str
    """`stable`, `slip` or `unknown`."""
    reasons: tuple[str, ...] = ()
    """Why it is unknown: the daemon's reasons, or one of `no-message`, `joining`, `silent`,
    `stale`, `clock`, `malformed`, `version`, `behind`, `closed` (deploy/clients/README.md)."""
    p_slip: float | None = None
    """Probability of slip; None when unknown."""
    grasp: int | None = None
    """Number of the contact episode; None before the first message."""
    seq: int | None = None
    boot_id: str | None = None
    age_ms: float | None = None
    """Since the reading's last byte, ms, at least."""

    def __bool__(self) -> bool:
        return self.verdict == STABLE


@dataclass(frozen=True)
class LiftAnswer:
    """Whether to lift. True in an `if` exactly when the hand may."""

    verdict: Verdict
    """What it was decided by; besides its usual reasons `no-answer` and `late`."""
    waited_s: float

    @property
    def may_lift(self) -> bool:
        """Whether the hand may."""
        return bool(self.verdict)

    def __bool__(self) -> bool:
        return self.may_lift


@dataclass
class Counts:
    """What came since the start."""

    messages: int = 0
    """New ones of this hand."""
    lost: int = 0
    """Gaps in `seq`, in messages."""
    repeats: int = 0
    """Messages that were known already."""
    malformed: int = 0
    """Messages that are not understood, answers too."""
    restarts: int = 0
    """Times that the daemon was started anew."""
    former: int = 0
    """Messages of a start that is over."""


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

        With `ask_endpoint` (`[ask]`), `may_i_lift` asks for a judgement as well. `same_computer`
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
        self._read_ns = self._empty_ns = time.monotonic_ns()

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
        question = _Question(self._newest, self._link) if self._asks and not self._closed else None
        try:
            decided = self._decided(question)
            while decided.verdict == UNKNOWN and not self._closed and self._wait(due_ns):
                decided = self._decided(question)
                if time.monotonic_ns() > due_ns and decided:
                    decided = replace(decided, verdict=UNKNOWN, reasons=("late",), p_slip=None)
        finally:
            if question is not None:
                self._link.hang_up()
        return LiftAnswer(decided, (time.monotonic_ns() - began_ns) / 1e9)

    def close(self) -> None:
        """Close the sockets. May be called again; every verdict is unknown from then on."""
        if not self._closed:
            self._closed = True
            self._link.close()

    def __enter__(self) -> Graspd:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _decided(self, question: _Question | None) -> Verdict:
        newest = self.verdict()
        return newest if question is None else question.decided(newest)

    def _drain(self) -> bool:
        """Read all that waits, without waiting; whether there was anything new."""
        new = False
        now_ns = time.monotonic_ns()
        if now_ns - self._read_ns > READ_WITHIN_NS:
            self._link.renew()
            self._empty_ns = now_ns
        self._behind = True
        for _ in range(QUEUE_MAX):
            before_ns = time.monotonic_ns()
            frames = self._link.receive()
            if frames is None:
                self._empty_ns = before_ns
                self._behind = False
                break
            new |= self._newest.take(frames, self._empty_ns, time.monotonic_ns())
        self._read_ns = time.monotonic_ns()
        return new

    def _wait(self, due_ns: int) -> bool:
        """Wait for a message, but not for long; False when it is time to end."""
        left_ns = due_ns - time.monotonic_ns()
        if left_ns <= 0:
            return False
        self._link.wait(min(left_ns // 1_000_000, SLICE_MS))
        return True


class _Message(NamedTuple):
    """What matters of a verdict message."""

    boot_id: str
    seq: int
    grasp: int
    verdict: str
    p_slip: float | None
    reasons: tuple[str, ...]
    read_ns: int
    """By the daemon's monotonic clock: when the reading's last byte came ..."""
    published_ns: int
    """... and when the message went out."""
    silence_ns: int


class Newest:
    """What the newest message says; no socket and no clock of its own."""

    def __init__(self, topic: bytes, max_age_ns: int, same_computer: bool) -> None:
        """`topic` is the hand's; other messages are passed over."""
        self.counts = Counts()
        self._topic = topic
        self._max_age_ns = max_age_ns
        self._same_computer = same_computer
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

    def take(self, frames: Sequence[bytes], empty_ns: int, now_ns: int) -> bool:
        """Take in a message, which came after `empty_ns` and not after `now_ns` (own clock).

        Whether it is a new one. A repeated one is not; one that is not understood is.
        """
        if not frames or frames[0] != self._topic:
            return False
        found = _read(frames[1]) if len(frames) == 2 else "malformed"
        if isinstance(found, str):
            self.counts.malformed += 1
            self._message, self._why = None, found
            return True
        if not self._is_new(found):
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
        reasons = message.reasons
        if self._published_ns is None:
            reasons = ("joining",)
        elif age_ns < -CLOCK_SLACK_NS:
            reasons = ("clock",)
        elif age_ns > message.silence_ns:
            reasons = ("silent",)
        elif message.verdict != UNKNOWN and reading_age_ns > self._max_age_ns:
            reasons = ("stale",)
        about = (message.grasp, message.seq, message.boot_id, reading_age_ns / 1e6)
        if reasons:
            return Verdict(UNKNOWN, reasons, None, *about)
        return Verdict(message.verdict, (), message.p_slip, *about)

    def answered(self, payload: bytes) -> _Message | None:
        """An answer; None if it is not understood."""
        found = _read(payload)
        if not isinstance(found, str):
            return found
        self.counts.malformed += 1
        return None

    def _is_new(self, message: _Message) -> bool:
        if message.boot_id != self._boot_id:
            if message.boot_id in self._former:
                self.counts.former += 1
                return False
            if self._boot_id is not None:
                self._former.append(self._boot_id)
                self.counts.restarts += 1
            self._boot_id, self._seq, self._best = message.boot_id, message.seq, None
            return True
        if message.seq <= self._seq:
            self.counts.repeats += 1
            return False
        self.counts.lost += message.seq - self._seq - 1
        self._seq = message.seq
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

    def __init__(self, newest: Newest, link: _Link) -> None:
        self._newest = newest
        self._link = link
        self._asked = False
        self._stable: _Message | None = None
        """The answer that is to be confirmed."""

    def decided(self, newest: Verdict) -> Verdict:
        """The newest message, if it confirms the answer; unknown otherwise. Asks if need be."""
        payload = self._link.answer() if self._asked else None
        if payload is not None:
            self._asked = False
            answer = self._newest.answered(payload)
            if answer is not None and answer.verdict == SLIP:
                return Verdict(SLIP, (), answer.p_slip, answer.grasp, answer.seq, answer.boot_id)
            self._stable = answer if answer is not None and answer.verdict == STABLE else None
        if self._stable is not None and not _is_behind(newest, self._stable):
            if newest and newest.grasp == self._stable.grasp:
                return newest
            self._stable = None
        if not self._asked and self._stable is None:
            self._link.ask()
            self._asked = True
        reasons = newest.reasons or ("no-answer",)
        return replace(newest, verdict=UNKNOWN, reasons=reasons, p_slip=None)


def _is_behind(newest: Verdict, answer: _Message) -> bool:
    """Whether the message that is the answer is still to come."""
    if newest.boot_id != answer.boot_id or newest.seq is None:
        return True
    return newest.seq < answer.seq


class _Link:
    """The sockets."""

    def __init__(self, endpoint: str, topic: bytes, ask: str | None, keys: Keys | None) -> None:
        self._endpoint, self._topic, self._ask, self._keys = endpoint, topic, ask, keys
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._asking: zmq.Socket[bytes] | None = None
        try:
            self._socket = self._subscribed()
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
        poller = zmq.Poller()
        for socket in (self._socket, self._asking):
            if socket is not None:
                poller.register(socket, zmq.POLLIN)
        poller.poll(timeout_ms)

    def renew(self) -> None:
        """Connect anew, and forget what waits."""
        self._socket.close(0)
        self._socket = self._subscribed()

    def ask(self) -> None:
        """Ask; before the answer is there, not again."""
        if self._ask is not None:
            if self._asking is None:
                self._asking = self._connected(zmq.DEALER, self._ask)
            self._asking.send(b"judge", zmq.NOBLOCK)

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
        """Close all."""
        self._context.destroy(0)

    def _subscribed(self) -> zmq.Socket[bytes]:
        return self._connected(zmq.SUB, self._endpoint)

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


def _read(payload: bytes) -> _Message | str:
    """A verdict message; `malformed` or `version` for what is not understood or contradicts."""
    try:
        told = json.loads(payload.decode(), parse_constant=_refused, parse_float=_finite)
        if not isinstance(told, dict):
            return "malformed"
        version = _integer(told, "v")
        return _message(told) if version == VERSION else "version"
    except (ValueError, KeyError, RecursionError):
        return "malformed"


def is_same_computer(endpoint: str) -> bool:
    """Whether an endpoint can only be of this computer."""
    local = ("ipc://", "tcp://127.", "tcp://[::1]", "tcp://localhost:")
    return endpoint.startswith(local)


def _message(told: dict[str, Any]) -> _Message:
    verdict, p_slip, reasons = told["verdict"], told["p_slip"], told["reasons"]
    if not isinstance(verdict, str) or _integer(told, "verdict_code") != CODES.get(verdict):
        raise ValueError
    known = verdict != UNKNOWN
    if told["valid"] is not known or (p_slip is not None) is not known:
        raise ValueError
    if known and not 0.0 <= _number(told, "p_slip") <= 1.0:
        raise ValueError
    if not isinstance(reasons, list) or not all(isinstance(reason, str) for reason in reasons):
        raise ValueError
    if bool(reasons) is known or not isinstance(told["boot_id"], str):
        raise ValueError
    read_ns = _integer(told, "t_mono_ns")
    return _Message(
        boot_id=told["boot_id"],
        seq=_integer(told, "seq"),
        grasp=_integer(told, "grasp"),
        verdict=verdict,
        p_slip=p_slip,
        reasons=tuple(reasons),
        read_ns=read_ns,
        published_ns=read_ns + _milliseconds(told, "age_ms"),
        silence_ns=_milliseconds(told, "silence_ms"),
    )


def _integer(told: dict[str, Any], name: str) -> int:
    value = told[name]
    if type(value) is not int or not 0 <= value <= INTEGER_MAX:
        raise ValueError
    return value


def _number(told: dict[str, Any], name: str) -> float:
    value = told[name]
    if type(value) not in (int, float):
        raise ValueError
    return float(value) if abs(value) <= INTEGER_MAX else _refused(name)


def _milliseconds(told: dict[str, Any], name: str) -> int:
    """In ns."""
    value = _number(told, name)
    if not 0.0 <= value <= 1e12:  # thirty years
        raise ValueError
    return round(value * 1e6)


def _finite(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _refused(text)


def _refused(text: str) -> float:
    raise ValueError(text)
