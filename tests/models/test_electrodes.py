"""Broken electrodes and readings never seen, against linear algebra, by hand and on real grasps."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.models import zoo
from graspd.models.contract import ModelContract, ModelError, SeenCounts, SessionInput, Sharpness
from graspd.models.electrodes import IMPLAUSIBLE, Electrodes
from graspd.models.runtime import TactileModel
from graspd.models.training.data.datasets import Grasps, read_table
from tests.daemon.fakes import contract

SHAPE = (3, 24)
NOTHING = np.zeros(SHAPE, dtype=np.bool_)


def implausible(
    electrodes: Electrodes, values: NDArray[np.float64], broken: NDArray[np.bool_], at_most: int
) -> NDArray[np.bool_]:
    return electrodes.implausible(electrodes.compare(values), broken, at_most)


def correlated(seed: int = 0) -> tuple[NDArray[np.float64], NDArray[np.float64], SeenCounts]:
    """Return mean (72,) and covariance (72, 72) of made-up electrodes, and their `SeenCounts`."""
    random = np.random.default_rng(seed)
    mean = random.uniform(1500.0, 2500.0, 72)
    mixing = random.normal(size=(72, 10)) * 120.0
    covariance = mixing @ mixing.T + np.diag(random.uniform(10.0, 40.0, 72) ** 2)
    whitening = np.linalg.cholesky(np.linalg.inv(covariance))
    row = ((0,) * 24,) * 3
    seen = SeenCounts(
        row,
        ((4095,) * 24,) * 3,
        0,
        tuple(tuple(finger) for finger in mean.reshape(SHAPE).tolist()),
        tuple(tuple(line[: index + 1]) for index, line in enumerate(whitening.tolist())),
        2.5,
    )
    return mean, covariance, seen


def conditional(
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
    values: NDArray[np.float64],
    out: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and variance of the electrodes `out` given the `values` of the rest, by blocks."""
    cross = covariance[np.ix_(out, ~out)] @ np.linalg.inv(covariance[np.ix_(~out, ~out)])
    expected = mean[out] + cross @ (values[~out] - mean[~out])
    variance = covariance[np.ix_(out, out)] - cross @ covariance[np.ix_(~out, out)]
    return expected, np.diag(variance)


@pytest.mark.parametrize("number", [1, 12])
def test_a_broken_electrode_is_repaired_by_its_conditional_mean(number: int) -> None:
    mean, covariance, seen = correlated()
    random = np.random.default_rng(number)
    values = random.multivariate_normal(mean, covariance)
    out = np.zeros(72, dtype=np.bool_)
    out[random.permutation(72)[:number]] = True
    electrodes = Electrodes(seen)
    repaired = electrodes.repaired(values.reshape(SHAPE), out.reshape(SHAPE)).ravel()
    np.testing.assert_array_equal(repaired[~out], values[~out])
    expected, _ = conditional(mean, covariance, values, out)
    np.testing.assert_allclose(repaired[out], expected, rtol=1e-6)
    np.testing.assert_allclose(electrodes.centre.ravel(), mean)
    np.testing.assert_allclose(electrodes.spread.ravel(), np.sqrt(np.diag(covariance)), rtol=1e-6)


@pytest.mark.parametrize(("deviations", "found"), [(0.98, False), (1.02, True), (-1.02, True)])
def test_an_electrode_is_implausible_from_eight_deviations_on(
    deviations: float, found: bool
) -> None:
    mean, covariance, seen = correlated()
    out = np.zeros(72, dtype=np.bool_)
    out[30] = True
    values = mean.copy()
    expected, variance = conditional(mean, covariance, values, out)
    values[30] = expected[0] + deviations * IMPLAUSIBLE * np.sqrt(variance[0])
    marked = implausible(Electrodes(seen), values, NOTHING, 12)
    assert marked.sum() == found
    assert marked.ravel()[30] == found


@pytest.mark.parametrize(("seed", "at_most"), [(0, 6), (1, 10), (2, 10)])
def test_the_search_for_broken_electrodes_marks_the_worst_first(seed: int, at_most: int) -> None:
    mean, covariance, seen = correlated(seed)
    random = np.random.default_rng(seed)
    values = random.multivariate_normal(mean, covariance)
    values[random.permutation(72)[:6]] += random.choice([-900.0, 160.0, 900.0], 6)
    out = np.zeros(72, dtype=np.bool_)
    out[random.permutation(72)[:2]] = True
    broken = out.copy()
    while out.sum() < at_most:
        off = np.zeros(72)  # in conditional standard deviations, each given all others left
        for place in np.flatnonzero(~out):
            alone = np.zeros(72, dtype=np.bool_)
            alone[place] = True
            left = ~out | alone
            (expected,), (variance,) = conditional(
                mean[left], covariance[np.ix_(left, left)], values[left], alone[left]
            )
            off[place] = abs(values[place] - expected) / np.sqrt(variance)
        if off.max() <= IMPLAUSIBLE:
            break
        out[off.argmax()] = True
    marked = implausible(Electrodes(seen), values, broken.reshape(SHAPE), at_most)
    assert np.flatnonzero(marked).tolist() == np.flatnonzero(out).tolist()


