"""Hands the messages of each feed to its view, and takes snapshots at a steady rate."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from daemon.process.sleep import boottime_ns
from daemon.watch.feed import Feed
from daemon.watch.snapshot import Snapshot
from daemon.watch.view import SNAPSHOTS_HZ, View

TICK_S = 0.02
"""Time between two looks at the feeds, s; silence is timed this exactly."""


class HandFeed(NamedTuple):
    """The messages of one hand, and the view that takes them."""

    feed: Feed
    view: View


def snapshots(hands: Sequence[HandFeed], is_over: Callable[[], bool]) -> Iterator[list[Snapshot]]:
    """Yield a snapshot of each hand ten times a second until `is_over()`, which waits `TICK_S`."""
    due_s = 0.0
    while not is_over():
        for feed, view in hands:
            for topic, payload in feed.take():
                view.take(topic, payload, feed.empty_ns)  # what has waited is old
            view.link = feed.link
        if time.monotonic() >= due_s:
            due_s = max(due_s + 1 / SNAPSHOTS_HZ, time.monotonic() + TICK_S)
            yield [view.snapshot(boottime_ns()) for _, view in hands]
