"""Threads of a test or an attack that end with their block."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def at_work(*tasks: Callable[[threading.Event], object]) -> Iterator[threading.Event]:
    """Run each of `tasks` in a thread; yield the event with which they are called.

    At the block's end it is set, and the threads are joined.
    """
    stop = threading.Event()
    threads = [threading.Thread(target=task, args=(stop,)) for task in tasks]
    for thread in threads:
        thread.start()
    try:
        yield stop
    finally:
        stop.set()
        for thread in threads:
            thread.join()
