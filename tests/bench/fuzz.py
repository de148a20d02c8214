"""Damage frames in every way that a link can, and check what a parser makes of them.

Each round damages one frame, feeds it in pieces, and feeds a good frame after it. It checks that

- nothing is raised, and no more is held back than the parser promises,
- no damaged frame becomes a value that was not sent (where the protocol can tell), and every value
  that comes out is sound,
- the good frame after a delimiter is always found.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

FRAMES = 25_000
"""Rounds of a parser in a test run."""
GARBAGE_MAX_BYTES = 3_000
DAMAGES_MAX = 3


class Parser(Protocol):
    """A parser under test."""

    def feed(self, chunk: bytes) -> Sequence[Any]:
        """Return the values that these bytes complete."""

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
    """End of whatever came before, in a stream of bytes. None: each `feed` is one whole message."""
    detects_damage: bool = True
    """True: the protocol has a checksum, so that a damaged frame must never give a value."""
    is_sound: Callable[[Any], bool] = lambda value: True
    """True if a value may come out at all."""


class FuzzError(AssertionError):
    """A parser broke a promise; the message names seed and round."""


def fuzz(target: Target, frames: int = FRAMES, seed: int = 0) -> int:
    """Run rounds; return how many damaged frames gave their own value. Raises `FuzzError`.

    Damage may undo itself or miss a frame.
    """
    parser, rng, survived = target.parser(), random.Random(), 0
    for number in range(frames):
        rng.seed(seed << 32 | number)
        try:
            survived += _round(target, parser, rng)
        except Exception as error:
            raise FuzzError(f"{target.name}, seed {seed}, round {number}: {error!r}") from error
    return survived


def _round(target: Target, parser: Parser, rng: random.Random) -> bool:
    wire, value = target.frame(rng)
    other, other_value = target.frame(rng)
    damaged = wire
    for _ in range(rng.randint(1, DAMAGES_MAX)):
        damaged = _damage(rng, damaged, other)
    outcome = _feed(target, parser, rng, damaged + (target.delimiter or b""))
    for result in outcome:
        if not target.is_sound(result):
            raise FuzzError(f"{damaged.hex()} became {result!r}, which is not sound")
        if target.detects_damage and result not in (value, other_value):
            raise FuzzError(f"{damaged.hex()}, once {wire.hex()}, became {result!r}")
    good, expected = target.frame(rng)
    after = _feed(target, parser, rng, good)
    if after != [expected]:
        raise FuzzError(f"after {damaged.hex()} the good frame {good.hex()} became {after!r}")
    return value in outcome


def _feed(target: Target, parser: Parser, rng: random.Random, data: bytes) -> list[Any]:
    """Feed a stream in a few random pieces, a message whole."""
    cuts = [0, len(data)]
    if target.delimiter is not None and data:
        cuts = sorted([*cuts, *(rng.randrange(len(data)) for _ in range(rng.randrange(4)))])
    values: list[Any] = []
    for start, end in itertools.pairwise(cuts):
        values += parser.feed(data[start:end])
        if parser.held_bytes > target.held_max:
            raise FuzzError(f"{parser.held_bytes} held back, more than {target.held_max}")
    return values


def _damage(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """Return a frame with some bits or a random part of it changed; `other` is a good one."""
    if rng.random() < 0.1:
        damaged = bytearray(data)
        for _ in range(rng.randint(1, 8) if damaged else 0):
            damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        return bytes(damaged)
    start = rng.randint(0, len(data))
    longest = len(data) - start
    end = start + rng.randint(0, min(longest, 8) if rng.random() < 0.5 else longest)
    before, part, after = data[:start], data[start:end], data[end:]
    garbage = rng.randint(0, GARBAGE_MAX_BYTES if rng.random() < 0.05 else 64)
    return rng.choice(
        (
            before + after,
            part,
            before + rng.randbytes(rng.randint(1, 16)) + part + after,
            before + part * rng.randint(2, 4) + after,
            before + rng.randbytes(len(part)) + after,
            before + bytes(len(part)) + after,
            before + b"\xff" * len(part) + after,
            after + part + before,
            before + other[rng.randint(0, len(other)) :],
            rng.randbytes(garbage),
        )
    )
