"""Kill a recording daemon at random times, and see how much of each recording is lost.

    python -m tests.bench.kill_recorder [--kills 50]

A subscriber notes what the daemon publishes until it is killed with SIGKILL. What it got and the
recording lacks was published within the last flush interval, or the recorder has lost too much.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import zmq

from graspd.drivers.recordings.csv_player import DEMO_RECORDING
from tests.daemon.processes import TIMEOUT_S, start, wait_for
from tests.daemon.record.recorded import messages
from tests.kit.messages import decode_verdict

FLUSH_MS: Final = 1000.0
"""The default of `[record] flush_ms`."""
LIFE_S: Final = (1.2, 4.0)
"""A daemon lives so long once it publishes."""


def kill_often(folder: Path, kills: int, seed: int) -> list[float]:
    """What each kill has cost, ms: from the last verdict that was kept to the last one published.

    Raises `RuntimeError` if a recording has a hole.
    """
    choose = random.Random(seed)
    losses_ms = []
    for number in range(kills):
        place = folder / str(number)
        place.mkdir()
        losses_ms.append(_kill_once(place, choose.uniform(*LIFE_S), seed))
    return losses_ms


def _kill_once(folder: Path, life_s: float, seed: int) -> float:
    scene = folder / "scene.toml"
    scene.write_text(
        f'[tactile]\ndriver = "replay"\nloop = true\nrecordings = ["{DEMO_RECORDING}"]\n'
        f'[publish]\nendpoint = "ipc://{folder}/graspd"\n[record]\ndirectory = "record"\n'
    )
    published: dict[int, float] = {}
    with start("run", scene) as daemon, zmq.Context() as context, context.socket(zmq.SUB) as heard:
        heard.connect(f"ipc://{folder}/graspd")
        heard.subscribe("verdict.")
        wait_for(folder / "graspd")
        deadline_s = time.monotonic() + life_s
        while time.monotonic() < deadline_s:
            _hear(heard, published, 20)
        daemon.kill()
        daemon.communicate(timeout=TIMEOUT_S)
        while _hear(heard, published, 100):
            pass
    return _lost_ms(folder, published, seed)


def _hear(heard: zmq.Socket[bytes], published: dict[int, float], wait_ms: int) -> bool:
    if not heard.poll(wait_ms):
        return False
    verdict = decode_verdict(heard.recv_multipart()[1])
    published[verdict.seq] = verdict.t
    return True


def _lost_ms(folder: Path, published: dict[int, float], seed: int) -> float:
    paths = sorted((folder / "record").glob("*.mcap"))
    found = [content for path in paths for kind, content in messages(path) if kind == "verdict"]
    numbers = [content["seq"] for content in found]
    if numbers != list(range(len(numbers))):
        raise RuntimeError(f"{folder}: the recording has a hole (seed {seed})")
    lost = [t for seq, t in published.items() if seq >= len(numbers)]
    if not lost:
        return 0.0
    # From the first that is lost: the one before it was kept.
    return (max(published.values()) - min(lost)) * 1e3


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what each kill has cost; 1 if one has cost more than the flush interval."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        try:
            losses_ms = kill_often(Path(folder), args.kills, args.seed)
        except (RuntimeError, OSError, subprocess.SubprocessError) as error:
            sys.stderr.write(f"{error}\n")
            return 1
    ordered = sorted(losses_ms)
    sys.stdout.write(
        f"{len(ordered)} kills, seed {args.seed}: median {ordered[len(ordered) // 2]:.0f} ms lost, "
        f"at most {ordered[-1]:.0f} ms of {FLUSH_MS:.0f} ms\n"
    )
    return int(ordered[-1] > FLUSH_MS)


if __name__ == "__main__":
    sys.exit(main())
