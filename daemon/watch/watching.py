"""Hands the messages of a feed to a view, and takes snapshots of it at a steady rate."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from daemon.process.sleep import boottime_ns
from daemon.watch.feed import Feed
from daemon.watch.snapshot import Snapshot
from daemon.watch.view import SNAPSHOTS_HZ, View

TICK_S = 0.02
"""Between two looks at what has come: how exactly silence is timed, s."""


def snapshots(feed: Feed, view: View, is_over: Callable[[], bool]) -> Iterator[Snapshot]:
    """Yield a snapshot ten times a second until `is_over()` is true; it must wait `TICK_S` s."""
    due_s = 0.0
    while not is_over():
        for topic, payload in feed.take():
            view.take(topic, payload, feed.empty_ns)  # what has waited is old
        view.link = feed.link
        if time.monotonic() >= due_s:
            due_s = max(due_s + 1 / SNAPSHOTS_HZ, time.monotonic() + TICK_S)
            yield view.snapshot(boottime_ns())
