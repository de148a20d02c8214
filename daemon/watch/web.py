"""The page: an HTTP server for browsers of this computer, live by Server-Sent Events."""

from __future__ import annotations

import base64
import hashlib
import logging
import math
import re
import select
import socket
import sys
import threading
import time
from collections.abc import Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any, Final

import msgspec

from daemon.process.signals import StopSignal
from daemon.watch.watching import TICK_S, Watched, snapshots

log = logging.getLogger("graspd.watch")

ADDRESS = "127.0.0.1"
HOSTS: Final = {"127.0.0.1", "localhost", "[::1]"}
"""What a browser of this computer calls this computer. Another name that leads here is one that a
foreign page was given to get at what is on loopback (DNS rebinding)."""
SITES: Final = {None, "none", "same-origin"}
"""`Sec-Fetch-Site` of requests that no other site's page has made."""
PAGES_MAX = 8
"""Pages that may be open at a time."""
CONNECTIONS_MAX = 16
"""Connections, each of which has a thread; a browser keeps one for the page and asks for others."""
PATIENCE_S = 5.0
"""How long a browser may take to ask and to take the page, or to take a snapshot, s."""
GIVES_WAY_S = 0.25
"""After so long without being served, s, a connection gives way to a new one when all are taken:
on this computer, a browser asks and takes the page within milliseconds."""
SEND_BUFFER_BYTES = 32 * 1024
"""Of a connection: a browser that is slow has a few snapshots before it, and misses the rest."""
RETRY_MS = 1000
"""When a browser that lost the connection tries again, ms."""


class Newest:
    """The newest snapshot, for threads that wait for it. Who is slow misses those between."""

    def __init__(self) -> None:
        """Without a snapshot."""
        self._changed = threading.Condition()
        self._payload = b""
        self._number = 0
        self.closed = False

    @property
    def number(self) -> int:
        """Of the newest; 0 before the first."""
        with self._changed:
            return self._number

    def put(self, payload: bytes) -> None:
        """Replace it."""
        with self._changed:
            self._payload, self._number = payload, self._number + 1
            self._changed.notify_all()

    def after(self, number: int) -> tuple[int, bytes]:
        """Number and payload of one that is newer than `number`; the same number if closed."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self._number > number)
            return (number, b"") if self.closed else (self._number, self._payload)

    def close(self) -> None:
        """Let all go who wait."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()


