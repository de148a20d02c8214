"""Count how fast recordings are replayed, in readings per second of processor time.

    python -m tests.bench.replay [RECORDING...]

replays each recording, without any the demo's day (a table) and the demo's stream, and prints the
processor time of `graspd replay` less that of a start.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from graspd.drivers.recordings.csv_player import DEMO_DAY, DEMO_RECORDING

GRASPD = str(Path(sys.executable).with_name("graspd"))


def replay(arguments: Sequence[str]) -> tuple[float, str]:
    """Return the processor time of `graspd replay`, s, and what it writes to stderr."""
    command = [GRASPD, "replay", *arguments]
    before = os.times()
    done = subprocess.run(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False
    )
    after = os.times()
    took_s = after.children_user + after.children_system
    return took_s - before.children_user - before.children_system, done.stderr


def main(recordings: Sequence[str]) -> None:
    """Print a line for each recording."""
    start_s, _ = replay(["--help"])
    for recording in recordings:
        took_s = replay([recording])[0] - start_s
        alone_s, text = replay([recording, "--json"])
        summary = json.loads(text.splitlines()[-1])
        of_stream = summary["gated"]
        readings = of_stream["readings"] if of_stream else sum(summary["verdicts"].values())
        alone_s -= start_s
        sys.stdout.write(
            f"{recording}: {readings} readings, {took_s:.2f} s; verdicts alone, as JSON, "
            f"{alone_s:.2f} s, {readings / alone_s:,.0f} readings/s\n"
        )


if __name__ == "__main__":
    main(sys.argv[1:] or [str(DEMO_DAY), str(DEMO_RECORDING)])
