"""Damages frames in every way that a link can, and checks what a parser makes of them.

`python -m tests.bench.fuzz framing --frames 1000000` runs one parser, `python -m tests.bench.fuzz`
all. Each round damages one frame, feeds it in pieces, and feeds a good frame after it. It checks
that

- nothing is raised, and no more is held back than the parser promises,
- no damaged frame becomes a value that was not sent (where the protocol can tell), and every value
  that comes out is sound,
- the good frame after a delimiter is always found.

A new parser joins with a `Target` in a module of its own and one line in `TARGETS`.
"""

from __future__ import annotations

import argparse
import importlib
import itertools
import random
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

TARGETS = {
    "framing": "tests.drivers.spi.fuzz_bridge:FRAMING",
    "palm": "tests.drivers.palm.fuzz_palm:PALM",
}
"""Name of each parser and where its `Target` is: module and attribute."""

FRAMES = 25_000
"""Rounds per parser in a test run."""
GARBAGE_MAX_BYTES = 3_000
DAMAGES_MAX = 3


class Parser(Protocol):
    """What is fuzzed."""

    def feed(self, chunk: bytes) -> Sequence[Any]:
        """Values that these bytes complete."""

    @property
    def held_bytes(self) -> int:
        """Bytes, or other things that grow, which are held back."""


@dataclass(frozen=True)
class Target:
    """A parser and what is known of its protocol."""

    name: str
    frame: Callable[[random.Random], tuple[bytes, Any]]
    """A random good frame as it is on the wire, and the value that it must give."""
    parser: Callable[[], Parser]
    held_max: int
    """Most that the parser may hold back."""
    delimiter: bytes | None = None
    """Ends whatever came before, in a stream of bytes. None: each `feed` is one whole message."""
    detects_damage: bool = True
    """Whether the protocol has a checksum, so that a damaged frame must never give a value."""
    is_sound: Callable[[Any], bool] = lambda value: True
    """Whether a value may come out at all."""


class FuzzError(AssertionError):
    """A parser broke a promise; the message says how to see it again."""


@dataclass
class Report:
    """What a run did."""

    frames: int = 0
    fed_bytes: int = 0
    survived: int = 0
    """Damaged frames that still gave their own value: damage that undid itself or missed them."""
    held_max: int = 0
    damages: Counter[str] = field(default_factory=Counter)


def load(name: str) -> Target:
    """The target of a name in `TARGETS`."""
    module, attribute = TARGETS[name].split(":")
    target = getattr(importlib.import_module(module), attribute)
    if not isinstance(target, Target):
        raise TypeError(f"{TARGETS[name]} is no Target")
    return target


def fuzz(target: Target, frames: int = FRAMES, seed: int = 0, first: int = 0) -> Report:
    """Run so many rounds from round `first` on. Raises `FuzzError`."""
    report = Report()
    parser = target.parser()
    rng = random.Random()
    for number in range(first, first + frames):
        rng.seed(seed << 32 | number)
        try:
            _round(target, parser, rng, report)
        except Exception as error:
            again = f"python -m tests.bench.fuzz {target.name} --seed {seed} --first {number}"
            again += " --frames 1"
            raise FuzzError(f"{error!r}\nagain: {again}") from error
    report.frames = frames
    return report


def _round(target: Target, parser: Parser, rng: random.Random, report: Report) -> None:
    wire, value = target.frame(rng)
    other, other_value = target.frame(rng)
    damaged = wire
    for _ in range(rng.randint(1, DAMAGES_MAX)):
        name, damage = rng.choice(DAMAGES)
        damaged = damage(rng, damaged, other)
        report.damages[name] += 1
    outcome = _feed(target, parser, rng, damaged + (target.delimiter or b""), report)
    for result in outcome:
        if not target.is_sound(result):
            raise FuzzError(f"{damaged.hex()} became {result!r}, which is not sound")
        if target.detects_damage and result not in (value, other_value):
            raise FuzzError(f"{damaged.hex()}, once {wire.hex()}, became {result!r}")
    report.survived += value in outcome
    good, expected = target.frame(rng)
    outcome = _feed(target, parser, rng, good, report)
    if list(outcome) != [expected]:
        raise FuzzError(f"after {damaged.hex()} the good frame {good.hex()} became {outcome!r}")


