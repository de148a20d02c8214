"""Fixtures: the page's server, a publisher of messages for it, and the browser."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.daemon.watch.browser import Browser, Page
from tests.daemon.watch.watch_fakes import Talker


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return f"ipc://{tmp_path}/v"


@pytest.fixture
def page(endpoint: str) -> Iterator[Page]:
    made = Page(endpoint)
    made.start()
    yield made
    made.stop()


@pytest.fixture
def talker(endpoint: str) -> Iterator[Talker]:
    with Talker(endpoint) as made:
        yield made


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile")) as made:
        yield made


@pytest.fixture
def browser(chromium: Browser) -> Iterator[Browser]:
    with chromium.blank() as made:
        yield made
        assert made.complaints == []
