"""The page's server: only for browsers of this computer, which cannot hold it up."""

from __future__ import annotations

import http.client
import json
import re
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing

import pytest

from graspd.daemon.watch.web import ADDRESS, CONNECTIONS_MAX, Server, load_page
from tests.daemon.watch.browser import serving


@pytest.fixture
def server() -> Iterator[Server]:
    with serving(lambda _newest: None) as made:
        yield made


def ask(server: Server, path: str = "/", method: str = "GET", **headers: str) -> tuple[int, bytes]:
    """Send a request; return status and body of the answer. `headers`: with `_` for `-`."""
    with closing(http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=100)) as link:
        link.putrequest(method, path, skip_host=True)
        for name, value in {"Host": f"127.0.0.1:{server.server_port}", **headers}.items():
            link.putheader(name.replace("_", "-"), value)
        link.endheaders()
        answer = link.getresponse()
        return answer.status, answer.read()


def opened(server: Server, stack: ExitStack) -> socket.socket:
    """Return a connection that streams snapshots, as to a page; the answer's head is read."""
    link = stack.enter_context(socket.create_connection(("127.0.0.1", server.server_port), 10))
    link.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
    head = b""
    while b"retry: " not in head:
        head += link.recv(1)
    return link


def has_ended(link: socket.socket) -> bool:
    try:
        return link.recv(1) == b""
    except ConnectionResetError:
        return True


def events(link: socket.socket) -> Iterator[object]:
    with link.makefile("rb") as lines:
        for line in lines:
            if line.startswith(b"data: "):
                yield json.loads(line.removeprefix(b"data: "))


def test_the_page_comes_whole_and_may_load_nothing(server: Server) -> None:
    status, body = ask(server)
    assert status == 200
    page, policy = load_page()
    assert body == page
    assert b"<canvas" in body
    assert re.findall(rb"(?:https?:)?//[a-z]", body.replace(b"// ", b"")) == []
    assert policy.startswith("default-src 'none'; ")
    assert "unsafe" not in policy


OURS = ("127.0.0.1", "localhost", "LOCALHOST:8377", "localhost:9000", "[::1]:8377")
OTHERS = (
    *("evil.example", "evil.example:8377", "localhost.evil.example", "127.0.0.1.evil.example"),
    *("192.168.1.2", "0.0.0.0", "", "localhost:", "localhost:x", "localhost@evil.example"),
)


@pytest.mark.parametrize("host", [*OURS, *OTHERS])
def test_only_host_names_of_this_computer_are_answered(server: Server, host: str) -> None:
    assert ask(server, Host=host)[0] == (200 if host in OURS else 421)
    assert host in OURS or ask(server, "/events", Host=host)[0] == 421


def test_requests_with_two_host_headers_or_none_are_refused(server: Server) -> None:
    assert server.server_address[0] == "127.0.0.1"
    for head in (b"", b"Host: localhost\r\nHost: evil.example\r\n"):
        with socket.create_connection(("127.0.0.1", server.server_port), 10) as link:
            link.sendall(b"GET / HTTP/1.1\r\n" + head + b"\r\n")
            assert link.recv(100).startswith(b"HTTP/1.0 421 ")


@pytest.mark.parametrize(
    ("path", "site", "status"),
    [
        *[("/events", "cross-site", 403), ("/events", "same-site", 403)],
        *[("/", "none", 200), ("/", "same-origin", 200)],
        *[(path, "none", 404) for path in ("/other", "/x//", "/../page.html", "/events/")],
        ("/%2e%2e/view.py", "none", 404),
    ],
)
def test_cross_site_requests_and_unknown_paths_are_refused(
    server: Server, path: str, site: str, status: int
) -> None:
    assert ask(server, path, Sec_Fetch_Site=site)[0] == status


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "HEAD", "CONNECT", "X"])
def test_other_methods_than_get_are_refused(server: Server, method: str) -> None:
    assert ask(server, method=method)[0] == 405


@pytest.mark.parametrize(
    "sent",
    [b"\0" * 100, b"GET\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", b"a" * 70_000, b"\x16\x03\x01" * 9],
)
def test_a_malformed_request_ends_only_its_connection(server: Server, sent: bytes) -> None:
    with socket.create_connection(("127.0.0.1", server.server_port), 10) as link:
        link.sendall(sent)
        link.shutdown(socket.SHUT_WR)
        try:
            while link.recv(4096):
                pass
        except ConnectionResetError:
            pass
    assert ask(server)[0] == 200


def test_a_new_page_gets_no_old_and_all_new_snapshots(server: Server) -> None:
    server.newest.put(b'{"n":1}')
    server.newest.put(b'{"n":2}')
    with ExitStack() as stack:
        coming = events(opened(server, stack))
        for number in range(3, 10):
            server.newest.put(b'{"n":%d}' % number)
            assert next(coming) == {"n": number}


def test_a_browser_that_does_not_read_misses_snapshots(server: Server) -> None:
    with ExitStack() as stack:
        slow, quick = opened(server, stack), events(opened(server, stack))
        for number in range(2000):
            server.newest.put(b'{"n":%d,"x":"%s"}' % (number, b"x" * 4000))
            if number % 100 == 99:
                while True:
                    found = next(quick)
                    assert isinstance(found, dict)
                    if found["n"] == number:
                        break
        server.newest.put(b'{"n":-1}')
        seen = 0
        for found in events(slow):
            assert isinstance(found, dict)
            if found["n"] == -1:
                break
            seen += 1
        assert seen < 1900  # what the sockets of both sides hold, 8 MB would be all


@pytest.mark.parametrize("begin", [b"", b"GET / HTTP/1.0\r\nHost: localhost\r\nX: "])
def test_a_browser_silent_within_a_request_is_cut_off(
    server: Server, monkeypatch: pytest.MonkeyPatch, begin: bytes
) -> None:
    monkeypatch.setattr("graspd.daemon.watch.web._Handler.timeout", 0.2)
    with socket.create_connection((ADDRESS, server.server_port), 10) as link:
        link.sendall(begin)
        assert has_ended(link)


def test_connections_whose_thread_cannot_start_take_no_place(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as without_threads:
        without_threads.setattr(threading.Thread, "start", lambda _thread: 1 // 0)
        for _ in range(CONNECTIONS_MAX):
            with socket.create_connection((ADDRESS, server.server_port), 10) as link:
                assert has_ended(link)
    assert ask(server)[0] == 200


def test_closing_the_server_ends_connections_that_wait() -> None:
    with ExitStack() as stack:
        with serving(lambda _newest: None) as server:
            waiting = opened(server, stack)
            server.newest.put(b"{}")
        assert list(events(waiting)) in ([], [{}])
