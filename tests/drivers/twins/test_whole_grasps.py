"""Whole grasps: their course, sampling and noise, the demos, and synthetic grasps.

Figures of the untouched recording of a palm (`biotacs-noise`, 100 Hz): robust sigma 2.9 to 4.3
counts, 0.75 to 1.22 % spikes of 25 to 150 counts, all downward, drift 0.56 to 0.84 counts/s, pairs
unchanged in 2 of 7 rows.
"""

from __future__ import annotations

import csv
import itertools
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.drivers.recordings.csv_player import (
    DEMO_DAY,
    DEMO_RECORDING,
    DEMO_TABLE,
    SHOW_RECORDING,
)
from graspd.drivers.twins.grasps.grasp_script import Durations, EndPoint, Timetable
from graspd.drivers.twins.grasps.whole_grasps import (
    GraspRow,
    WholeGrasps,
    synthetic_grasps,
)
from tests.drivers.recordings.tables import rows_of
from tests.drivers.twins.signals import played
from tests.kit import demos
from tests.kit.demos import STREAM_DURATIONS

REST = np.full((3, 24), 3000.0)
SILENCE = np.zeros((1, 3, 24))


def pressed(seed: int, slipped: bool) -> EndPoint:
    """An end point whose electrodes lie 0 to 900 counts below `REST`."""
    depth = np.random.default_rng(seed).uniform(0, 900, REST.shape)
    return EndPoint((REST - depth).astype(np.uint16), slipped, f"thing_{seed}")


GRASPS = [pressed(seed, slipped=seed % 2 == 1) for seed in range(4)]


@pytest.fixture(scope="module")
def silent() -> tuple[list[GraspRow], list[Timetable]]:
    """Four grasps at 1000 Hz without noise; two slip."""
    grasps = WholeGrasps(REST, GRASPS, rate_hz=1000.0, noise=played(SILENCE), seed=5)
    return list(grasps), list(grasps.timetables())


def test_rows_name_their_grasp_and_its_times_are_in_order(
    silent: tuple[list[GraspRow], list[Timetable]],
) -> None:
    moments, timetables = silent
    assert [grasp for grasp, _ in itertools.groupby(moments, lambda m: m.grasp)] == [0, 1, 2, 3, 4]
    for timetable, end_point in zip(timetables, GRASPS, strict=True):
        touches_s = sorted(timetable.touched_s)
        times_s = [timetable.approach_s, *touches_s, timetable.closed_s, timetable.lift_s]
        times_s += [timetable.release_s, timetable.open_s, timetable.end_s]
        assert all(earlier < later for earlier, later in itertools.pairwise(times_s))
        notes = {(m.slipped, m.object_name) for m in moments if m.grasp == timetable.grasp}
        assert notes == {(end_point.slipped, end_point.object_name)}
    assert {(m.slipped, m.object_name) for m in moments if m.grasp == 0} == {(None, None)}


def test_the_end_point_is_reached_when_the_lift_starts(
    silent: tuple[list[GraspRow], list[Timetable]],
) -> None:
    moments, timetables = silent
    for timetable, end_point in zip(timetables, GRASPS, strict=True):
        last = [moment for moment in moments if moment.t_s < timetable.lift_s][-1]
        # 7 % of 900 counts, five sixths of a second or four time constants later: one count.
        assert np.abs(last.counts - end_point.counts.astype(float)).max() <= 2.0


def test_a_stream_follows_its_seed() -> None:
    def content(grasps: WholeGrasps) -> list[tuple[float, bytes, bytes]]:
        return [(m.t_s, m.counts.tobytes(), m.position_rad.tobytes()) for m in grasps]

    grasps = WholeGrasps(REST, GRASPS[:1], seed=1)
    truth = list(grasps.timetables())
    first = content(grasps)
    assert content(grasps) == first == content(WholeGrasps(REST, GRASPS[:1], seed=1))
    assert list(grasps.timetables()) == truth
    assert content(WholeGrasps(REST, GRASPS[:1], seed=2))[0] != first[0]


def test_held_values_come_at_the_rate_of_recordings_only() -> None:
    with pytest.raises(ValueError, match="must be positive"):
        WholeGrasps(REST, GRASPS, rate_hz=0.0)
    with pytest.raises(ValueError, match="held values come at 100 Hz"):
        WholeGrasps(REST, GRASPS, held=True, rate_hz=50.0)