def _feed(
    target: Target, parser: Parser, rng: random.Random, data: bytes, report: Report
) -> list[Any]:
    """Feed a stream in a few random pieces, a message whole."""
    cuts = [0, len(data)]
    if target.delimiter is not None and data:
        cuts = sorted([*cuts, *(rng.randrange(len(data)) for _ in range(rng.randrange(4)))])
    values: list[Any] = []
    for start, end in itertools.pairwise(cuts):
        values += parser.feed(data[start:end])
        if parser.held_bytes > target.held_max:
            raise FuzzError(f"{parser.held_bytes} held back, more than {target.held_max}")
        report.held_max = max(report.held_max, parser.held_bytes)
    report.fed_bytes += len(data)
    return values


Damage = Callable[[random.Random, bytes, bytes], bytes]
"""Takes a frame and another good one, and gives what is left of the first."""


def _flip_bits(rng: random.Random, data: bytes, _: bytes) -> bytes:
    damaged = bytearray(data)
    for _flip in range(rng.randint(1, 8) if damaged else 0):
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
    return bytes(damaged)


def _cut(rng: random.Random, data: bytes, _: bytes) -> bytes:
    start, end = _span(rng, data)
    return data[:start] + data[end:]


def _keep(rng: random.Random, data: bytes, _: bytes) -> bytes:
    start, end = _span(rng, data)
    return data[start:end]


def _insert(rng: random.Random, data: bytes, _: bytes) -> bytes:
    at = rng.randint(0, len(data))
    return data[:at] + rng.randbytes(rng.randint(1, 16)) + data[at:]


def _repeat(rng: random.Random, data: bytes, _: bytes) -> bytes:
    start, end = _span(rng, data)
    return data[:end] + data[start:end] * rng.randint(1, 3) + data[end:]


def _overwrite(rng: random.Random, data: bytes, _: bytes) -> bytes:
    start, end = _span(rng, data)
    return data[:start] + rng.randbytes(end - start) + data[end:]


def _zeros(rng: random.Random, data: bytes, _: bytes) -> bytes:
    start, end = _span(rng, data)
    return data[:start] + bytes(end - start) + data[end:]


def _ones(rng: random.Random, data: bytes, _: bytes) -> bytes:
    start, end = _span(rng, data)
    return data[:start] + b"\xff" * (end - start) + data[end:]


def _swap(rng: random.Random, data: bytes, _: bytes) -> bytes:
    start, end = _span(rng, data)
    return data[end:] + data[start:end] + data[:start]


def _splice(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """The end of another frame in place of one's own."""
    at = rng.randint(1, max(len(data) - 1, 1))
    return data[:at] + other[rng.randint(1, max(len(other) - 1, 1)) :]


def _garbage(rng: random.Random, _: bytes, __: bytes) -> bytes:
    length = rng.randint(0, GARBAGE_MAX_BYTES if rng.random() < 0.05 else 64)
    return rng.randbytes(length)


def _span(rng: random.Random, data: bytes) -> tuple[int, int]:
    """A part of the data, often a small one."""
    start = rng.randint(0, len(data))
    longest = len(data) - start
    return start, start + rng.randint(0, min(longest, 8) if rng.random() < 0.5 else longest)


DAMAGES: list[tuple[str, Damage]] = [
    ("flip bits", _flip_bits),
    ("cut", _cut),
    ("keep a part", _keep),
    ("insert", _insert),
    ("repeat", _repeat),
    ("overwrite", _overwrite),
    ("zeros", _zeros),
    ("ones", _ones),
    ("swap", _swap),
    ("splice", _splice),
    ("garbage", _garbage),
]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the parsers that were asked for; 1 if one broke a promise."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.fuzz", description=__doc__)
    parser.add_argument("parser", nargs="*", choices=[[], *TARGETS], help="default: all")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--seed", type=int, default=None, help="default: a new one")
    parser.add_argument("--first", type=int, default=0, help="number of the first round")
    options = parser.parse_args(arguments)
    seed = random.SystemRandom().randrange(1 << 31) if options.seed is None else options.seed
    for name in options.parser or TARGETS:
        began_s = time.perf_counter()
        try:
            report = fuzz(load(name), options.frames, seed, options.first)
        except FuzzError as error:
            sys.stderr.write(f"{name}: {error}\n")
            return 1
        took_s = time.perf_counter() - began_s
        sys.stdout.write(
            f"{name}: {report.frames} frames damaged ({report.fed_bytes / 1e6:.1f} MB, seed {seed})"
            f" in {took_s:.1f} s; {report.survived} unharmed; at most {report.held_max} held back\n"
        )
    return 0


if __name__ == "__main__":
    # By its name, so that targets find the same `Target`.
    sys.exit(importlib.import_module("tests.bench.fuzz").main())
