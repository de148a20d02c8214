"""The process that holds the ZeroMQ sockets of peers, so that no peer can end the daemon.

libzmq 4.3.5 ends its process if a peer with a full queue sends a heartbeat and hangs up, and if
memory or descriptors run out. `Door` starts this process, and restarts it. The process also reads
the keys of peers.

A call of a PUB, XPUB or ROUTER socket does not return while peers flood it, so threads serve them.
`zmq.proxy` copies messages to the subscribers, in C. Questions go through `Courier`, because
`zmq.proxy` would take a thousand before it sends an answer. PUB, ROUTER and the sockets to the loop
have an I/O thread each, so a flood on one does not delay the others.
"""

from __future__ import annotations

import json
import logging
import os
import resource
import select
import shutil
import signal
import struct
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import zmq

from graspd.daemon.process import logs

if TYPE_CHECKING:
    from zmq.auth.thread import ThreadAuthenticator

    from graspd.daemon.publish.keys import Admission

log = logging.getLogger("graspd")

Frames = list[bytes]
Socket = zmq.Socket[bytes]

MESSAGES, QUESTIONS, ECHO = "messages", "questions", "echo"
"""Names of the sockets to the loop, in a folder that only the daemon's user may enter."""
MESSAGE_MAX_BYTES: Final = 1024
"""Longest frame of a peer. An outcome has up to 132 bytes, the handshake with keys 257 (RFC 26)."""
TO_SUBSCRIBERS, TO_ASKERS, TO_LOOP = 1, 2, 4
"""Bits of libzmq's I/O threads (ZMQ_AFFINITY)."""
HANDSHAKE_MS: Final = 5000
"""Longest handshake of a peer, ms."""
HEARTBEAT_MS, HEARTBEAT_TIMEOUT_MS = 1000, 3000
"""Time between two heartbeats over TCP, and the silence after which a peer is gone, ms."""
SUBSCRIPTIONS_QUEUED, ASK_QUEUE = 2, 16
"""Most messages of one peer that wait: subscriptions in the PUB, questions in the ROUTER socket.

Without a limit two peers fill 100 MiB a second, faster than Python reads."""
QUESTIONS_MAX: Final = 8
"""Most questions that the loop takes in one round: 0.3 ms on a slow computer."""
PAUSE_MS: Final = 2
"""Longest pause of the courier after up to `QUESTIONS_MAX` questions, ms; an answer ends it."""
FRAMES_MAX: Final = 4
"""Most frames kept of a message: routing id, delimiter, text, and one that marks it as wrong."""
LINGER_MS: Final = 500
"""Longest wait at closing for peers to take queued messages, ms."""
CLOSE_S: Final = 1
"""Longest wait of `Door.close` for this process to end, s; systemd's watchdog waits 2 s."""
LOOK_MS: Final = 1000
"""Time between two checks of threads and keys, ms."""
MEMORY_MAX_BYTES: Final = 512 << 20
"""Most memory of the process; it takes 20 MiB, and 4 KiB for each peer."""
REVOKED: Final = 3
"""Exit code after a key was removed: libzmq cannot disconnect a single peer."""
END: Final = b"e"
"""Byte on stdin at an orderly end of the daemon. Without it the daemon was killed."""
LOOP_CAME, SUBSCRIBER_CAME = b"l", b"s"
"""Bytes on stdout when the loop's own subscriber, or another subscriber, has connected."""
ZAP_DOMAIN: Final = "graspd"
"""Domain of the `tcp://` sockets; without one libzmq asks no authenticator (RFC 27)."""
FAILED: Final = int(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL)
"""Events of failed handshakes; the second one if the peer hangs up first."""
EVENT: Final = struct.Struct("=HI")
"""First frame of a monitor's message: event and value (zmq_socket_monitor(3))."""
USER_IDS: Final = 2**32 - 1
"""Number of user ids; a user namespace may have fewer (user_namespaces(7))."""
OVERFLOW_ID: Final = 65534
"""Linux' default of /proc/sys/kernel/overflowuid, which `ProcSubset=pid` hides."""
PROBLEMS: Final = {
    0x11000001: "it takes another key for the daemon's",
    0x11000002: "it has no key",
}
"""Mistake of a peer, by the value of its failed handshake (ZMQ_PROTOCOL_ERROR_*)."""


