"""What an attack is given, and what comes of it."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Plan:
    """What an attack is given."""

    seconds: float
    """How long it shall go on, s; a round that has begun is ended. It does one at least."""
    random: random.Random
    """For all that it draws."""
    folder: Path
    """For its files and sockets; removed afterwards."""

    def rounds(self) -> Iterator[int]:
        """0, 1, 2 ... until the time is over."""
        end_s = time.monotonic() + self.seconds
        tried = 0
        while tried == 0 or time.monotonic() < end_s:
            yield tried
            tried += 1

    def folders(self) -> Iterator[Path]:
        """A new folder for each round."""
        for number in self.rounds():
            folder = self.folder / str(number)
            folder.mkdir()
            yield folder


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of it."""

    tried: int
    """How often: readings, connections, bytes or what else the attack counts."""
    happened: str
    """In plain words with figures, such as "0 of 995 verdicts `stable`"."""
    held: bool
    """Whether graspd did what it must."""
