"""What a model has never seen: ranges and covariance against figures worked out by hand."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from graspd.models.contract import ModelContract, ModelError, SeenCounts, SessionInput, Sharpness
from graspd.models.electrodes import Electrodes
from tests.daemon.fakes import contract


def diagonal(size: int, value: float) -> tuple[tuple[float, ...], ...]:
    return tuple((0.0,) * row + (value,) for row in range(size))


def seen(spread: float = 1e-6, distance_max: float = 2.5) -> SeenCounts:
    row = ((2000,) * 24,) * 3
    centre = ((2000.0,) * 24,) * 3
    return SeenCounts(row, row, 250, centre, diagonal(72, spread), distance_max)


def session(**changes: object) -> dict[str, object]:
    sound = SessionInput((0.0,) * 78, (1.0,) * 78, 3.0, 1.0, 20.0, (Sharpness(0.0, 1.0),))
    return {"type": "session"} | msgspec.to_builtins(msgspec.structs.replace(sound, **changes))  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("count", "refused"), [(1750, False), (1749, True), (2250, False), (2251, True), (0, True)]
)
def test_a_count_beyond_the_margin_was_never_seen(count: int, refused: bool) -> None:
    counts = np.full((2, 3, 24), 2000, dtype=np.uint16)
    counts[1, 1, 11] = count
    assert Electrodes(seen()).never_seen(counts).tolist() == [False, refused]


@pytest.mark.parametrize(("off", "refused"), [(200, False), (201, True), (-201, True)])
def test_the_distance_is_the_root_mean_square_deviation(off: int, refused: bool) -> None:
    # All 72 electrodes `off` counts from the centre, one spread being 100 counts: distance 2.
    counts = np.full((1, 3, 24), 2000 + off, dtype=np.uint16)
    check = Electrodes(seen(spread=1 / 100, distance_max=2.0))
    assert check.never_seen(counts).tolist() == [refused]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"fingers": ("ff", "ff", "th")}, "not different ones"),
        ({"fingers": ("ff", "mf")}, "not \\(fingers, 24\\)"),
        ({"fingers": ("ff", "mf", "toe")}, "toe"),
        ({"measured": []}, "no measured error"),
        ({"input": session(mean=(0.0,) * 77)}, "78 features"),
        ({"input": session(spread=(0.0,) * 78)}, "spread"),
        ({"input": session(sharpness=())}, "ascend from 0"),
        ({"input": session(sharpness=(Sharpness(5.0, 1.0),))}, "ascend from 0"),
        ({"input": session(sharpness=(Sharpness(0.0, 1.0),) * 2)}, "ascend from 0"),
        ({"seen": msgspec.to_builtins(seen(spread=0.0))}, "no inverse"),
        ({"seen": msgspec.to_builtins(seen()) | {"whitening": [[1.0]]}}, "triangle"),
        ({"seen": msgspec.to_builtins(seen()) | {"low": [[2001] * 24] * 3}}, "above the highest"),
        ({"seen": msgspec.to_builtins(seen()) | {"high": [[2000] * 23] * 3}}, "24"),
    ],
)
def test_a_contract_that_contradicts_itself_is_refused(
    change: dict[str, object], says: str
) -> None:
    content = msgspec.to_builtins(contract()) | {"seen": msgspec.to_builtins(seen())}
    assert ModelContract.from_json(msgspec.json.encode(content).decode()).seen == seen()
    with pytest.raises(ModelError, match=says):
        ModelContract.from_json(msgspec.json.encode(content | change).decode())


@pytest.mark.parametrize(
    ("distance", "near", "near_though_contradicted", "learned"),
    [(1.0, True, True, True), (1.9, True, False, True), (2.6, False, False, True),
     (5.1, False, False, False)],
)  # fmt: skip
def test_a_session_learns_at_twice_the_distance_it_judges(
    distance: float, near: bool, near_though_contradicted: bool, learned: bool
) -> None:
    check = Electrodes(seen(spread=1 / 100))
    values = np.full((3, 24), 2000.0 + 100.0 * distance)
    deviations = check.compare(values)
    assert check.is_near(deviations.mean_square()) is near
    assert check.is_near(deviations.mean_square(2), 1) is near_though_contradicted
    assert check.is_learned(deviations.mean_square()) is learned


def test_a_reading_that_is_not_finite_teaches_nothing() -> None:
    check, values = Electrodes(seen(spread=1 / 100)), np.full((3, 24), 2000.0)
    values[0, 0] = np.nan
    square = check.compare(values).mean_square()
    assert not check.is_near(square)
    assert not check.is_learned(square)
