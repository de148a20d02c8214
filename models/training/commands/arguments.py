"""What the command lines of the training half share: whole numbers, and a bar of progress."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


def whole(low: int, high: int) -> Callable[[str], int]:
    """Takes whole numbers from `low` to `high`, ten digits at most; for `argparse`."""

    def parse(text: str) -> int:
        if text.isascii() and text.isdigit() and len(text) <= 10 and low <= int(text) <= high:
            return int(text)
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {low} to {high}")

    return parse


@contextmanager
def progress_bar(first: str, total: int, *, hidden: bool) -> Iterator[Callable[[str], None]]:
    """Shows how many of `total` trainings are done, on standard error if that is a terminal.

    Call what it yields after each training, with the text that is to stand in front of the bar;
    until then that is `first`.
    """
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("trainings, left"),
        TimeRemainingColumn(),
    )
    with Progress(
        *columns, console=console, disable=hidden or not console.is_terminal, transient=True
    ) as bar:
        task = bar.add_task(first, total=total)
        yield lambda name: bar.update(task, advance=1, description=name)