class Plan(NamedTuple):
    """Sockets that the process serves. `Door` writes the plan to stdin as one line, a JSON list."""

    folder: str
    """Folder of the sockets to the loop."""
    endpoints: Sequence[str]
    """Endpoint of subscribers; a second one takes questions."""
    descriptors: Sequence[int]
    """Descriptor of the listening socket of each endpoint."""
    high_water_mark: int
    """Most messages that wait for one subscriber."""
    processors: Sequence[int]
    """Processors to use. The loop that starts the process may be restricted to fewer."""
    keys: Sequence[str] | None
    """Daemon's public and secret key, Z85, for `tcp://`, folder of peers' keys; None: no keys."""


packed: Final = msgspec.msgpack.encode
"""Packs frames into one. libzmq ends a process whose peer ends between two frames."""
unpacked: Final = msgspec.msgpack.Decoder(Frames).decode


class Proxy(threading.Thread):
    """Copies messages between two sockets until their context ends, then closes the sockets."""

    def __init__(self, endpoint: str, front: Socket, back: Socket) -> None:
        """`endpoint`: for the log. `front`, `back`: only this thread uses them after `start`."""
        super().__init__(name=f"serve {endpoint}", daemon=True)
        self.endpoint = endpoint
        self._front, self._back = front, back

    def run(self) -> None:
        try:
            self._copy()
        except zmq.ContextTerminated:
            pass
        except zmq.ZMQError as error:
            log.error("%s: %s", self.endpoint, error.strerror)
        finally:
            self._front.close()
            self._back.close()

    def _copy(self) -> None:
        zmq.proxy(self._front, self._back)


class Courier(Proxy):
    """Carries questions of peers to the loop, a few at a time, and all answers back.

    After the routing id it inserts a frame with the sender's credential.
    """

    def __init__(
        self, endpoint: str, front: Socket, back: Socket, admission: Admission | None
    ) -> None:
        """`front`: socket of peers. `back`: socket to the loop. `admission`: peers with keys, for
        `tcp://`; None: without keys."""
        super().__init__(endpoint, front, back)
        self._admission = admission
        self._unknown_user = unknown_user()
        self._is_warned = False

    def _copy(self) -> None:
        poller = zmq.Poller()
        poller.register(self._front, zmq.POLLIN)
        poller.register(self._back, zmq.POLLIN)
        while True:
            poller.poll()
            self._carry_answers()
            for _ in range(QUESTIONS_MAX):
                if not self._carry_question():
                    break
            if self._back.poll(PAUSE_MS):  # an answer ends the pause; questions wait
                self._carry_answers()

    def _carry_answers(self) -> None:
        while self._back.poll(0):
            self._front.send_multipart(unpacked(self._back.recv()), zmq.NOBLOCK)

    def _carry_question(self) -> bool:
        """Carry one question, its first `FRAMES_MAX` frames; return False if none waits or the
        queue is full."""
        if not self._back.poll(0, zmq.POLLOUT) or not self._front.poll(0):
            return False
        first = self._front.recv(copy=False)
        frames = [first.bytes, self._credential(first)]
        while self._front.getsockopt(zmq.RCVMORE):
            frame = self._front.recv()
            if len(frames) <= FRAMES_MAX:
                frames.append(frame)
        self._back.send(packed(frames))
        return True

    def _credential(self, frame: zmq.Frame) -> bytes:
        """Return the sender: `user <uid>` by the kernel, `key <name>` by the handshake, or b"" on
        `tcp://` without keys, and for a user whom the kernel does not tell apart from others."""
        with suppress(zmq.ZMQError):  # libzmq knows nothing of the sender
            if self.endpoint.startswith("ipc://"):
                _, *numbers = str(frame.get("Peer-Address")).rsplit(":", 3)  # uid, gid, pid
                return self._user(int(numbers[0])) if len(numbers) == 3 else b""
            if self._admission is not None:  # without keys a peer may send any `User-Id`
                key = str(frame.get("User-Id")).encode()
                return b"key " + self._admission.admitted.get(key, "").encode()
        return b""

    def _user(self, number: int) -> bytes:
        if number != self._unknown_user:
            return b"user %d" % number
        if not self._is_warned:
            what = "a peer's user has no id in this user namespace: [ask] tell cannot name it"
            log.warning("%s: %s", self.endpoint, what)
        self._is_warned = True
        return b""


