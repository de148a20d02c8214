"""What a model has never seen: ranges and covariance against figures worked out by hand."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from models.contract import ModelContract, ModelError, SeenCounts
from models.seen import SeenCheck
from tests.daemon.fakes import contract


def diagonal(size: int, value: float) -> tuple[tuple[float, ...], ...]:
    return tuple((0.0,) * row + (value,) for row in range(size))


def seen(spread: float = 0.0, distance_max: float = 2.5) -> SeenCounts:
    row = ((2000,) * 24,) * 3
    centre = ((2000.0,) * 24,) * 3
    return SeenCounts(row, row, 250, centre, diagonal(72, spread), distance_max)


@pytest.mark.parametrize(
    ("count", "refused"), [(1750, False), (1749, True), (2250, False), (2251, True), (0, True)]
)
def test_a_count_beyond_the_margin_was_never_seen(count: int, refused: bool) -> None:
    counts = np.full((2, 3, 24), 2000, dtype=np.uint16)
    counts[1, 1, 11] = count
    assert SeenCheck(seen()).never_seen(counts).tolist() == [False, refused]


@pytest.mark.parametrize(("off", "refused"), [(200, False), (201, True), (-201, True)])
def test_the_distance_is_the_root_mean_square_deviation(off: int, refused: bool) -> None:
    # All 72 electrodes `off` counts from the centre, one spread being 100 counts: distance 2.
    counts = np.full((1, 3, 24), 2000 + off, dtype=np.uint16)
    check = SeenCheck(seen(spread=1 / 100, distance_max=2.0))
    assert check.never_seen(counts).tolist() == [refused]


def test_the_triangle_is_read_row_by_row() -> None:
    rows = [list(row) for row in diagonal(72, 0.0)]
    rows[5][2] = 1.0  # electrode 5 weighs on the third deviation
    crossed = msgspec.structs.replace(seen(), whitening=tuple(map(tuple, rows)))
    counts = np.full((2, 3, 24), 2000, dtype=np.uint16)
    counts[0, 0, 5] += 100
    counts[1, 0, 2] += 100
    assert SeenCheck(crossed).never_seen(counts).tolist() == [True, False]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"fingers": ("ff", "ff", "th")}, "not different ones"),
        ({"fingers": ("ff", "mf")}, "not \\(fingers, 24\\)"),
        ({"fingers": ()}, "not different ones"),
        ({"fingers": ("ff", "mf", "toe")}, "toe"),
        ({"version": 2}, "version"),
        ({"composition": "horizontal"}, "composition"),
        ({"classes": ("slip", "stable")}, "classes"),
        ({"unheard_of": 1}, "unheard_of"),
        ({"seen": msgspec.to_builtins(seen()) | {"whitening": [[1.0]]}}, "triangle"),
        ({"seen": msgspec.to_builtins(seen()) | {"distance_max": 0.0}}, "distance_max"),
        ({"seen": msgspec.to_builtins(seen()) | {"low": [[2001] * 24] * 3}}, "above the highest"),
        ({"seen": msgspec.to_builtins(seen()) | {"low": [[-1] * 24] * 3}}, "low"),
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
