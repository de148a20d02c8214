"""Stand-ins for the parts around the judge, and sound readings to feed it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import Finger
from graspd.daemon.judge.decision import HandLimits, Limits
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.trust.lift_book import GraspId, LiftBook
from graspd.daemon.trust.trust import Trust
from graspd.drivers.base import DriverCounters, DriverError, Fact, Reading, TactileReading
from graspd.models.contract import (
    Dataset,
    ImageInput,
    MeasuredError,
    ModelContract,
    ModelError,
    SeenCounts,
)
from graspd.models.runtime import TactileModel
from graspd.models.tactile_image import TactileImager
from tests.kit.clock import Clock as Clock

FINGERS: tuple[Finger, ...] = ("ff", "mf", "th")
MS = 1_000_000
LOW, HIGH, MARGIN = 1000, 3000, 250


WIDE = 1e-6
"""Inverse of a spread so large that no count is far from any other."""


def seen_box(fingers: int) -> SeenCounts:
    """Limits by which all counts from `LOW` to `HIGH` were seen, in any combination."""
    return SeenCounts(
        low=((LOW,) * 24,) * fingers,
        high=((HIGH,) * 24,) * fingers,
        margin=MARGIN,
        centre=((2000.0,) * 24,) * fingers,
        whitening=tuple((0.0,) * row + (WIDE,) for row in range(24 * fingers)),
        distance_max=1.0,
    )


def contract(fingers: tuple[Finger, ...] = FINGERS) -> ModelContract:
    return ModelContract(
        version=2,
        name="fake",
        input=ImageInput("D1", "neighbour-mean", "filled-image", "channels"),
        fingers=fingers,
        classes=("stable", "slip"),
        seed=0,
        datasets=(Dataset("none", "0" * 64, 1),),
        measured=(MeasuredError("cv", 10, 0.9, 0.01, 0.9, 0.01),),
        confidence=(),
        seen=seen_box(len(fingers)),
    )


class FakeModel:
    """A model that answers `p_slip`, or raises `ModelError` if the test gives an exception."""

    def __init__(self, p_slip: float | Exception = 0.1) -> None:
        self.answer = p_slip
        self.path = Path("fake.onnx")
        self.sha256 = "0123456789abcdef" * 4
        self.contract = contract()
        self.inputs = TactileImager(3)
        self.input = np.zeros(self.inputs.shape, dtype=np.float32)
        self.runs = 0

    def run(self) -> tuple[float, float]:
        self.runs += 1
        if isinstance(self.answer, Exception):
            raise ModelError("broken") from self.answer
        return 1.0 - self.answer, self.answer


NO_LIFT = GraspId("", 0), LiftBook()
"""Fields `grasp` and `lifts` of a `PublishedVerdict` that is on no grasp."""


def pipeline(
    model: FakeModel,
    clock: Clock,
    fingers: Sequence[str] = FINGERS,
    *,
    hand: HandLimits | None = None,
    trust: Trust | None = None,
    **limits: float,
) -> Pipeline:
    return Pipeline(
        cast(TactileModel, model),
        cast(Sequence[Finger], fingers),
        Limits(
            max_age_ns=int(limits.get("max_age_ns", 100 * MS)),
            slip_threshold=limits.get("slip_threshold", 0.5),
            min_confidence=limits.get("min_confidence", 0.0),
        ),
        clock,
        hand=hand,
        trust=trust,
    )


def reading(t_ns: int, seed: int = 0, seq: int = 0) -> TactileReading:
    """A sound reading: counts within what the fake model has seen."""
    return sound(np.random.default_rng(seed).integers(LOW, HIGH, (3, 24)), t_ns, seq)


def sound(counts: NDArray[np.generic], t_ns: int = 0, seq: int = 0) -> TactileReading:
    """A reading of these counts, shape (fingers, 24), of which no electrode is flagged."""
    faults = np.zeros(counts.shape, dtype=np.uint8)
    return TactileReading(t_ns, seq, counts.astype(np.uint16), faults)


class FakeDriver:
    """Hands over what the test has queued, one reading per call; raises queued errors.

    `known`: serial numbers of the sensors by finger.
    """

    name = "fake"
    live = False
    period_ns: int | None = 10 * MS

    def __init__(self, readings: Sequence[Reading | DriverError], clock: Clock) -> None:
        self.queue = list(readings)
        self.counters = DriverCounters()
        self.clock = clock
        self.ends = True
        self.is_open = False
        self.known: dict[str, str] = {}

    @property
    def exhausted(self) -> bool:
        return self.ends and not self.queue

    @property
    def serials(self) -> dict[str, str]:
        return self.known

    def describe(self) -> dict[str, Fact]:
        return {"made": Fact("by the test")}

    def open(self) -> None:
        self.is_open = True

    def close(self) -> None:
        self.is_open = False

    def fileno(self) -> int | None:
        return None

    def due_ns(self) -> int | None:
        return self.clock() if self.queue else None

    def read_ready(self) -> Sequence[Reading]:
        if not self.queue:
            return []
        item = self.queue.pop(0)
        if isinstance(item, DriverError):
            raise item
        self.counters.readings += 1
        return [item]
