"""Size and timing of the firmware on the emulated chip; the README of the bridge has some figures.

`python -m tests.emulated.figures` prints it.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Final

from tests.emulated.board import Board, sweeps, timing, transactions
from tests.emulated.build import CLOCKS_MHZ, Sequence, flash_and_ram, image

SECONDS = 2
"""In which STATUS is sent twice."""
OTHERS: Final[tuple[tuple[int, int, Sequence, int], ...]] = (
    (125, 1, "all", 28),
    (125, 5, "interleaved", 54),
)
"""Clock, sensors, sequence and its slots, beside three sensors and 24 electrodes."""
HEAD = """\
| clock | sensors, samples | flash | RAM | SPI | longest sweep | start jitter | settle | gap |
|---|---|---|---|---|---|---|---|---|
"""


def row(clock_mhz: int, sensors: int, sequence: Sequence, slots: int) -> str:
    """Figures of one image, as a row of the table."""
    file = image(sensors, clock_mhz, sequence)
    flash, ram = flash_and_ram(file)
    with Board() as board, tempfile.TemporaryDirectory() as folder:
        board.power(file)
        board.hello()
        board.start()
        with board.recording(Path(folder)) as events:
            board.run(1000.0 * SECONDS)
    found = timing(sweeps(transactions(events()), slots, sensors), 10_000.0)
    columns = (
        f"{clock_mhz} MHz",
        f"{sensors}, {slots}",
        f"{flash / 1e3:.1f} kB",
        f"{ram / 1e3:.1f} kB",
        f"{found.spi_hz / 1e6:.2f} MHz",
        f"{found.duration_us[1]:.0f} us",
        f"{found.late_us:.1f} us",
        f"{found.settle_us:.2f} us",
        f"{found.gap_us:.2f} us",
    )
    return f"| {' | '.join(columns)} |\n"


def main() -> None:
    """Print the table."""
    sys.stdout.write(HEAD)
    for clock_mhz in CLOCKS_MHZ:
        sys.stdout.write(row(clock_mhz, 3, "electrodes", 24))
    for other in OTHERS:
        sys.stdout.write(row(*other))


if __name__ == "__main__":
    main()