def test_the_demo_has_twelve_synthetic_grasps_and_six_slips() -> None:
    assert DEMO_RECORDING.stat().st_size < 1_200_000
    rows = rows_of(DEMO_RECORDING.read_bytes(), strict=True)
    times = [row.t_s for row in rows if row.t_s is not None]
    np.testing.assert_allclose(times, 0.01 * np.arange(len(rows)), atol=1e-9)
    names = {row.annotation.object_name for row in rows}
    assert all(name is None or name.startswith("synthetic") for name in names)
    assert all(np.isfinite(row.position_rad).all() for row in rows)
    timetables = list(synthetic_grasps(12, durations=STREAM_DURATIONS).timetables())
    assert len(timetables) == 12
    assert sum(timetable.slipped for timetable in timetables) == 6
    for timetable in timetables:
        row = rows[round(timetable.lift_s * 100.0)]
        assert row.annotation.slipped is timetable.slipped
        assert row.annotation.object_name == timetable.object_name


UNPRESSED = EndPoint(REST.astype(np.uint16), False, "nothing")
LONG_REST = Durations(first_rest_s=(60.0, 60.0))
PAIRS = [(0,), *((first, first + 1) for first in range(1, 23, 2)), (23,)]
"""Electrodes sampled by one request, from 0: E1 (with TDC), E2/E3 ... E22/E23, E24."""


def counts_of(moments: list[GraspRow]) -> NDArray[np.float64]:
    return np.array([moment.counts for moment in moments], dtype=np.float64)


def untouched() -> NDArray[np.float64]:
    """A minute of rest, shape (6000, 3, 24)."""
    grasps = WholeGrasps(REST, [UNPRESSED], durations=LONG_REST, seed=3)
    return counts_of(list(itertools.islice(grasps, 6000)))


def test_held_values_follow_the_palms_requests() -> None:
    numbers = np.broadcast_to(np.arange(1000.0)[:, np.newaxis, np.newaxis], (1000, 3, 24))
    for seed in range(20):
        grasps = WholeGrasps(
            np.ones((3, 24)),
            [EndPoint(np.ones((3, 24), dtype=np.uint16), False, "")],
            held=True,
            noise=played(numbers),
            seed=seed,
        )
        rows = counts_of(list(itertools.islice(grasps, 100)))
        if rows[0, 0, 0] < 800:  # the loop does not begin again within these rows
            break
    for row, counts in enumerate(rows):
        for place, pair in enumerate(PAIRS, 1):
            rounds_ago = (10 * row - place) // 14 + 1
            assert (counts[:, list(pair)] == rows[0, 0, 0] + rounds_ago).all()


def test_noise_has_the_measured_width_drift_and_spikes() -> None:
    counts = untouched()
    times = np.arange(len(counts)) * 0.01
    slopes = np.polyfit(times, counts.reshape(len(counts), -1), 1)[0]
    assert slopes.mean() == pytest.approx(0.7, abs=0.01)
    residuals = counts - 3000.0 - 0.7 * times[:, np.newaxis, np.newaxis]
    sigma = 1.4826 * np.median(np.abs(residuals), axis=0)
    assert ((sigma > 2.9) & (sigma < 4.3)).all()
    assert residuals.max() < 6 * 3.5
    spikes = residuals < -6 * 3.5
    assert 0.0075 < spikes.mean() < 0.0122
    assert residuals.min() > -(150 + 6 * 3.5)
    assert spikes.sum(axis=2).max() == 1, "one electrode of a finger at a time"
    assert not (spikes[1:] & spikes[:-1]).any(), "isolated in time"


def load(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Counts (grasps, 72) and labels, read without the code under test."""
    with path.open(newline="") as file:
        rows = list(csv.reader(file))[1:]
    return np.array([row[2:] for row in rows], dtype=float), np.array([int(row[1]) for row in rows])


def test_the_demos_are_made_again_byte_for_byte(tmp_path: Path) -> None:
    demos.main(tmp_path)
    for demo in (DEMO_TABLE, DEMO_DAY, DEMO_RECORDING, SHOW_RECORDING):
        assert (tmp_path / demo.name).read_bytes() == demo.read_bytes()


def test_no_synthetic_grasp_is_a_real_one(bts3_dir: Path) -> None:
    counts, _ = load(DEMO_TABLE)
    real = np.vstack([load(bts3_dir / f"palm_{pose}.csv")[0] for pose in ("down", "side")])
    nearest = [np.abs(real - grasp).max(axis=1).min() for grasp in counts]
    assert min(nearest) > 100, "counts, at the electrode that differs most"