def unknown_user() -> int | None:
    """Return the user id that the kernel shows for all users that have none in the user namespace
    of this process; None if all have one."""
    try:
        rows = Path("/proc/self/uid_map").read_text().splitlines()
    except OSError:  # a kernel without user namespaces
        return None
    if sum(int(row.split()[2]) for row in rows) >= USER_IDS:
        return None
    with suppress(OSError):
        return int(Path("/proc/sys/kernel/overflowuid").read_text())
    return OVERFLOW_ID


class Lookout(threading.Thread):
    """Warns of peers whose handshake fails, and reports new subscribers to `Door`.

    Monitors must be read all the time: libzmq waits where the queue of one is full. They are read
    until their context ends.
    """

    def __init__(self, monitors: Sequence[Socket], echo: str) -> None:
        """`monitors`: sockets that only this thread may use after `start`.

        `echo`: endpoint of the loop's own subscriber.
        """
        super().__init__(name="lookout", daemon=True)
        self._monitors = monitors
        self._echo = echo.encode()

    def run(self) -> None:
        poller = zmq.Poller()
        for monitor in self._monitors:
            poller.register(monitor, zmq.POLLIN)
        try:
            while True:
                for monitor, _ in poller.poll():
                    event, endpoint = monitor.recv_multipart()
                    kind, value = EVENT.unpack(event)
                    if kind == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                        with suppress(BlockingIOError):  # `Door` has unread reports of it already
                            os.write(1, LOOP_CAME if endpoint == self._echo else SUBSCRIBER_CAME)
                        continue
                    problem = PROBLEMS.get(value, "it does not speak ZeroMQ with keys")
                    log.warning("turned away a peer: %s", problem)
        except zmq.ContextTerminated:
            pass
        finally:
            for monitor in self._monitors:
                monitor.close(0)


