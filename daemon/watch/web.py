"""The page: an HTTP server for browsers of this computer."""

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
from daemon.watch.view import TICK_S, HandFeed, snapshots

log = logging.getLogger("graspd.watch")

ADDRESS: Final = "127.0.0.1"
HOSTS: Final = {"127.0.0.1", "localhost", "[::1]"}
"""A foreign page may bring another name to reach loopback (DNS rebinding)."""
SITES: Final = {None, "none", "same-origin"}
"""`Sec-Fetch-Site` of requests that no other site has made."""
PAGES_MAX: Final = 8
CONNECTIONS_MAX: Final = 16
"""Connections, each with a thread; a browser may need two."""
PATIENCE_S: Final = 5.0
"""Longest time for a request, or for one snapshot, s."""
GIVES_WAY_S: Final = 0.25
"""Age, s, from which an unanswered request gives way to a new connection."""
SEND_BUFFER_BYTES: Final = 32 * 1024
"""Some snapshots. A slow browser misses the later ones."""
RETRY_MS: Final = 1000
"""Time after which a browser connects again, ms."""


class Newest:
    """The newest snapshot, for threads that wait for it."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._payload = b""
        self.number = 0
        """0 before the first."""
        self.closed = False

    def put(self, payload: bytes) -> None:
        with self._changed:
            self._payload, self.number = payload, self.number + 1
            self._changed.notify_all()

    def after(self, number: int) -> tuple[int, bytes]:
        """Wait for one newer than `number`; return its number and payload, b"" if closed."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self.number > number)
            return self.number, b"" if self.closed else self._payload

    def close(self) -> None:
        """End all waiting."""
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
        self._ends: dict[socket.socket, float] = {}
        """When each connection is cut off, monotonic s; the oldest first."""
        self._lock = threading.Lock()
        super().__init__((ADDRESS, port), _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Serve a connection in a thread, if one is free or another gives way."""
        if not self._places.acquire(blocking=False):
            self._cut_off(time.monotonic() + PATIENCE_S - GIVES_WAY_S, at_most=1)
            if not self._places.acquire(timeout=GIVES_WAY_S):
                self.shutdown_request(request)
                return
        with self._lock:
            self._ends[request] = time.monotonic() + PATIENCE_S
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        try:
            super().process_request_thread(request, client_address)
        finally:
            with self._lock:
                self._ends.pop(request, None)
            self._places.release()

    def service_actions(self) -> None:
        """Cut off slow connections; called several times a second."""
        self._cut_off(time.monotonic())

    def keep(self, request: socket.socket) -> None:
        """Let a connection stay while it takes its snapshots."""
        with self._lock:
            self._ends[request] = math.inf

    def _cut_off(self, due_s: float, at_most: int = CONNECTIONS_MAX) -> None:
        """Cut off connections that end by `due_s`, the oldest first."""
        with self._lock:
            late = [request for request, end_s in self._ends.items() if end_s <= due_s][:at_most]
            for request in late:
                self._ends[request] = math.inf
        for request in late:
            try:
                request.shutdown(socket.SHUT_RDWR)
            except OSError:
                log.debug("a browser had gone already")

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        failure = sys.exception()
        gone = isinstance(failure, OSError)
        log.log(logging.DEBUG if gone else logging.ERROR, "%s: %r", client_address, failure)

    def server_close(self) -> None:
        """Cut off all browsers and wait for their threads."""
        self.newest.close()
        self._cut_off(math.inf)
        super().server_close()


class _Handler(BaseHTTPRequestHandler):
    """One request."""

    server: Server
    server_version = "graspd"
    sys_version = ""
    timeout = PATIENCE_S

    def setup(self) -> None:
        """Keep the backlog of a slow browser small."""
        self.request.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        super().setup()

    def parse_request(self) -> bool:
        """Refuse what a page of this server does not ask."""
        if not super().parse_request():
            return False
        hosts = self.headers.get_all("Host") or []
        is_ours = len(hosts) == 1 and re.sub(r":[0-9]{1,5}$", "", hosts[0].lower()) in HOSTS
        if self.command != "GET":
            self.send_error(HTTPStatus.METHOD_NOT_ALLOWED)
        elif not is_ours:
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
        elif self.headers.get("Sec-Fetch-Site") not in SITES:
            self.send_error(HTTPStatus.FORBIDDEN)
        else:
            return True
        return False

    def do_GET(self) -> None:
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
        newest = self.server.newest
        if not self.server.pages.acquire(blocking=False):
            self.send_error(HTTPStatus.SERVICE_UNAVAILABLE, f"{PAGES_MAX} pages are open")
            return
        try:
            self.server.keep(self.request)
            number = newest.number  # the next one is sent first: this may be old
            self._begin("text/event-stream")
            self.wfile.write(f"retry: {RETRY_MS}\n\n".encode())
            while not newest.closed:
                number, payload = newest.after(number)
                if payload:
                    self.wfile.write(b"data: " + payload + b"\n\n")
        finally:
            self.server.pages.release()

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        log.debug(format, *args)


def load_page() -> tuple[bytes, str]:
    """Return the page, and the policy that lets it run its own script and style alone."""
    folder = resources.files("daemon.watch")
    text = folder.joinpath("page.html").read_text("utf-8")
    policy = "default-src 'none'; "
    for element, file in (("script", "page.js"), ("style", "page.css")):
        content = folder.joinpath(file).read_text("utf-8")
        text = text.replace(f"<{element}></{element}>", f"<{element}>{content}</{element}>")
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        policy += f"{element}-src 'sha256-{digest}'; "
    policy += "connect-src 'self'; img-src data:; "
    policy += "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    return text.encode(), policy


def serve(hands: Sequence[HandFeed], port: int) -> None:
    """Serve the page until SIGINT or SIGTERM. Raises `OSError` if the port is taken."""
    newest = Newest()
    with StopSignal() as stop, Server(port, newest) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.1,), name="page")
        thread.start()
        try:
            sys.stdout.write(f"http://{ADDRESS}:{server.server_port}/ (Ctrl-C ends)\n")
            sys.stdout.flush()
            for seen in snapshots(hands, lambda: _is_asked_to_stop(stop)):
                newest.put(msgspec.json.encode(seen))
        finally:
            server.shutdown()
            thread.join()


def _is_asked_to_stop(stop: StopSignal) -> bool:
    select.select([stop.fileno()], [], [], TICK_S)
    return stop.received is not None
