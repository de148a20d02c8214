"""`graspd data`: what is fetched is right or refused, whatever a server does."""

from __future__ import annotations

import functools
import hashlib
import http.server
import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from graspd.models.bts3 import TABLES
from tests.kit.inside import graspd, output


class QuietHandler(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002, ANN401 - its signature
        pass


@pytest.fixture
def mirror(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A folder, and the loopback address at which it is served over HTTP."""
    folder = tmp_path / "mirror"
    folder.mkdir()
    handler = functools.partial(QuietHandler, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield folder, f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def test_data_is_fetched_and_checked(
    bts3_dir: Path, mirror: tuple[Path, str], tmp_path: Path
) -> None:
    folder, address = mirror
    for table in TABLES:
        (folder / table.upstream_name).write_bytes((bts3_dir / f"{table.name}.csv").read_bytes())
    output("data", "--to", tmp_path / "data", "--url", address)
    for table in TABLES:
        content = (tmp_path / "data" / f"{table.name}.csv").read_bytes()
        assert hashlib.sha256(content).hexdigest() == table.sha256
    again = output("data", "--to", tmp_path / "data", "--url", "http://127.0.0.1:9")
    assert again.count("is there") == 3
    output("data", "--to", tmp_path / "copy", "--from", tmp_path / "data")
    assert len(list((tmp_path / "copy").iterdir())) == 3


def test_data_changed_on_the_server_is_refused(mirror: tuple[Path, str], tmp_path: Path) -> None:
    folder, address = mirror
    (folder / TABLES[0].upstream_name).write_text("object,slipped\n")
    result = graspd("data", "--to", tmp_path / "data", "--url", address)
    assert result.returncode == 1
    assert "SHA-256 differs" in result.stderr
    assert list((tmp_path / "data").iterdir()) == []


@contextmanager
def served(answer: Callable[[socket.socket], None]) -> Iterator[str]:
    """Address of an HTTP server that calls `answer` with the socket of its one client."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            client, _ = listener.accept()
            with client:
                client.recv(65536)
                answer(client)

        thread = threading.Thread(target=serve)
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        thread.join()


HEAD = b"HTTP/1.1 200 OK\r\n"
ANSWERS = {
    "no status line": b"SSH-2.0-server\r\n\r\n",
    "broken chunks": HEAD + b"Transfer-Encoding: chunked\r\n\r\nzz\r\n",
    "half a file": HEAD + b"Content-Length: 1000\r\n\r\nabc",
    "an endless head": HEAD + b"A: b\r\n" * 1000,
    "another address": b"HTTP/1.1 302 Found\r\nLocation: http://[x\r\n\r\n",
}


@pytest.mark.parametrize("kind", ANSWERS)
def test_a_malformed_server_answer_is_reported_in_one_line(tmp_path: Path, kind: str) -> None:
    with served(lambda client: client.sendall(ANSWERS[kind])) as address:
        result = graspd("data", "--to", tmp_path / "data", "--url", address)
    assert result.returncode == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"graspd: {address}/")
    assert list((tmp_path / "data").iterdir()) == []


@pytest.mark.parametrize(
    "address",
    ["http://a b", "http://[::1", "http://127.0.0.1:port", "http://\udcff"],
)
def test_an_invalid_address_is_refused_in_one_line(tmp_path: Path, address: str) -> None:
    result = graspd("data", "--to", tmp_path, "--url", address)
    assert result.returncode == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith("graspd: http:/")


@pytest.mark.parametrize("kind", ["fifo", "folder"])
def test_a_fifo_or_folder_at_the_target_is_not_replaced(tmp_path: Path, kind: str) -> None:
    target = tmp_path / f"{TABLES[0].name}.csv"
    if kind == "fifo":
        os.mkfifo(target)
    else:
        target.mkdir()
    result = graspd("data", "--to", tmp_path, "--from", tmp_path)
    assert result.returncode == 1
    assert result.stderr == f"graspd: {target}: is there and is not a regular file\n"
    assert not target.is_file()