@pytest.fixture(scope="module")
def side(bts3_dir: Path) -> Grasps:
    return read_table(bts3_dir / "palm_side.csv")


def test_stuck_electrodes_of_real_grasps_are_found(side: Grasps) -> None:
    electrodes = Electrodes(TactileModel(zoo.find("cnn1")).contract.seen)
    values = side.counts[::4].astype(np.float64)
    alarms = [implausible(electrodes, reading, NOTHING, 13).any() for reading in values]
    assert np.mean(alarms) < 0.12
    values[:, 1, 9] = 0.0
    found = [implausible(electrodes, reading, NOTHING, 13)[1, 9] for reading in values]
    assert np.mean(found) > 0.95


def test_a_finger_whose_electrodes_all_shifted_is_noticed() -> None:
    mean, covariance, seen = correlated()
    random = np.random.default_rng(8)
    electrodes = Electrodes(seen)
    of_finger = np.repeat(np.eye(3), 24, axis=1)
    precision: NDArray[np.float64] = np.linalg.inv(covariance).astype(np.float64)
    for reading in random.multivariate_normal(mean, covariance, 20):
        values = reading.reshape(SHAPE)
        assert not electrodes.moved_finger(electrodes.compare(values))
        # By generalised least squares: what was added to a finger, and how far that may be off.
        for finger, chosen in enumerate(of_finger):
            spread = 1.0 / np.sqrt(chosen @ precision @ chosen)
            known = (chosen @ precision @ (reading - mean)) * spread**2
            for excess, expected in ((-0.1, False), (0.1, True)):
                moved = values.copy()
                moved[finger] += (IMPLAUSIBLE + excess) * spread - known
                others = [o for o in range(3) if o != finger]
                if all(_moved_by(moved, mean, precision, of_finger[o]) < 7.9 for o in others):
                    assert electrodes.moved_finger(electrodes.compare(moved)) is expected


def _moved_by(
    values: NDArray[np.float64],
    mean: NDArray[np.float64],
    precision: NDArray[np.float64],
    chosen: NDArray[np.float64],
) -> float:
    """Return how far the `chosen` electrodes seem shifted by one offset, in standard deviations."""
    along = chosen @ precision
    return float(abs(along @ (values.ravel() - mean)) / np.sqrt(along @ chosen))


def round_numbers(spread: float = 1e-6, distance_max: float = 2.5) -> SeenCounts:
    row = ((2000,) * 24,) * 3
    centre = ((2000.0,) * 24,) * 3
    diagonal = tuple((0.0,) * place + (spread,) for place in range(72))
    return SeenCounts(row, row, 250, centre, diagonal, distance_max)


def session(**changes: object) -> dict[str, object]:
    sound = SessionInput((0.0,) * 78, (1.0,) * 78, 3.0, 1.0, 20.0, (Sharpness(0.0, 1.0),))
    return {"type": "session"} | msgspec.to_builtins(msgspec.structs.replace(sound, **changes))  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("count", "refused"), [(1750, False), (1749, True), (2250, False), (2251, True), (0, True)]
)
def test_counts_beyond_range_and_margin_are_unlike_the_training(count: int, refused: bool) -> None:
    counts = np.full((2, 3, 24), 2000, dtype=np.uint16)
    counts[1, 1, 11] = count
    assert Electrodes(round_numbers()).never_seen(counts).tolist() == [False, refused]


@pytest.mark.parametrize(("off", "refused"), [(200, False), (201, True), (-201, True)])
def test_a_root_mean_square_deviation_above_the_limit_is_refused(off: int, refused: bool) -> None:
    # All 72 electrodes `off` counts from the centre, one spread being 100 counts: distance 2.
    counts = np.full((1, 3, 24), 2000 + off, dtype=np.uint16)
    check = Electrodes(round_numbers(spread=1 / 100, distance_max=2.0))
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
        ({"seen": msgspec.to_builtins(round_numbers(spread=0.0))}, "no inverse"),
        ({"seen": msgspec.to_builtins(round_numbers()) | {"whitening": [[1.0]]}}, "triangle"),
        (
            {"seen": msgspec.to_builtins(round_numbers()) | {"low": [[2001] * 24] * 3}},
            "above the highest",
        ),
        ({"seen": msgspec.to_builtins(round_numbers()) | {"high": [[2000] * 23] * 3}}, "24"),
    ],
)
def test_a_contract_that_contradicts_itself_is_refused(
    change: dict[str, object], says: str
) -> None:
    content = msgspec.to_builtins(contract()) | {"seen": msgspec.to_builtins(round_numbers())}
    assert ModelContract.from_json(msgspec.json.encode(content).decode()).seen == round_numbers()
    with pytest.raises(ModelError, match=says):
        ModelContract.from_json(msgspec.json.encode(content | change).decode())


def test_a_reading_with_nan_is_neither_near_nor_learned() -> None:
    check, values = Electrodes(round_numbers(spread=1 / 100)), np.full((3, 24), 2000.0)
    values[0, 0] = np.nan
    square = check.compare(values).mean_square()
    assert not check.is_near(square)
    assert not check.is_learned(square)
