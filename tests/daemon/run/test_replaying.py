"""What goes along with a replay."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from graspd.daemon.judge.health import SWEEPS
from graspd.daemon.judge.reasons import Decision, Reason
from graspd.daemon.publish.companion import PublishedVerdict
from graspd.daemon.run.replaying import Comparison, Controller
from graspd.daemon.run.summary import WITHOUT_SESSION, RunSummary
from graspd.drivers.base import Annotation
from tests.daemon.fakes import NO_LIFT, Clock, FakeModel, pipeline, reading
from tests.daemon.publish.doors import Asked
from tests.kit.messages import GOLDEN_VERDICT


@pytest.mark.parametrize(
    ("in_the_table", "told"),
    [("mug", "mug"), ('a "red" pen', None), ("=HYPERLINK(0)", None), ("mug\n", None), (None, None)],
)
def test_an_object_is_told_by_a_name_that_outcomes_may_have(
    in_the_table: str | None, told: str | None
) -> None:
    controller, requests = Controller(only_lifted=False), Asked()
    controller.before_wait(requests)
    note = Annotation(Path("any.csv"), 1, in_the_table, slipped=True)
    lifted = msgspec.structs.replace(reading(0), annotation=note)
    judgement = pipeline(FakeModel(), Clock()).judge(lifted)
    controller.on_verdict(PublishedVerdict(judgement, GOLDEN_VERDICT, b"", lifted, True, *NO_LIFT))
    controller.tell()
    assert [(lift.outcome, lift.object_name) for lift in requests.outcomes] == [("slip", told)]


@pytest.mark.parametrize(("between", "fresh"), [(SWEEPS, True), (SWEEPS - 2, False)])
def test_a_comparison_finds_a_grasp_that_comes_again_as_fresh_as_the_run_does(
    between: int, fresh: bool
) -> None:
    clock, result = Clock(), RunSummary()
    run, compared = pipeline(FakeModel(), clock), pipeline(FakeModel(), clock)
    comparison = Comparison(WITHOUT_SESSION, compared, result)
    seeds = [1, *range(2, 2 + between), 1]
    for seq, seed in enumerate(seeds):
        new = reading(clock.now_ns, seed=seed, seq=seq)
        last = run.judge(new)
        judged = seq in (0, len(seeds) - 1)
        told = msgspec.structs.replace(GOLDEN_VERDICT, judged=judged, grasp=1 + seq)
        comparison.on_verdict(PublishedVerdict(last, told, b"", new, True, *NO_LIFT))
    tally = result.compared[WITHOUT_SESSION]
    assert tally.decisions.total() == 2
    assert tally.decisions[Decision.UNKNOWN] == tally.reasons[Reason.FROZEN] == (not fresh)
    assert (Reason.FROZEN in last.reasons) is not fresh
