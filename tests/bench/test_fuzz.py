"""Every parser against damaged frames, and the harness against parsers that break a promise."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from graspd.drivers.spi.messages import DELIMITER, FrameParser, encode_frame
from tests.bench.fuzz import FRAMES, FuzzError, Target, fuzz
from tests.drivers.palm.fuzz_palm import PALM
from tests.drivers.spi.fuzz_bridge import FRAMING


@pytest.mark.parametrize("target", [FRAMING, PALM])
def test_a_parser_keeps_its_promises_whatever_it_is_fed(target: Target) -> None:
    seed = random.SystemRandom().randrange(1 << 31)
    assert 0 < fuzz(target, FRAMES, seed) < FRAMES / 2


class Faulty(FrameParser):
    """A parser that breaks one promise."""

    def __init__(self, fault: str) -> None:
        super().__init__()
        self._fault = fault
        self._fed = 0

    def feed(self, chunk: bytes) -> list[tuple[int, bytes]]:
        self._fed += len(chunk)
        before = self.counters.bad_crc
        frames = super().feed(chunk)
        if self.counters.bad_crc > before:
            if self._fault == "raises":
                raise IndexError("out of range")
            if self._fault == "invents":
                return [*frames, (1, b"invented")]
            if self._fault == "loses":
                self._is_overlong = True
        return frames

    @property
    def held_bytes(self) -> int:
        return self._fed if self._fault == "hoards" else super().held_bytes


def frame(rng: random.Random) -> tuple[bytes, tuple[int, bytes]]:
    payload = rng.randbytes(rng.randint(0, 40))
    return encode_frame(7, payload), (7, payload)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("raises", "IndexError"),
        ("invents", "became"),
        ("loses", "the good frame"),
        ("hoards", "held back"),
    ],
)
def test_a_parser_that_breaks_a_promise_is_caught_with_its_seed(fault: str, message: str) -> None:
    def target(parser: Callable[[], FrameParser]) -> Target:
        return Target("faulty", frame, parser, 1024, DELIMITER)

    fuzz(target(FrameParser), 2000, seed=5)
    with pytest.raises(FuzzError, match=f"faulty, seed 5, round .*{message}"):
        fuzz(target(lambda: Faulty(fault)), 2000, seed=5)
