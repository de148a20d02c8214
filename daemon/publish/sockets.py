"""The sockets of a scene: the loop's end of them, and the process `porter` that holds them.

The loop uses only sockets to that process, because a hostile peer can make libzmq end its
process. `check` then restarts it, and peers reconnect.
"""

from __future__ import annotations

import json
import logging
import select
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Final, Self

import zmq

from graspd.daemon.judge.reasons import Reason
from graspd.daemon.process.worker import PROCESSORS
from graspd.daemon.publish import PublishError, porter
from graspd.daemon.publish.companion import Companion, PublishedVerdict, Requests
from graspd.daemon.publish.listener import Listener, user_id
from graspd.daemon.publish.porter import ASK_QUEUE, LINGER_MS, Frames, Plan, Socket
from graspd.daemon.scene import Scene
from graspd.daemon.scene.scene import Curve

if TYPE_CHECKING:
    from graspd.daemon.process.signals import StopSignal
    from graspd.daemon.publish.questions import Questions

log = logging.getLogger("graspd")

STATUS = b"status."
"""Start of the topic of statuses, which the loop also receives; `close` waits for the last one."""
ANSWERS_QUEUED: Final = 512
"""Most answers that wait for the courier: to 256 questions, and to 256 outcomes."""
SUBSCRIBES_S: Final = 0.1
"""Longest time from a peer's handshake to its first subscription, s."""
RECONNECT_MS: Final = 10
"""Time between two tries to reach the process while it starts, ms."""
START_S: Final = 30.0
"""Longest time of the first start of the process, s."""
AGAIN_S, AGAIN_MAX_S = 0.1, 0.8
"""Shortest and longest pause before a restart, s. It doubles while restarts follow each other."""
LATE_S: Final = 0.2
"""Time in which the loop must receive its own status, s. After that, subscribers are late."""
TACTILE = b"tactile."
HIGH_WATER_MARK = 10
"""Most messages that wait for a subscriber: a tenth of a second of verdicts at 100 Hz."""
NEVER_NS = 10**18
"""Longest period of published readings, ns: thirty years, so practically never."""


class Sockets(Companion):
    """The sockets of one scene, open until `close`."""

    def __init__(
        self,
        wanted: Scene,
        clock: Callable[[], int] = time.monotonic_ns,
        *,
        high_water_mark: int | None = None,
    ) -> None:
        """Open the sockets. Raises `PublishError` or `KeysError`.

        `clock` gives monotonic ns. `high_water_mark`: most messages that wait for a subscriber;
        None: `HIGH_WATER_MARK`.
        """
        self.endpoint = wanted.endpoint
        self._clock = clock
        self._counters = Counter(dropped=0)
        tactile_hz = wanted.publish.tactile_hz
        self._tactile_period_ns = round(min(1e9 / tactile_hz, NEVER_NS)) if tactile_hz else None
        self._tactile_due_ns = 0
        keys = None if wanted.curve is None else _load_keys(wanted, wanted.curve)
        self._door: Door | None = None
        """None after `close`."""
        self.questions: Questions | None = None
        self._listeners: list[Listener] = []
        """Listener for subscribers, then the one for questions, if peers may ask."""
        try:
            self._listen(wanted)
            self._door = Door(self._listeners, high_water_mark or HIGH_WATER_MARK, keys)
            if self.questions is not None:
                self.filenos = [self._door.fileno()]
        except BaseException:
            self.close()
            raise

    def _listen(self, wanted: Scene) -> None:
        publish = wanted.publish
        mode = None if publish.file_mode is None else int(publish.file_mode, 8)
        self._listeners.append(Listener(wanted.endpoint, mode, publish.group))
        if wanted.ask_endpoint is not None:
            ask = Listener(wanted.ask_endpoint, wanted.ask_file_mode, publish.group)
            self._listeners.append(ask)
            from graspd.daemon.publish.questions import Questions  # only where peers may ask

            tells = None if wanted.ask is None or wanted.ask.tell is None else self._tells(wanted)
            self.questions = Questions(self._answer, round(wanted.gate.request_ms * 1e6), tells)

    def _tells(self, wanted: Scene) -> Callable[[bytes], bool]:
        """Return a function that is True for credentials that may lift and report outcomes."""
        names = () if wanted.ask is None else wanted.ask.tell or ()
        if (wanted.ask_endpoint or "").startswith("ipc://"):
            return {b"user %d" % user_id(name) for name in names}.__contains__
        return {b"key " + name.encode() for name in names}.__contains__

    def send(self, topic: bytes, payload: bytes) -> None:
        """Publish one message; count it if it is dropped."""
        if self._door is None or not self._door.send(topic, payload):
            self._counters["dropped"] += 1

    def wanted(self, topic: bytes) -> bool:
        """Return True if this topic is due; of readings one per period, none at `tactile_hz` 0."""
        if not topic.startswith(TACTILE):
            return True
        if self._tactile_period_ns is None:
            return False
        now_ns = self._clock()
        # Half a period early is in time, because readings at exactly this rate jitter.
        if now_ns < self._tactile_due_ns - self._tactile_period_ns // 2:
            return False
        self._tactile_due_ns = max(self._tactile_due_ns, now_ns) + self._tactile_period_ns
        return True

    def _answer(self, frames: Sequence[bytes]) -> bool:
        return self._door is not None and self._door.answer(frames)

    def before_wait(self, requests: Requests) -> int | None:
        """Restart an ended process; serve questions. Return when the next is due, ns, or None."""
        if self._door is None:
            return None
        self._door.check()
        if self.questions is None:
            return None
        due_ns = self.questions.serve(self._door.receive(), self._clock(), requests)
        return self._clock() if self._door.is_asked else due_ns

    def on_verdict(self, published: PublishedVerdict) -> None:
        """Answer all questions if `published.is_answer`, else those due or waiting for the disk."""
        if self.questions is not None:
            self.questions.answer(published, None if published.is_answer else self._clock())

    @property
    def counters(self) -> dict[str, dict[str, int]]:
        counters = {"publish": dict(self._counters)}
        if self.questions is not None:
            counters["ask"] = dict(self.questions.counters)
        return counters

    @property
    def health(self) -> dict[str, Reason]:
        late = self._door is not None and self._door.is_late
        return {"publish": Reason.HEARD_LATE} if late else {}

    def wait_for_subscriber(self, timeout_s: float, stop: StopSignal | None = None) -> bool:
        return self._door is not None and self._door.wait_for_subscriber(timeout_s, stop)

    def close(self) -> None:
        if self._door is not None and not self._door.close():
            log.warning("%s: libzmq's process did not end and was killed", self.endpoint)
        self._door = None
        for listener in self._listeners:
            listener.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()


