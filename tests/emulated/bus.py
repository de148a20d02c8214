"""What is on the sensors' bus, read from its recorded edges: transactions, sweeps, their times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from tests.emulated.board import SELECT, Events


@dataclass
class Transaction:
    """From chip select low to high; times in emulated ns."""

    sensors: int
    """Mask of those whose chip select was low."""
    low_ns: float
    high_ns: float = float("inf")
    byte_ns: list[float] = field(default_factory=list)
    """When the first bit of each byte was clocked."""
    hz: list[int] = field(default_factory=list)
    """Clock of each byte."""
    mosi: bytes = b""

    @property
    def is_command(self) -> bool:
        """Whether it tells sensors to sample."""
        return len(self.mosi) == 2 and self.mosi[0] & 0x80 != 0


def transactions(events: Events) -> list[Transaction]:
    """Whole transactions, in order; pins that change at the same time are one edge."""
    selects = events["kind"] == SELECT
    same = selects[:-1] & selects[1:] & (events["t_ns"][:-1] == events["t_ns"][1:])
    found: list[Transaction] = []
    open_: Transaction | None = None
    for event in events[~np.append(same, False)]:
        t_ns = float(event["t_ns"])
        if event["kind"] == SELECT:
            if open_ is not None:
                open_.high_ns = t_ns
                found.append(open_)
            open_ = Transaction(int(event["value"]), t_ns) if event["value"] else None
        elif open_ is not None:
            open_.byte_ns.append(t_ns)
            open_.hz.append(int(event["hz"]))
            open_.mosi += bytes([event["value"]])
    return found


def sweeps(found: Sequence[Transaction], slots: int, sensors: int) -> list[list[Transaction]]:
    """The transactions of each whole sweep; a slot is a command and an answer of each sensor."""
    starts = [at for at, one in enumerate(found) if one.is_command]
    size = slots * (1 + sensors)
    first = [starts[n] for n in range(0, len(starts) - slots + 1, slots)]
    return [list(found[at : at + size]) for at in first if at + size <= len(found)]


@dataclass(frozen=True)
class Timing:
    """Figures of recorded sweeps, from the bus alone."""

    spi_hz: int
    settle_us: float
    """Shortest time from the end of a command to the chip select of an answer."""
    gap_us: float
    """Shortest time from the end of an answer to the next chip select."""
    duration_us: tuple[float, float]
    """Shortest and longest sweep, from the first chip select to the last."""
    late_us: float
    """Most that a sweep began later on the grid of periods than another."""


def timing(whole: Sequence[Sequence[Transaction]], period_us: float) -> Timing:
    """Figures of sweeps in a row."""
    settles: list[float] = []
    gaps: list[float] = []
    for sweep in whole:
        for before, after in pairwise(sweep):
            (settles if before.is_command else gaps).append(after.low_ns - before.high_ns)
    durations = [sweep[-1].high_ns - sweep[0].low_ns for sweep in whole]
    starts = np.array([sweep[0].low_ns for sweep in whole]) / 1e3
    grid = starts - period_us * np.arange(len(starts))
    return Timing(
        spi_hz=max(max(one.hz) for sweep in whole for one in sweep),
        settle_us=min(settles) / 1e3,
        gap_us=min(gaps) / 1e3,
        duration_us=(min(durations) / 1e3, max(durations) / 1e3),
        late_us=float(np.ptp(grid)),
    )
