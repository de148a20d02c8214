"""The controller of a replay, which reports the recorded outcomes."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from graspd.daemon.publish.companion import PublishedVerdict
from graspd.daemon.run.replaying import Controller
from graspd.drivers.base import Annotation
from tests.daemon.fakes import NO_LIFT, Clock, FakeModel, pipeline, reading
from tests.daemon.publish.doors import Asked
from tests.kit.messages import GOLDEN_VERDICT


@pytest.mark.parametrize(
    ("in_the_table", "told"),
    [("mug", "mug"), ('a "red" pen', None), ("=HYPERLINK(0)", None), ("mug\n", None), (None, None)],
)
def test_only_object_names_that_messages_allow_are_reported(
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
