"""Count what a reading costs, in instructions and cache lines: figures that no load changes.

    python -m tests.bench.count [--log FILE]

prints the medians of judged and of idle readings, from the bytes of a serial line to the message.
Callgrind counts a round of the loop in a replay of a link log. Its caches are empty at the start
of each counted round, so each line (64 bytes) that is used is fetched once. Needs valgrind and a C
compiler. The figures depend on the Python that runs this: Debian's, for one, is built with PGO.
"""

from __future__ import annotations

import argparse
import ctypes
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from daemon import cli
from daemon.run.loop import Loop
from models.runtime import TactileModel
from tests.process_replay import streams

EVERY: Final = 97
"""One round in this many is counted, mostly idle ones: a counted one takes seconds."""
AFTER: Final = 10
"""Rounds after a judged one that are counted: a held grasp is judged again within 100 ms."""
COUNTED: Final = 60
"""Rounds that are counted."""
SWITCH: Final = """
#include <valgrind/callgrind.h>
void begin(void) { CALLGRIND_START_INSTRUMENTATION; }
void end(const char *kind) { CALLGRIND_STOP_INSTRUMENTATION; CALLGRIND_DUMP_STATS_AT(kind); }
"""
SCENE: Final = """
[tactile]
driver = "spi"
sensors = ["mf", "th", "ff"]
port = "/dev/replayed"
"""
CALLGRIND: Final = ("valgrind", "--tool=callgrind", "--cache-sim=yes", "--instr-atstart=no")
CACHES: Final = ("--I1=32768,8,64", "--D1=32768,8,64", "--LL=33554432,16,64")
"""The last one is so large that no line is fetched twice."""


def calls_of(kind: type, name: str) -> Callable[[], int]:
    """Count the calls of a method from now on; the function returned says how many there were."""
    method, calls = getattr(kind, name), 0

    def counted(*arguments: Any) -> Any:  # noqa: ANN401
        nonlocal calls
        calls += 1
        return method(*arguments)

    setattr(kind, name, counted)
    return lambda: calls


def count(switch: Path, log: Path) -> None:
    """Replay a log, and have callgrind count some rounds of the loop; runs within valgrind."""
    valgrind, go_round = ctypes.CDLL(str(switch)), Loop._go_round  # noqa: SLF001
    judged, readings = calls_of(TactileModel, "run"), calls_of(Loop, "_judge")
    rounds = counted = last = 0

    def counted_round(*arguments: Any) -> None:  # noqa: ANN401
        nonlocal rounds, counted, last
        rounds += 1
        before = readings(), judged()
        if rounds % EVERY and rounds > last:
            go_round(*arguments)
            if judged() > before[1]:
                last = rounds + AFTER
            return
        valgrind.begin()
        go_round(*arguments)
        kind = "judged" if judged() > before[1] else "idle"
        if kind == "judged":
            last = rounds + AFTER
        valgrind.end((kind if readings() == before[0] + 1 else "other").encode())
        counted += 1
        if counted == COUNTED:
            raise SystemExit

    setattr(Loop, "_go_round", counted_round)  # noqa: B010
    cli.main(["replay", "--json", "--scene", str(log.with_name("scene.toml")), str(log)])


def report(kind: str, dumps: Sequence[str]) -> None:
    """Print the medians of one kind of readings."""
    if not dumps:
        sys.stdout.write(f"{kind}: none counted\n")
        return
    instructions, lines = [], []
    for dump in dumps:
        names = re.findall(r"^events: (.*)$", dump, re.M)[0].split()
        totals = map(int, re.findall(r"^totals: (.*)$", dump, re.M)[0].split())
        counts = dict(zip(names, totals, strict=False))
        instructions.append(counts["Ir"])
        lines.append(counts["ILmr"] + counts["DLmr"] + counts["DLmw"])
    sys.stdout.write(
        f"{kind}: {statistics.median(instructions):,.0f} instructions, "
        f"{statistics.median(lines):,.0f} lines; median of {len(dumps)} readings\n"
    )


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.count", description=__doc__)
    parser.add_argument("--log", type=Path, help="serial link log, such as of another version")
    parser.add_argument("--switch", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.switch is not None:
        count(given.switch, given.log)
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "switch.c").write_text(SWITCH)
        (folder / "scene.toml").write_text(SCENE)
        if given.log is None:
            with (folder / "link.serial").open("wb") as file:
                deque(streams.spi(file), maxlen=0)
        else:
            shutil.copy(given.log, folder / "link.serial")
        subprocess.run(
            ["cc", "-shared", "-fPIC", folder / "switch.c", "-o", folder / "switch.so"], check=True
        )
        options = (*CALLGRIND, *CACHES, f"--callgrind-out-file={folder}/counts")
        inside = (sys.executable, "-m", "tests.bench.count", "--switch", folder / "switch.so")
        replayed = ("--log", folder / "link.serial")
        subprocess.run([*options, *inside, *replayed], stdout=subprocess.DEVNULL, check=True)
        dumps = [path.read_text() for path in folder.glob("counts.*")]
    for kind in ("judged", "idle"):
        report(kind, [dump for dump in dumps if f"Client Request: {kind}\n" in dump])


if __name__ == "__main__":
    main()
