"""Servers of the page, and a headless Chromium, driven by the DevTools protocol over a pipe."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, Self

import msgspec

from graspd.daemon.judge.reasons import Decision
from graspd.daemon.watch.feed import Feed
from graspd.daemon.watch.snapshot import Snapshot
from graspd.daemon.watch.view import TICK_S, HandFeed, View, snapshots
from graspd.daemon.watch.web import Newest, Server
from tests.daemon.watch.watch_fakes import Talker
from tests.kit.waiting import PATIENCE_S, wait_until

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
"""Path of Chromium; None: not installed."""
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
    *("--no-first-run", "--disable-extensions", "--disable-background-networking"),
    *("--remote-debugging-pipe", "--hide-scrollbars"),
)
Answer = dict[str, Any]
BANNER = "document.querySelector('.banner')"


@contextlib.contextmanager
def serving(publish: Callable[[Newest], object], port: int = 0) -> Iterator[Server]:
    """Serve the page; call `publish` in a thread, to put snapshots. `port` 0: any free one."""
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
    """Serve the snapshots `make(0)`, `make(1)` ..., twenty a second; yield the page's address."""
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


class Browser:
    """A headless Chromium with one page at a time, which ends with the block."""

    def __init__(self, profile: Path) -> None:
        """`profile` is an empty folder for what the browser keeps."""
        self._profile = profile
        self._number = 0
        self._buffer = b""
        self.complaints: list[str] = []
        """What the page logged as an error, and what it was not allowed."""

    def __enter__(self) -> Self:
        told, self._tell = os.pipe()
        self._hear, said = os.pipe()
        command = [str(CHROMIUM), *FLAGS, f"--user-data-dir={self._profile}", "about:blank"]
        self._process = subprocess.Popen(
            ["bash", "-c", f'exec "$@" 3<&{told} 4>&{said}', "bash", *command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(told, said),
        )
        os.close(told)
        os.close(said)
        self._ask("Target.getTargets")  # it answers once it has started
        return self

    def __exit__(self, *_details: object) -> None:
        with contextlib.suppress(OSError):
            self._send("Browser.close", {})
        os.close(self._tell)
        try:
            self._process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._hear)

    @contextlib.contextmanager
    def blank(self) -> Iterator[Self]:
        """Show a new page in the block, in a context without cookies or storage of former ones."""
        context = self._ask("Target.createBrowserContext")["browserContextId"]
        where = {"url": "about:blank", "browserContextId": context}
        page = self._ask("Target.createTarget", **where)["targetId"]
        self._session = self._ask("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
        self.complaints.clear()
        for domain in ("Page", "Runtime", "Log"):
            self.ask(f"{domain}.enable")
        yield self
        self._ask("Target.disposeBrowserContext", browserContextId=context)

    def ask(self, method: str, **parameters: object) -> Answer:
        """Send the DevTools command `method` with `parameters` to the page; return its answer."""
        return self._ask(method, self._session, **parameters)

    def look(self, width: int, height: int, theme: Literal["light", "dark"] = "light") -> None:
        """Set the size of the window, pixels, and the preferred theme."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.ask("Emulation.setDeviceMetricsOverride", **size)
        feature = {"name": "prefers-color-scheme", "value": theme}
        self.ask("Emulation.setEmulatedMedia", features=[feature])

    def go(self, address: str) -> None:
        """Open the page at `address`, without waiting for it."""
        self.ask("Page.navigate", url=address)

    def value(self, expression: str) -> Any:  # noqa: ANN401
        """Return the value of a script in the page; None if it fails."""
        answer = self.ask("Runtime.evaluate", expression=expression, returnByValue=True)
        return answer["result"].get("value")

    def wait_for(self, expression: str, patience_s: float = PATIENCE_S) -> None:
        """Wait until the script `expression` is true; fail after `patience_s`."""
        deadline_s = time.monotonic() + patience_s
        while not self.value(expression):
            text = self.value("document.body.innerText")
            assert time.monotonic() < deadline_s, f"not true: {expression}\n{text}"
            time.sleep(0.05)

    def _ask(self, method: str, session: str | None = None, **parameters: object) -> Answer:
        number = self._send(method, parameters, session)
        while True:
            message = self._next()
            if message.get("id") == number:
                assert "error" not in message, f"{method}: {message['error']}"
                return dict(message["result"])
            self._note(message)

    def _send(self, method: str, parameters: object, session: str | None = None) -> int:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        os.write(self._tell, json.dumps(message).encode() + b"\0")
        return self._number

    def _next(self) -> Answer:
        while b"\0" not in self._buffer:
            part = os.read(self._hear, 1 << 16)
            assert part, "the browser has gone"
            self._buffer += part
        message, _, self._buffer = self._buffer.partition(b"\0")
        return dict(json.loads(message))

    def _note(self, message: Answer) -> None:
        details = message.get("params", {})
        if message.get("method") == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(details["exceptionDetails"])[:500])
        if message.get("method") == "Log.entryAdded" and details["entry"]["level"] == "error":
            self.complaints.append(details["entry"]["text"])


def see(browser: Browser, tone: str, *more: str) -> None:
    """Wait until the first hand has `tone`, and all scripts in `more` are true at that moment.

    Scripts that are asked one after the other may see silence: a busy computer stands still.
    """
    browser.wait_for(" && ".join([f"{BANNER}.dataset.tone == '{tone}'", *(f"({m})" for m in more)]))


def says(element: str, part: str) -> str:
    """Return a script: does the text of the first element of the class `element` contain `part`?"""
    return f"document.querySelector('.{element}').innerText.includes({json.dumps(part)})"


def reads(element: str, whole: str) -> str:
    """Return a script: is `whole` the text of the first element of the class `element`?"""
    return f"document.querySelector('.{element}').innerText == {json.dumps(whole)}"


def text(browser: Browser, element: str) -> str:
    """Return the text of the first element of the class `element`."""
    return str(browser.value(f"document.querySelector('.{element}').innerText"))


def show(browser: Browser, page: Page, talker: Talker, decision: Decision) -> None:
    """Open the page of a daemon that says `decision`, and wait until it is shown."""
    talker.decision = decision
    browser.look(1280, 800)
    browser.go(page.address)
    see(browser, decision.value)
