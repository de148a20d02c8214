"""The state of a link: patience that grows, and a journal that does not fill."""

from __future__ import annotations

import logging

import pytest

from graspd.drivers.base import LinkCause
from graspd.drivers.link import Link, LinkState
from tests.kit.clock import Clock


def test_patience_grows_up_to_a_second_and_begins_anew_when_the_link_is_up() -> None:
    clock = Clock()
    link = Link("spi")
    link.start(clock.now_ns)
    assert link.retry_ns == clock.now_ns
    waits_s = []
    for _ in range(2000):  # half an hour
        link.failed(LinkCause.UNKNOWN, "not there", clock.now_ns)
        assert link.retry_ns is not None
        waits_s.append((link.retry_ns - clock.now_ns) / 1e9)
        assert not link.is_due(link.retry_ns - 1)
        clock.now_ns = link.retry_ns
        assert link.is_due(clock.now_ns)
        assert link.is_due(clock.now_ns + 1)
    # From 50 ms on, each 1.8 times the one before.
    first_s = [0.05, 0.09, 0.162, 0.2916, 0.52488, 0.944784, 1.0]
    assert waits_s == pytest.approx(first_s + [1.0] * (2000 - 7))
    link.greeting()
    assert link.is_due(0), "nothing to wait for"
    link.up("a device", clock.now_ns)
    link.failed(LinkCause.UNKNOWN, "gone", clock.now_ns)
    assert link.retry_ns == clock.now_ns + 50_000_000


def test_the_journal_says_how_long_a_link_was_down(caplog: pytest.LogCaptureFixture) -> None:
    link = Link("spi")
    with caplog.at_level(logging.INFO):
        link.start(2_000_000_000)
        link.up("a device", 5_250_000_000)
        link.failed(LinkCause.UNKNOWN, "gone", 8_000_000_000)
        link.failed(LinkCause.UNKNOWN, "not there", 8_100_000_000)
        link.up("a device", 9_000_000_000)
    assert [r.getMessage() for r in caplog.records if r.levelname == "INFO"] == [
        "spi: up after 3.25 s: a device",
        "spi: up after 1.00 s: a device",
    ]


def test_only_a_link_that_was_up_is_lost() -> None:
    link = Link("spi")
    link.start(0)
    link.failed(LinkCause.UNKNOWN, "not there", 0)
    link.greeting()
    link.failed(LinkCause.UNKNOWN, "no answer", 0)
    assert link.losses == 0
    link.greeting()
    link.up("a device", 0)
    assert (link.state, link.reason, link.retry_ns) == (LinkState.UP, None, None)
    link.failed(LinkCause.UNKNOWN, "gone", 0)
    assert link.losses == 1
    assert link.reason == "gone"
    link.close()
    assert (link.state, link.retry_ns) == (LinkState.CLOSED, None)


def test_a_reason_is_warned_of_once_per_outage(caplog: pytest.LogCaptureFixture) -> None:
    link = Link("spi")
    with caplog.at_level(logging.DEBUG):
        link.start(0)
        for _ in range(50):
            link.failed(LinkCause.UNKNOWN, "not there", 0)
            link.failed(LinkCause.UNKNOWN, "wrong version", 0)
        link.up("a device", 0)
        link.failed(LinkCause.UNKNOWN, "not there", 0)
    warnings = [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
    assert warnings == [
        "spi: not there; trying again",
        "spi: wrong version; trying again",
        "spi: not there; trying again",
    ]


def test_reasons_that_never_repeat_do_not_fill_the_journal(
    caplog: pytest.LogCaptureFixture,
) -> None:
    link = Link("spi")
    link.start(0)
    with caplog.at_level(logging.WARNING):
        for number in range(1000):
            link.failed(LinkCause.UNKNOWN, f"reason {number}", 0)
    assert len(caplog.records) == 8
