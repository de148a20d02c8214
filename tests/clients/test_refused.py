"""What a rogue publisher or an older start sends lets nobody lift, in either language."""

from __future__ import annotations

import json
from typing import Any

import pytest

from deploy.clients.python.graspd_client import Client, Newest
from tests.clients.messages import MS, TOPIC
from tests.clients.oracle import MAX_AGE_NS
from tests.clients.refused import CASES, NAMES, came, well
from tests.clients.test_cpp_rules import START_NS, Probe, as_hex, probe, said

__all__ = ["probe"]

NOW_NS = START_NS + MS
"""When a message is sent whose reading came at the start."""
PADDED = [TOPIC, json.dumps(well(START_NS)).encode().ljust(1 << 16)]
"""As long as a message may be."""


def told(messages: list[list[bytes]], max_p_slip: float = 0.5) -> Newest:
    """The Python client's rules after these have come."""
    newest = Newest(TOPIC, MAX_AGE_NS, True, max_p_slip)
    for frames in messages:
        newest.take(frames, START_NS, NOW_NS)
    return newest


def told_to(probe: Probe, messages: list[list[bytes]]) -> str:
    """What the C++ client's rules say after these have come."""
    probe.tell("new", MAX_AGE_NS, 1)
    for frames in messages:
        probe.tell("take", START_NS, NOW_NS, *map(as_hex, frames))
    return probe.at(NOW_NS)


@pytest.mark.parametrize("case", CASES, ids=NAMES)
def test_python_does_not_lift_on_it(case: dict[str, Any]) -> None:
    found = told(came(case, START_NS)).at(NOW_NS)
    assert (bool(found), found.supervised) == (False, False)


@pytest.mark.parametrize("case", CASES, ids=NAMES)
def test_cpp_says_of_it_what_python_says(probe: Probe, case: dict[str, Any]) -> None:
    messages = came(case, START_NS)
    answer = told_to(probe, messages)
    assert not answer.startswith("stable")
    assert answer == said(told(messages), NOW_NS)


def test_what_the_cases_begin_with_is_lifted_on_in_both(probe: Probe) -> None:
    assert told([PADDED]).at(NOW_NS)
    assert told_to(probe, [PADDED]) == said(told([PADDED]), NOW_NS)


def test_a_daemon_with_a_higher_threshold_is_believed_as_far_as_the_client_is_told() -> None:
    unsure = [[TOPIC, json.dumps(well(START_NS) | {"p_slip": 0.6}).encode()]]
    assert told(unsure).at(NOW_NS).reasons == ("p-slip",)
    assert told(unsure, max_p_slip=0.7).at(NOW_NS)
    for wrong in (0.0, 1.1, float("nan")):
        with pytest.raises(ValueError, match="max_p_slip"):
            Client("ipc:///nowhere", max_p_slip=wrong)