class Server(ThreadingHTTPServer):
    """Serves the page and the snapshots."""

    daemon_threads = False
    allow_reuse_address = True
    request_queue_size = CONNECTIONS_MAX

    def __init__(self, port: int, newest: Newest) -> None:
        """Listen on loopback. Raises `OSError`."""
        self.newest = newest
        self.page, self.policy = load_page()
        self.pages = threading.BoundedSemaphore(PAGES_MAX)
        self._places = threading.BoundedSemaphore(CONNECTIONS_MAX)
        self._open: dict[socket.socket, float] = {}
        """Connections, and when each is cut off at the latest, monotonic s; oldest first."""
        self._lock = threading.Lock()
        super().__init__((ADDRESS, port), _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Give a connection a thread, if there is one left for it or another gives way."""
        if not self._places.acquire(blocking=False):
            self._cut_off_before(time.monotonic() + PATIENCE_S - GIVES_WAY_S, at_most=1)
            if not self._places.acquire(timeout=GIVES_WAY_S):
                self.shutdown_request(request)
                return
        with self._lock:
            self._open[request] = time.monotonic() + PATIENCE_S
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Serve one connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            with self._lock:
                self._open.pop(request, None)
            self._places.release()

    def service_actions(self) -> None:
        """Cut off who takes too long; called several times a second."""
        self._cut_off_before(time.monotonic())

    def keep(self, request: socket.socket) -> None:
        """Let a connection stay as long as it takes its snapshots."""
        with self._lock:
            self._open[request] = math.inf

    def _cut_off_before(self, due_s: float, at_most: int = CONNECTIONS_MAX) -> None:
        """Cut off connections that are due by then, the oldest first. Their threads end soon."""
        with self._lock:
            late = [request for request, end_s in self._open.items() if end_s <= due_s][:at_most]
            for request in late:
                self._open[request] = math.inf
        for request in late:
            _cut_off(request)

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Browsers that go without a word are no news."""
        failure = sys.exception()
        gone = isinstance(failure, OSError)
        log.log(logging.DEBUG if gone else logging.ERROR, "%s: %r", client_address, failure)

    def server_close(self) -> None:
        """Cut off all browsers and wait for their threads."""
        self.newest.close()
        self._cut_off_before(math.inf)
        super().server_close()


class _Handler(BaseHTTPRequestHandler):
    """One request."""

    server: Server
    server_version = "graspd"
    sys_version = ""
    timeout = PATIENCE_S

    def setup(self) -> None:
        """Keep what waits for a slow browser small."""
        self.request.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        super().setup()

    def parse_request(self) -> bool:
        """Refuse what is not asked by a page of ours."""
        if not super().parse_request():
            return False
        refused = _refusal(self.command, self.headers)
        if refused is not None:
            self.send_error(refused)
        return refused is None

    def do_GET(self) -> None:
        """The page, or the snapshots as they come."""
        path = self.path.partition("?")[0]
        if path == "/":
            self._begin("text/html; charset=utf-8")
            self.wfile.write(self.server.page)
        elif path == "/events":
            self._stream()
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _begin(self, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", self.server.policy)
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("X-Frame-Options", "DENY")
        self.send_header("Connection", "close")
        self.end_headers()

    def _stream(self) -> None:
        if not self.server.pages.acquire(blocking=False):
            self.send_error(HTTPStatus.SERVICE_UNAVAILABLE, f"{PAGES_MAX} pages are open")
            return
        try:
            self.server.keep(self.request)
            number = self.server.newest.number  # the next one is sent first: this may be old
            self._begin("text/event-stream")
            self.wfile.write(f"retry: {RETRY_MS}\n\n".encode())
            while not self.server.newest.closed:
                number, payload = self.server.newest.after(number)
                if payload:
                    self.wfile.write(b"data: " + payload + b"\n\n")
        finally:
            self.server.pages.release()

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        """Nothing on the terminal; the log, if somebody wants it."""
        log.debug(format, *args)


def _refusal(command: str, headers: Any) -> HTTPStatus | None:  # noqa: ANN401
    if command != "GET":
        return HTTPStatus.METHOD_NOT_ALLOWED
    hosts = headers.get_all("Host") or []
    if len(hosts) != 1 or re.sub(r":[0-9]{1,5}$", "", hosts[0].lower()) not in HOSTS:
        return HTTPStatus.MISDIRECTED_REQUEST
    if headers.get("Sec-Fetch-Site") not in SITES:
        return HTTPStatus.FORBIDDEN
    return None


def load_page() -> tuple[bytes, str]:
    """The page, and the policy that lets it run its own script and style and nothing else."""
    folder = resources.files("daemon.watch")
    text = folder.joinpath("page.html").read_text("utf-8")
    digests = []
    for element, file in (("script", "page.js"), ("style", "page.css")):
        content = folder.joinpath(file).read_text("utf-8")
        text = text.replace(f"<{element}></{element}>", f"<{element}>{content}</{element}>")
        digest = hashlib.sha256(content.encode()).digest()
        digests.append(f"{element}-src 'sha256-{base64.b64encode(digest).decode()}'; ")
    policy = (
        f"default-src 'none'; {''.join(digests)}connect-src 'self'; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return text.encode(), policy


def _cut_off(request: socket.socket) -> None:
    try:
        request.shutdown(socket.SHUT_RDWR)
    except OSError:
        log.debug("a browser had gone already")


def serve(hands: Sequence[Watched], port: int) -> None:
    """Serve the page until SIGINT or SIGTERM. Raises `OSError` if the port is not to be had."""
    newest = Newest()
    with StopSignal() as stop, Server(port, newest) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.1,), name="page")
        thread.start()
        try:
            sys.stdout.write(f"http://{ADDRESS}:{server.server_port}/ (Ctrl-C ends)\n")
            sys.stdout.flush()
            for seen in snapshots(hands, lambda: _asked_to_stop(stop)):
                newest.put(msgspec.json.encode(seen))
        finally:
            server.shutdown()
            thread.join()


def _asked_to_stop(stop: StopSignal) -> bool:
    select.select([stop.fileno()], [], [], TICK_S)
    return stop.received is not None
