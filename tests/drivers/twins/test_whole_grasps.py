"""Whole grasps: their course, the truth told about them, and the demo recording."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from graspd.drivers.recordings.csv_player import DEMO_RECORDING
from graspd.drivers.twins.grasps.grasp_script import EndPoint, Timetable
from graspd.drivers.twins.grasps.whole_grasps import (
    GraspRow,
    WholeGrasps,
    synthetic_grasps,
)
from tests.drivers.recordings.tables import rows_of
from tests.drivers.twins.signals import played
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


def test_the_same_seed_gives_the_same_stream_and_another_seed_another_one() -> None:
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


def test_a_looped_stream_goes_on_with_other_numbers() -> None:
    grasps = WholeGrasps(REST, GRASPS[:2], loop=True)
    objects = [(t.grasp, t.object_name) for t in itertools.islice(grasps.timetables(), 4)]
    assert objects == [(1, "thing_0"), (2, "thing_1"), (3, "thing_0"), (4, "thing_1")]


def test_the_demo_is_a_small_stream_of_twelve_synthetic_grasps_half_of_them_slipping() -> None:
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
