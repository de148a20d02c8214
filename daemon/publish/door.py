"""The ZeroMQ sockets of a scene, served in threads beside the loop.

A call of a PUB, XPUB or ROUTER socket does not return while peers flood it. The loop therefore
uses only sockets within the process (`inproc`). `zmq.proxy` copies messages to the subscribers, in
C. Questions go through `Courier`: `zmq.proxy` would take a thousand before it sends an answer.
"""

from __future__ import annotations

import errno
import logging
import os
import struct
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import zmq

from graspd.daemon.publish.listener import Listener, PublishError

if TYPE_CHECKING:
    from zmq.auth.thread import ThreadAuthenticator

    from graspd.daemon.process.signals import StopSignal

log = logging.getLogger("graspd")

Frames = list[bytes]
Socket = zmq.Socket[bytes]

STATUS = b"status."
"""Start of the topics that the loop also receives; `close` waits for the last of them."""
MESSAGE_MAX_BYTES: Final = 1024
"""Longest frame of a peer. An outcome has 128 bytes, the handshake with keys 257 (RFC 26)."""
HANDSHAKE_MS: Final = 5000
"""Longest handshake of a peer, ms."""
HEARTBEAT_MS, HEARTBEAT_TIMEOUT_MS = 1000, 3000
"""Time between two heartbeats over TCP, and the silence after which a peer is gone, ms."""
SUBSCRIPTIONS_QUEUED, ASK_QUEUE = 2, 16
"""Most messages of one peer that wait: subscriptions in the PUB, questions in the ROUTER socket."""
QUESTIONS_MAX: Final = 8
"""Most questions that the loop takes in one round: 0.3 ms on a slow computer."""
PAUSE_MS: Final = 2
"""Pause of the courier after `QUESTIONS_MAX` questions, ms."""
FRAMES_MAX: Final = 4
"""Most frames kept of a message: routing id, delimiter, text, and one that marks it as wrong."""
ANSWERS_QUEUED: Final = 512
"""Most answers that wait for the courier: to 256 questions, and to 256 outcomes."""
LINGER_MS: Final = 500
"""Longest wait at closing for peers to take queued messages, ms."""
CLOSE_S: Final = 1.0
"""Longest wait at closing for libzmq's threads, s; the watchdog waits 2 s."""
SUBSCRIBES_S: Final = 0.1
"""Longest time from a peer's handshake to its first subscription, s."""
ZAP_DOMAIN: Final = "graspd"
"""libzmq asks the authenticator only if there is a domain (RFC 27)."""
FAILED: Final = int(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL)
"""Events of failed handshakes; the second one if the peer hangs up first."""
EVENT: Final = struct.Struct("=HI")
"""First frame of a monitor's message: event and value (zmq_socket_monitor(3))."""
PROBLEMS: Final = {
    0x11000001: "it takes another key for the daemon's",
    0x11000002: "it has no key",
}
"""Problem of a peer by the value of its failed handshake (ZMQ_PROTOCOL_ERROR_*)."""


@dataclass(slots=True)
class Admission:
    """CURVE keys of `tcp://` sockets, in Z85."""

    public: bytes
    """Public key of the daemon."""
    secret: bytes
    admitted: Mapping[bytes, str]
    """Name of each peer that may connect, by its public key; may be replaced at any time."""

    def callback(self, _domain: str, key: bytes) -> bool:
        """Return True if the key may connect; called in pyzmq's thread."""
        name = self.admitted.get(key)
        if name is None:
            log.warning("turned away a peer: its key %s is not on the list", key.decode())
            return False
        log.info("admitted a peer with the key of %s", name)
        return True


class Proxy(threading.Thread):
    """Copies messages between two sockets until their context ends, and closes them."""

    def __init__(self, endpoint: str, front: Socket, back: Socket) -> None:
        """`front`, `back`: sockets that only this thread may use after `start`."""
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
    """Carries questions of the peers to the loop, a few at a time, and all answers back.

    Behind the routing id it puts a frame of its own with the sender's credential.
    """

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
            if self._back.poll(PAUSE_MS):  # meanwhile more questions wait
                self._carry_answers()

    def _carry_answers(self) -> None:
        while self._back.poll(0):
            self._front.send_multipart(self._back.recv_multipart(), zmq.NOBLOCK)

    def _carry_question(self) -> bool:
        """Carry one, cut at `FRAMES_MAX`; False if there is none or no room."""
        if not self._back.poll(0, zmq.POLLOUT) or not self._front.poll(0):
            return False
        first = self._front.recv(copy=False)
        frames = [first.bytes, self._credential(first)]
        while self._front.getsockopt(zmq.RCVMORE):
            frame = self._front.recv()
            if len(frames) <= FRAMES_MAX:
                frames.append(frame)
        self._back.send_multipart(frames)
        return True

    def _credential(self, frame: zmq.Frame) -> bytes:
        """Return `user <uid>` by the kernel, `key <Z85>` by the handshake, or nothing."""
        with suppress(zmq.ZMQError):  # libzmq knows nothing of the sender
            if self.endpoint.startswith("ipc://"):
                _, *numbers = str(frame.get("Peer-Address")).rsplit(":", 3)  # uid, gid, pid
                return b"user %d" % int(numbers[0]) if len(numbers) == 3 else b""
            # Without keys a peer may send any `User-Id`.
            if self._front.getsockopt(zmq.MECHANISM) == zmq.CURVE:
                return b"key %b" % str(frame.get("User-Id")).encode()
        return b""


