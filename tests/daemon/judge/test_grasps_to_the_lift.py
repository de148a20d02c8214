"""Whole grasps from real end points with the real sensors' noise: judged once, before the lift."""

from __future__ import annotations

from pathlib import Path

import pytest

from graspd.daemon.judge.reasons import Decision, Reason
from graspd.models import zoo
from graspd.models.runtime import TactileModel
from tests.bench.gate import Study, end_points, streams, study

GRASPS = 40
"""Per rate."""
RATES = ("71.43 Hz held", "100 Hz fresh")
STILL_S = 0.24
"""What is looked back at; the end of closing is no part of it."""
WAITED_MAX_S = 0.5
"""After the hand is as still as a held touch; 99 in 100 have their verdict within 0.42 s."""
STANDS_S = 0.03
"""A hand that opens moves nothing beyond noise for the first 20 ms; then the verdict is gone."""


@pytest.fixture(scope="module", params=RATES)
def found(bts3_dir: Path, request: pytest.FixtureRequest) -> Study:
    data = bts3_dir.parent
    if not (data / "untouched" / "untouched.csv").exists():
        pytest.skip("no recording of untouched sensors in the data folder")
    points, rest = end_points(bts3_dir, GRASPS)
    stream = streams(data, points, rest)[request.param]
    return study(stream, points, TactileModel(zoo.find("cnn1")))


def test_every_grasp_is_judged_exactly_once_before_its_lift(found: Study) -> None:
    assert len(found.grasps) == GRASPS
    assert [len(seen.before_lift) for seen in found.grasps] == [1] * GRASPS


def test_the_verdict_comes_after_everything_is_still(found: Study) -> None:
    for seen in found.grasps:
        t_s = seen.judged[0][0]
        assert seen.truth.closed_s + STILL_S <= t_s < seen.truth.lift_s
        assert t_s - seen.still_s < WAITED_MAX_S


def test_nothing_is_judged_before_the_hand_has_closed_or_while_it_opens(found: Study) -> None:
    assert not found.too_early
    assert found.outlived_s <= STANDS_S


def test_the_verdict_is_that_of_the_row_unless_the_row_is_a_toss_up(found: Study) -> None:
    others = [seen for seen in found.grasps if seen.judged[0][1].decision is not seen.row]
    unlike = [seen for seen in others if seen.judged[0][1].decision is Decision.UNKNOWN]
    # A row at the edge of what was ever seen may fall over it, to the safe side.
    assert len(unlike) <= 1
    for seen in others:
        if seen in unlike:
            assert seen.judged[0][1].reasons == (Reason.NEVER_SEEN,)
        else:
            assert seen.row_p_slip is not None
            # What noise and creep may move a probability by: 0.083 in one of a hundred readings.
            assert abs(seen.row_p_slip - 0.5) < 0.1
