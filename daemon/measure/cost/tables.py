"""What scenes cost: starts `footprint` for each, and puts what it found into tables."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec

from daemon.process.text import markdown_table, printable

TIMEOUT_S = 120.0
"""A scene takes a second; on a very busy machine a few."""
MESSAGE_MAX = 320
"""Characters of what went wrong that are shown."""
KIB_PER_MIB = 1024


class Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What one part of a scene adds to the process."""

    name: str
    modules: int
    rss_kib: int
    """Resident memory, KiB."""
    threads: int
    descriptors: int
    wall_ms: float
    cpu_ms: float


class Whole(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the process is once it has judged."""

    modules: int
    rss_kib: int
    threads: int
    descriptors: int
    peak_kib: int
    """Largest resident memory so far, KiB."""


class Quantiles(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """CPU time of one thing done `number` times, us."""

    number: int
    p50_us: float
    p99_us: float


class Timed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """CPU time per reading, none where there was no reading of the kind."""

    reading: Quantiles | None = None
    """Of all readings, from counts to judgement."""
    judged: Quantiles | None = None
    """Of those whose grasp was judged, so that the network ran."""
    report: Quantiles | None = None
    """From judgement to message sent."""


class Footprint(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What one scene costs. Drivers of hardware are constructed and not opened."""

    parts: tuple[Part, ...]
    """In the order in which they come; what parts share is counted with the first of them."""
    whole: Whole
    modules: tuple[str, ...]
    """Names of all that are imported."""
    timed: Timed
    left_out: tuple[Part, ...]
    """What the code alone of parts that the scene does not import would add, one after another."""

    @property
    def packages(self) -> list[str]:
        """Top-level packages that are imported."""
        return sorted({name.partition(".")[0] for name in self.modules})

    @property
    def rise_kib(self) -> int:
        """Resident memory, KiB, over that of the interpreter."""
        return self.whole.rss_kib - self.parts[0].rss_kib

    @property
    def start_wall_ms(self) -> float:
        """From the start of the process to the first reading judged and reported."""
        return sum(part.wall_ms for part in self._start())

    @property
    def start_cpu_ms(self) -> float:
        """The same in CPU time, of all threads."""
        return sum(part.cpu_ms for part in self._start())

    def _start(self) -> Iterator[Part]:
        return (part for part in self.parts if part.name != "readings")


class CostError(Exception):
    """The scene could not be measured; the message says why."""


def measure(scene: Path) -> Footprint:
    """Run the scene's parts in a process of their own. Raises `CostError`.

    Takes about a second. Nothing is published, and no device or kept session is touched.
    """
    with tempfile.TemporaryDirectory(prefix="graspd-") as folder:
        # -P, so that the files in the folder at hand are not taken for modules.
        command = [sys.executable, "-P", "-m", "daemon.measure.cost.footprint", str(scene), folder]
        try:
            result = subprocess.run(
                [*command, str(time.monotonic_ns())],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=TIMEOUT_S,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise CostError(f"{scene}: cannot be measured: {error}") from error
    if result.returncode != 0:
        why = result.stderr.strip().removeprefix("graspd: ")[-MESSAGE_MAX:]
        raise CostError(f"{scene}: cannot be measured: {why or result.returncode}")
    try:
        return msgspec.json.decode(result.stdout, type=Footprint)
    except msgspec.DecodeError as error:
        raise CostError(f"{scene}: cannot be measured: {error}") from error


def lines(found: Footprint) -> Iterator[str]:
    """The cost of one scene, part by part, for people."""
    heads = ("modules", "MiB", "threads", "descr.", "wall ms", "CPU ms")
    yield f"  {'cost':16}" + "".join(f"{head:>9}" for head in heads)
    for part in found.parts:
        yield _line(part.name, part)
    whole = found.whole
    yield (
        f"  {'all':16}{whole.modules:9}{whole.rss_kib / KIB_PER_MIB:9.1f}{whole.threads:9}"
        f"{whole.descriptors:9}"
    )
    yield (
        f"  to the first reading judged: {found.start_wall_ms:.0f} ms, "
        f"{found.start_cpu_ms:.0f} ms of CPU time; at most {whole.peak_kib / KIB_PER_MIB:.1f} MiB"
    )
    for name, quantiles in (
        ("reading", found.timed.reading),
        ("of them judged", found.timed.judged),
        ("reporting", found.timed.report),
    ):
        if quantiles is not None:
            yield (
                f"  {name}: p50 {quantiles.p50_us:.0f} us, p99 {quantiles.p99_us:.0f} us of CPU "
                f"time ({quantiles.number})"
            )
    yield "  left out, what its code would add on top"
    for part in found.left_out:
        yield _line(part.name, part)


def _line(name: str, part: Part) -> str:
    return (
        f"  {name:16}{part.modules:9}{part.rss_kib / KIB_PER_MIB:9.1f}{part.threads:9}"
        f"{part.descriptors:9}{part.wall_ms:9.1f}{part.cpu_ms:9.1f}"
    )


TITLES = (
    "Scene",
    "Modules",
    "Memory, MiB (over Python's own)",
    "Threads",
    "Descriptors",
    "Start, ms (CPU)",
    "Per reading, us p50 / p99",
    "Judged, us p50",
)


def markdown(found: Sequence[tuple[Path, Footprint]]) -> Iterator[str]:
    """One table of several scenes, a row each."""
    rows = [_cells(printable(path.stem), footprint) for path, footprint in found]
    return markdown_table(TITLES, rows, right=TITLES[1:])


def _cells(name: str, found: Footprint) -> Sequence[str]:
    whole, timed = found.whole, found.timed
    return (
        name,
        str(whole.modules),
        f"{whole.rss_kib / KIB_PER_MIB:.1f} ({found.rise_kib / KIB_PER_MIB:.1f})",
        str(whole.threads),
        str(whole.descriptors),
        f"{found.start_wall_ms:.0f} ({found.start_cpu_ms:.0f})",
        _both(timed.reading),
        _median(timed.judged),
    )


def _both(quantiles: Quantiles | None) -> str:
    return "-" if quantiles is None else f"{quantiles.p50_us:.0f} / {quantiles.p99_us:.0f}"


def _median(quantiles: Quantiles | None) -> str:
    return "-" if quantiles is None else f"{quantiles.p50_us:.0f}"