class Lookout(threading.Thread):
    """Warns of peers whose handshake fails: reads monitors until their context ends; closes them.

    Monitors must be read all the time: libzmq waits where the queue of one is full.
    """

    def __init__(self, monitors: Sequence[Socket]) -> None:
        """`monitors`: sockets that only this thread may use after `start`."""
        super().__init__(name="lookout", daemon=True)
        self._monitors = monitors

    def run(self) -> None:
        poller = zmq.Poller()
        for monitor in self._monitors:
            poller.register(monitor, zmq.POLLIN)
        try:
            while True:
                for monitor, _ in poller.poll():
                    _, value = EVENT.unpack(monitor.recv_multipart()[0])
                    problem = PROBLEMS.get(value, "it does not speak ZeroMQ with keys")
                    log.warning("turned away a peer: %s", problem)
        except zmq.ContextTerminated:
            pass
        finally:
            for monitor in self._monitors:
                monitor.close(0)


class Door:
    """The loop's end of all sockets, open until `close`. Call methods in the loop's thread only."""

    def __init__(
        self,
        listeners: Sequence[Listener],
        high_water_mark: int = 1000,
        admission: Admission | None = None,
        *,
        awaits_subscriber: bool = False,
    ) -> None:
        """Raises `PublishError` if an endpoint cannot be had.

        `listeners`: endpoint of subscribers; a second one takes questions.
        `high_water_mark`: most messages that wait for one subscriber. `admission`: keys of
        `tcp://`. `awaits_subscriber`: True makes `wait_for_subscriber` possible.
        """
        self._admission = admission
        self._context: zmq.Context[Socket] = zmq.Context()
        self._authenticator: ThreadAuthenticator | None = None
        self._proxies: list[Proxy] = []
        self._watched: list[Socket] = []
        """Monitors of the sockets that want keys."""
        self._unheard = b""
        """Last status, until it comes back."""
        self._out = self._socket(zmq.PUSH, sent=high_water_mark)
        self._echo = self._socket(zmq.SUB)
        self._ask = self._socket(zmq.DEALER, sent=ANSWERS_QUEUED, received=ASK_QUEUE)
        self._subscribers = self._socket(zmq.PUB, high_water_mark, SUBSCRIPTIONS_QUEUED)
        self._monitor: Socket | None = None
        if awaits_subscriber:
            self._monitor = self._subscribers.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED)
        try:
            self._authenticate()
            self._serve_subscribers(listeners[0])
            for listener in listeners[1:]:
                self._serve_questions(listener)
        except BaseException:
            self._stop_authenticator()
            self._context.destroy()
            raise
        for proxy in self._proxies:
            proxy.start()
        if self._watched:
            Lookout(self._watched).start()

    def _socket(self, kind: int, sent: int = 1, received: int = 1) -> Socket:
        """Return a socket that queues at most this many messages of each peer."""
        made = self._context.socket(kind)
        made.linger = 0
        made.sndhwm, made.rcvhwm = sent, received
        return made

    def _authenticate(self) -> None:
        if self._admission is None:
            return
        from zmq.auth.thread import ThreadAuthenticator  # only where there are keys

        self._authenticator = ThreadAuthenticator(self._context)
        self._authenticator.configure_curve_callback(ZAP_DOMAIN, self._admission)
        self._authenticator.start()
        self._authenticator.pipe.sndtimeo = LINGER_MS  # to a thread that has ended it would wait

    def _serve_subscribers(self, listener: Listener) -> None:
        messages = self._socket(zmq.PULL)
        messages.bind("inproc://messages")
        self._out.connect("inproc://messages")
        self._subscribers.bind("inproc://echo")
        self._echo.subscribe(STATUS)
        self._echo.connect("inproc://echo")
        self._listen(self._subscribers, listener)
        self._proxies.append(Proxy(listener.endpoint, messages, self._subscribers))

    def _serve_questions(self, listener: Listener) -> None:
        peers = self._socket(zmq.ROUTER, ASK_QUEUE, ASK_QUEUE)
        peers.router_handover = True  # a client that reconnects keeps its routing id
        questions = self._socket(zmq.DEALER)
        questions.bind("inproc://questions")
        self._ask.connect("inproc://questions")
        self._listen(peers, listener)
        self._proxies.append(Courier(listener.endpoint, peers, questions))

    def _listen(self, made: Socket, listener: Listener) -> None:
        made.linger = LINGER_MS
        made.maxmsgsize = MESSAGE_MAX_BYTES
        made.handshake_ivl = HANDSHAKE_MS
        if listener.socket is not None:
            made.use_fd = os.dup(listener.socket.fileno())  # libzmq closes it
        else:
            made.ipv6 = "[" in listener.endpoint
            made.heartbeat_ivl = HEARTBEAT_MS
            made.heartbeat_timeout = HEARTBEAT_TIMEOUT_MS
            if self._admission is not None:
                made.curve_publickey = self._admission.public
                made.curve_secretkey = self._admission.secret
                made.curve_server = True
                made.zap_domain = ZAP_DOMAIN.encode()
                if made is not self._subscribers or self._monitor is None:  # a socket has one
                    self._watched.append(made.get_monitor_socket(FAILED))
        try:
            made.bind(listener.endpoint)
        except zmq.ZMQError as error:
            why = zmq.strerror(error.errno or 0)  # its own text names the endpoint again
            refusal = PublishError(f"cannot bind {listener.endpoint}: {why}")
            if error.errno == errno.EADDRINUSE:
                refusal.taken = listener.endpoint
            raise refusal from error

    def fileno(self) -> int:
        """Return a descriptor that becomes readable when a question comes.

        Sending an answer makes it unreadable again, so call `receive` in each round.
        """
        return int(self._ask.getsockopt(zmq.FD))

    def send(self, topic: bytes, payload: bytes) -> bool:
        """Publish one message; False if it is dropped because the proxy is behind."""
        if topic.startswith(STATUS):
            self._unheard = payload
        return _sent(self._out, (topic, payload))

    def answer(self, frames: Sequence[bytes]) -> bool:
        """Send an answer with its routing id; False if it is dropped."""
        return _sent(self._ask, frames)

    def receive(self) -> list[Frames]:
        """Return at most `QUESTIONS_MAX` questions, each with its routing id."""
        received: list[Frames] = []
        with suppress(zmq.Again):
            while len(received) < QUESTIONS_MAX:
                received.append(self._ask.recv_multipart(zmq.NOBLOCK))
        return received

    def check(self) -> None:
        """Raise `PublishError` if a thread has ended. Call it after each status message."""
        if self._authenticator is not None and not self._authenticator.is_alive():
            raise PublishError("pyzmq's authenticator has ended")
        for proxy in self._proxies:
            if not proxy.is_alive():
                raise PublishError(f"{proxy.endpoint}: libzmq no longer serves it")
        while self._echo.poll(0):
            self._hear_echo()

    def _hear_echo(self) -> None:
        if self._echo.recv_multipart()[1] == self._unheard:
            self._unheard = b""

    def wait_for_subscriber(self, timeout_s: float, stop: StopSignal | None = None) -> bool:
        """Wait for a subscriber; False after `timeout_s`, or when `stop` becomes readable."""
        if self._monitor is None:
            raise RuntimeError("the door was not opened to wait")
        poller = zmq.Poller()
        poller.register(self._monitor, zmq.POLLIN)
        if stop is not None:
            poller.register(stop.fileno(), zmq.POLLIN)
        came = self._monitor in dict(poller.poll(round(timeout_s * 1e3)))
        self._close_monitor()
        if came:
            time.sleep(SUBSCRIBES_S)
        return came

    def _close_monitor(self) -> None:
        if self._monitor is not None:
            self._subscribers.disable_monitor()
            self._monitor.close(0)
            self._monitor = None

    def close(self) -> bool:
        """Disconnect all peers, after they had `LINGER_MS` to take what is queued.
        False if libzmq's threads have not ended within `CLOSE_S`. May be called again."""
        if not self._echo.closed:
            self._await_last_status()
        self._close_monitor()
        for own in (self._out, self._echo, self._ask):
            own.close()
        self._stop_authenticator()
        ending = threading.Thread(target=self._context.term, name="close", daemon=True)
        ending.start()
        ending.join(CLOSE_S)
        return not ending.is_alive()

    def _await_last_status(self) -> None:
        """Wait until all messages are published: the context's end loses them."""
        until_s = time.monotonic() + LINGER_MS / 1e3
        while self._unheard and (left_s := until_s - time.monotonic()) > 0:
            if self._echo.poll(round(left_s * 1e3)):
                self._hear_echo()

    def _stop_authenticator(self) -> None:
        if self._authenticator is not None:
            with suppress(zmq.Again):
                self._authenticator.stop()
            self._authenticator = None


def _sent(to: Socket, frames: Sequence[bytes]) -> bool:
    with suppress(zmq.Again):
        to.send_multipart(frames, flags=zmq.NOBLOCK)
        return True
    return False