class Porter:
    """All ZeroMQ sockets that peers connect to."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._context: zmq.Context[Socket] = zmq.Context(io_threads=3)
        self._admission: Admission | None = None
        self._authenticator: ThreadAuthenticator | None = None
        self._monitors: list[Socket] = []
        self._threads: list[threading.Thread] = []
        if plan.keys is not None:
            self._authenticate(Path(plan.keys[2]))
        self._serve_subscribers(0)
        if len(plan.endpoints) > 1:
            self._serve_questions(1)
        self._threads.append(Lookout(self._monitors, self._own(ECHO)))

    def _authenticate(self, folder: Path) -> None:
        from zmq.auth.thread import ThreadAuthenticator  # only where there are keys

        from graspd.daemon.publish.keys import Admission

        self._admission = admission = Admission(folder)
        admission.look()
        self._authenticator = ThreadAuthenticator(self._context)
        self._authenticator.configure_curve_callback(ZAP_DOMAIN, admission)
        self._authenticator.start()

    def _serve_subscribers(self, number: int) -> None:
        most = self._plan.high_water_mark
        at_once = max(most // 10, 1)  # larger batches would overflow the queues of subscribers
        messages = self._socket(zmq.PULL, TO_LOOP, received=at_once)
        messages.bind(self._own(MESSAGES))
        peers = self._socket(zmq.PUB, TO_SUBSCRIBERS, most, SUBSCRIPTIONS_QUEUED)
        self._watch(peers, number, int(zmq.EVENT_HANDSHAKE_SUCCEEDED))
        peers.bind(self._own(ECHO))  # same I/O thread: late when subscribers are
        self._listen(peers, number)
        self._threads.append(Proxy(self._plan.endpoints[number], messages, peers))

    def _serve_questions(self, number: int) -> None:
        peers = self._socket(zmq.ROUTER, TO_ASKERS, ASK_QUEUE, ASK_QUEUE)
        peers.router_handover = True  # a client that reconnects keeps its routing id
        questions = self._socket(zmq.DEALER, TO_LOOP)
        questions.bind(self._own(QUESTIONS))
        self._watch(peers, number)
        self._listen(peers, number)
        courier = Courier(self._plan.endpoints[number], peers, questions, self._admission)
        self._threads.append(courier)

    def _own(self, name: str) -> str:
        return f"ipc://{self._plan.folder}/{name}"

    def _socket(self, kind: int, by: int, sent: int = 1, received: int = 1) -> Socket:
        """Return a socket of a `kind` (zmq.PUB, ...) with the I/O threads `by` (`TO_...`). `sent`,
        `received`: most messages that it queues for and from each peer."""
        made = self._context.socket(kind)
        made.linger = 0
        made.affinity = by
        made.sndhwm, made.rcvhwm = sent, received
        return made

    def _watch(self, made: Socket, number: int, events: int = 0) -> None:
        """Monitor `events` (with keys, also failed handshakes). Call this before peers connect."""
        if self._keys_at(number) is not None:
            events |= FAILED
        if events:
            self._monitors.append(made.get_monitor_socket(events))

    def _keys_at(self, number: int) -> Sequence[str] | None:
        return self._plan.keys if self._plan.endpoints[number].startswith("tcp://") else None

    def _listen(self, made: Socket, number: int) -> None:
        made.linger = LINGER_MS
        made.maxmsgsize = MESSAGE_MAX_BYTES
        made.handshake_ivl = HANDSHAKE_MS
        made.use_fd = self._plan.descriptors[number]  # libzmq closes it
        endpoint = self._plan.endpoints[number]
        if endpoint.startswith("tcp://"):
            made.ipv6 = "[" in endpoint
            made.heartbeat_ivl = HEARTBEAT_MS
            made.heartbeat_timeout = HEARTBEAT_TIMEOUT_MS
        if (keys := self._keys_at(number)) is not None:
            public, secret, _ = keys
            made.curve_publickey, made.curve_secretkey = public.encode(), secret.encode()
            made.curve_server = True
            made.zap_domain = ZAP_DOMAIN.encode()
        made.bind(endpoint)

    def serve(self, ending: int) -> int:
        """Serve until `ending` becomes readable; return the exit code.

        Also ends when a thread has ended, and when a key was removed.
        """
        for thread in self._threads:
            thread.start()
        poll = select.poll()
        poll.register(ending, select.POLLIN)
        while not poll.poll(LOOK_MS):
            for thread in self._threads:
                if not thread.is_alive():
                    log.error("%s has ended", thread.name)
                    return 1
            if self._authenticator is not None and not self._authenticator.is_alive():
                log.error("pyzmq's authenticator has ended")
                return 1
            if self._admission is not None and self._admission.look():
                return REVOKED
        if os.read(ending, 1):
            self._end()
        else:  # the daemon was killed
            shutil.rmtree(self._plan.folder, ignore_errors=True)
        return 0

    def _end(self) -> None:
        """Disconnect all peers, after they had `LINGER_MS` to take what is queued."""
        signal.alarm(2 * CLOSE_S)  # ends the process if `Door` has not by then
        if self._authenticator is not None:
            self._authenticator.stop()
        self._context.term()


def main() -> None:
    """Serve the `Plan` in the first line of stdin until stdin ends or `END` comes."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # only the daemon decides when to end
    logs.set_up(os.environ)
    stdin = open(0, "rb", buffering=0)  # noqa: SIM115 - open to the end
    plan = Plan(*json.loads(stdin.readline()))
    os.set_blocking(1, False)
    with suppress(OSError):
        os.sched_setaffinity(0, plan.processors)
    with suppress(OSError):  # a service manager that forbids it has limits of its own
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_MAX_BYTES, MEMORY_MAX_BYTES))
        Path("/proc/self/oom_score_adj").write_text("1000")  # to be ended before the daemon
    os._exit(Porter(plan).serve(0))


if __name__ == "__main__":
    main()
