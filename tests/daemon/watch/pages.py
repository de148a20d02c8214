"""Servers of the page: of a feed that comes, or of snapshots that a test makes."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator

import msgspec

from graspd.daemon.watch.feed import Feed
from graspd.daemon.watch.snapshot import Snapshot
from graspd.daemon.watch.view import TICK_S, HandFeed, View, snapshots
from graspd.daemon.watch.web import Newest, Server
from tests.kit.waiting import wait_until


@contextlib.contextmanager
def serving(publish: Callable[[Newest], object], port: int = 0) -> Iterator[Server]:
    """Serve the page while `publish` puts snapshots."""
    server = Server(port, Newest())
    jobs = (lambda: server.serve_forever(0.01)), (lambda: publish(server.newest))
    threads = [threading.Thread(target=job) for job in jobs]
    for thread in threads:
        thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        for thread in threads:
            thread.join()
        server.server_close()
        wait_until(
            lambda: not any("process_request" in each.name for each in threading.enumerate())
        )


class Page:
    """A server of the page that can be stopped and started again at its port."""

    def __init__(self, endpoint: str) -> None:
        self._endpoint = endpoint
        self._stack = contextlib.ExitStack()
        self._over = threading.Event()
        self.port = 0

    @property
    def address(self) -> str:
        return f"http://localhost:{self.port}/"

    def start(self) -> None:
        self._over.clear()
        self.port = self._stack.enter_context(serving(self._publish, self.port)).server_port
        self._stack.callback(self._over.set)

    def _publish(self, newest: Newest) -> None:
        with Feed(self._endpoint) as feed:
            hands = [HandFeed(feed, View(self._endpoint))]
            for seen in snapshots(hands, lambda: self._over.wait(TICK_S)):
                newest.put(msgspec.json.encode(seen))

    def stop(self) -> None:
        self._stack.close()


@contextlib.contextmanager
def serving_hands(make: Callable[[int], list[Snapshot]]) -> Iterator[str]:
    """Serve what `make` gives for 0, 1, 2 ..., twenty times a second; the address of the page."""
    over = threading.Event()

    def publish(newest: Newest) -> None:
        seq = 0
        while not over.wait(0.05):
            newest.put(msgspec.json.encode(make(seq)))
            seq += 1

    with serving(publish) as server:
        try:
            yield f"http://127.0.0.1:{server.server_port}/"
        finally:
            over.set()