class Door:
    """The loop's end of all sockets, open until `close`. Call methods in the loop's thread only."""

    def __init__(
        self,
        listeners: Sequence[Listener],
        high_water_mark: int = HIGH_WATER_MARK,
        keys: Sequence[str] | None = None,
    ) -> None:
        """Start the process that serves the endpoints. Raises `PublishError` if that fails.

        `listeners`: the first is for subscribers, an optional second one for questions.
        `high_water_mark`: most messages that wait for one subscriber. `keys`: the daemon's, and the
        folder of its peers', as in `Plan`; None: `tcp://` is open to all.
        """
        try:
            self._folder = tempfile.mkdtemp(prefix="graspd-")
        except OSError as error:
            raise PublishError(f"no folder for sockets: {error}") from error
        self._listeners = listeners  # their descriptors are needed again
        self._plan = Plan(
            self._folder,
            [listener.endpoint for listener in listeners],
            [listener.fileno() for listener in listeners],
            high_water_mark,
            sorted(PROCESSORS),
            keys,
        )
        self._context: zmq.Context[Socket] = zmq.Context()
        self._unheard = b""
        """Last published status, until the loop's own subscriber receives it; then b""."""
        self._due_s = 0.0
        """Time from which this status is late, monotonic s."""
        self.is_late = False
        """True if the loop's own subscriber did not receive the last status within `LATE_S`."""
        self._again_s, self._pause_s = 0.0, AGAIN_S
        """Earliest time of the next restart, monotonic s, and the pause before it, s."""
        self._told = b""
        """Output of the process so far: `LOOP_CAME` and `SUBSCRIBER_CAME`."""
        self._process: subprocess.Popen[bytes] | None = None
        try:
            self._out = self._socket(zmq.PUSH, porter.MESSAGES, sent=high_water_mark)
            self._echo = self._socket(zmq.SUB, porter.ECHO)
            self._echo.subscribe(STATUS)
            self._ask = self._socket(zmq.DEALER, porter.QUESTIONS, ANSWERS_QUEUED, ASK_QUEUE)
            self._process = self._start()
            if not self._is_told(porter.LOOP_CAME, START_S) or not self._out.poll(
                round(START_S * 1e3), zmq.POLLOUT
            ):
                raise PublishError(f"{self._plan.endpoints[0]}: libzmq does not serve it")
        except BaseException as error:
            self.close()
            if isinstance(error, zmq.ZMQError):  # such as a path that is too long
                raise PublishError(f"no sockets below TMPDIR: {error.strerror}") from error
            raise

    def _socket(self, kind: int, name: str, sent: int = 1, received: int = 1) -> Socket:
        """Return a socket to the process's `name`; `sent`, `received`: most messages it queues."""
        made = self._context.socket(kind)
        made.linger = 0
        made.sndhwm, made.rcvhwm = sent, received
        # No answer is queued for a process that has ended. A subscriber would lose half a message.
        made.immediate = kind != zmq.SUB
        made.reconnect_ivl = RECONNECT_MS
        if name != porter.QUESTIONS or len(self._plan.endpoints) > 1:
            made.connect(f"ipc://{self._folder}/{name}")
        return made

    def _start(self) -> subprocess.Popen[bytes]:
        now_s = time.monotonic()
        follows = now_s < self._again_s + AGAIN_MAX_S
        self._pause_s = min(2 * self._pause_s, AGAIN_MAX_S) if follows else AGAIN_S
        self._again_s = now_s + self._pause_s
        try:
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", porter.__name__],  # -P: not from this folder
                bufsize=0,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                pass_fds=self._plan.descriptors,
                start_new_session=True,
            )
            _write(process, json.dumps(self._plan).encode() + b"\n")
        except OSError as error:
            raise PublishError(f"cannot start a process for libzmq: {error.strerror}") from error
        return process

    def fileno(self) -> int:
        """Return a descriptor that becomes readable when a question comes.

        Sending an answer makes it unreadable again: look at `is_asked` before waiting for it.
        """
        return int(self._ask.getsockopt(zmq.FD))

    def send(self, topic: bytes, payload: bytes) -> bool:
        """Publish one message; return False if it is dropped: the process is behind or ended."""
        if topic.startswith(STATUS):
            self._unheard, self._due_s = payload, time.monotonic() + LATE_S
            self.is_late = False
        return _sent(self._out, (topic, payload))

    def answer(self, frames: Sequence[bytes]) -> bool:
        """Send an answer with its routing id; False if it is dropped."""
        return _sent(self._ask, [porter.packed(frames)])

    def receive(self) -> list[Frames]:
        """Return at most `QUESTIONS_MAX` questions, each with its routing id."""
        received: list[Frames] = []
        with suppress(zmq.Again):
            while len(received) < porter.QUESTIONS_MAX:
                received.append(porter.unpacked(self._ask.recv(zmq.NOBLOCK)))
        return received

    @property
    def is_asked(self) -> bool:
        """True if a question waits, as after a full `receive`."""
        return bool(self._ask.poll(0))

    def check(self) -> None:
        """Restart the process if it has ended; set `is_late`.

        Call it in each round of the loop.
        """
        if self._unheard:
            self._hear_echo(0.0)
            self.is_late |= bool(self._unheard) and time.monotonic() > self._due_s
        ended = None if self._process is None else self._process.poll()
        if ended is None or time.monotonic() < self._again_s:
            return
        if ended != porter.REVOKED:
            log.error("libzmq's process has ended with %d: starting it again", ended)
        try:
            process = self._start()
        except PublishError as error:
            log.error("%s", error)
            return
        self._end_process()
        self._process = process

    def _hear_echo(self, timeout_s: float) -> None:
        while self._echo.poll(round(timeout_s * 1e3)):
            if self._echo.recv_multipart()[1] == self._unheard:
                self._unheard = b""
                return

    def wait_for_subscriber(self, timeout_s: float, stop: StopSignal | None = None) -> bool:
        """Wait for a subscriber; False after `timeout_s`, or when `stop` becomes readable."""
        came = self._is_told(porter.SUBSCRIBER_CAME, timeout_s, stop)
        if came:
            time.sleep(SUBSCRIBES_S)
        return came

    def _is_told(self, what: bytes, timeout_s: float, stop: StopSignal | None = None) -> bool:
        """Wait until the process has written `what`; return False after `timeout_s` or at its end.
        Also returns False when `stop` becomes readable."""
        if self._process is None or (told := self._process.stdout) is None:
            return False
        poll = select.poll()
        poll.register(told, select.POLLIN)
        if stop is not None:
            poll.register(stop, select.POLLIN)
        until_s = time.monotonic() + timeout_s
        while what not in self._told and (left_s := until_s - time.monotonic()) > 0:
            ready = [descriptor for descriptor, _ in poll.poll(left_s * 1e3)]
            if ready and ready != [told.fileno()]:
                return False
            more = told.read(1 << 16) if ready else b""
            if ready and not more:
                return False
            self._told += more
        return what in self._told

    def close(self) -> bool:
        """Disconnect all peers, after they had `LINGER_MS` to take what is queued.
        False if the process had to be killed after `CLOSE_S`. May be called again."""
        until_s = time.monotonic() + LINGER_MS / 1e3
        # Messages that the process has not published are lost when it ends.
        while self._unheard and (left_s := until_s - time.monotonic()) > 0:
            self._hear_echo(left_s)
        self._unheard = b""
        self._context.destroy()
        ended = self._end_process()
        shutil.rmtree(self._folder, ignore_errors=True)
        return ended

    def _end_process(self) -> bool:
        process, self._process = self._process, None
        if process is None:
            return True
        with process:
            with suppress(OSError):  # the process has ended
                _write(process, porter.END)
            try:
                process.wait(porter.CLOSE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                return False
        return True


def _write(process: subprocess.Popen[bytes], line: bytes) -> None:
    if process.stdin is not None:
        process.stdin.write(line)


def _sent(to: Socket, frames: Sequence[bytes]) -> bool:
    with suppress(zmq.Again):
        to.send_multipart(frames, flags=zmq.NOBLOCK)
        return True
    return False


def _load_keys(wanted: Scene, curve: Curve) -> tuple[str, str, str]:
    from graspd.daemon.publish import keys  # only where there are any

    public, secret = keys.load_own(curve.secret_key)
    clients = keys.load_clients(curve.clients)  # raises now, while the user is there to mend it
    for warning in keys.missing(wanted, clients):
        log.warning("%s", warning)
    return public.decode(), secret.decode(), str(curve.clients)
