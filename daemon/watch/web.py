"""The page: an HTTP server for browsers of this computer."""

from __future__ import annotations

import base64
import hashlib
import logging
import re
import socket
import sys
import threading
from collections.abc import Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any, Final

import msgspec

from graspd.daemon.process.signals import StopSignal
from graspd.daemon.watch.view import TICK_S, HandFeed, snapshots

log = logging.getLogger("graspd.watch")

ADDRESS: Final = "127.0.0.1"
HOSTS: Final = {"127.0.0.1", "localhost", "[::1]"}
"""Accepted host names. A foreign page may reach loopback by another name (DNS rebinding)."""
SITES: Final = {None, "none", "same-origin"}
"""Accepted values of `Sec-Fetch-Site`: the request comes from no other site."""
CONNECTIONS_MAX: Final = 32
"""Most connections, each with a thread; an open page keeps one."""
PATIENCE_S: Final = 5.0
"""Longest silence of a browser in a request, and longest wait until it continues to read, s."""
SEND_BUFFER_BYTES: Final = 32 * 1024
"""Size of a connection's send buffer: a few snapshots. A slow browser misses later ones."""
RETRY_MS: Final = 1000
"""Time after which a browser connects again, ms."""


class Newest:
    """The newest snapshot, for threads that wait for it."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._payload = b""
        self.number = 0
        """Number of the newest snapshot; 0: none yet."""
        self.closed = False

    def put(self, payload: bytes) -> None:
        with self._changed:
            self._payload, self.number = payload, self.number + 1
            self._changed.notify_all()

    def after(self, number: int) -> tuple[int, bytes]:
        """Wait for a snapshot newer than `number`; return its number and payload.

        The payload is b"" after `close`.
        """
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

    daemon_threads = True
    allow_reuse_address = True
    request_queue_size = CONNECTIONS_MAX

    def __init__(self, port: int, newest: Newest) -> None:
        """Listen on loopback. Raises `OSError`."""
        self.newest = newest
        self.page, self.policy = load_page()
        self._places = threading.BoundedSemaphore(CONNECTIONS_MAX)
        super().__init__((ADDRESS, port), _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Serve a connection in a thread, or close it if `CONNECTIONS_MAX` are in use."""
        if not self._places.acquire(blocking=False):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except BaseException:  # no thread could be started
            self._places.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        failure = sys.exception()
        gone = isinstance(failure, OSError)
        log.log(logging.DEBUG if gone else logging.ERROR, "%s: %r", client_address, failure)

    def server_close(self) -> None:
        """Close the server and end the connections of all pages."""
        self.newest.close()
        super().server_close()


class _Handler(BaseHTTPRequestHandler):
    server: Server
    server_version = "graspd"
    sys_version = ""
    timeout = PATIENCE_S

    def setup(self) -> None:
        """Limit the send buffer, so that a slow browser has a small backlog."""
        self.request.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        super().setup()

    def parse_request(self) -> bool:
        """Return False, after an error reply, for a request that this server's page never makes."""
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
        number = newest.number  # skip the present snapshot, which may be old
        self._begin("text/event-stream")
        self.wfile.write(f"retry: {RETRY_MS}\n\n".encode())
        while not newest.closed:
            number, payload = newest.after(number)
            if payload:
                self.wfile.write(b"data: " + payload + b"\n\n")

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        log.debug(format, *args)


def load_page() -> tuple[bytes, str]:
    """Return the page, and the content security policy: only its own script and style run."""
    folder = resources.files("graspd.daemon.watch")
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
            for seen in snapshots(hands, lambda: stop.wait(TICK_S)):
                newest.put(msgspec.json.encode(seen))
        finally:
            server.shutdown()
            thread.join()
