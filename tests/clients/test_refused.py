"""What a rogue publisher or an older start sends allows no lift, in either language.

A case is what comes after one another, each as a verdict in which all is well except its
`change`, the field that it is `without`, or the time of its reading, `later_ms`. Its
`frames` after the topic are that payload, changed as text (Latin-1: each character is a byte).
Before it, the outcomes of the grasps were `told` of whose `boot_id` and number it has a list.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from deploy.clients.python.graspd_client import Client, Newest
from tests.clients.building import Probe
from tests.clients.messages import ADDED, MAX_AGE_NS, MS, TOPIC, verdict
from tests.clients.test_cpp_rules import START_NS, as_hex, said

CASES: list[dict[str, Any]] = json.loads(
    (Path(__file__).parent / "golden" / "refused.json").read_text()
)
"""What no client may lift on, one table for the tests of both languages."""
NOW_NS = START_NS + MS
"""When a message is sent whose reading came at the start."""


def well(read_ns: int, seq: int = 0) -> dict[str, Any]:
    """A message that a lift may rely on, of a reading at that time."""
    return verdict(seq, read_ns, **ADDED)


def came(case: dict[str, Any], read_ns: int) -> list[list[bytes]]:
    """Return the frames of a case's messages in order; `read_ns`: base of their times."""
    return [_frames(each, read_ns) for each in case["came"]]


def _frames(each: dict[str, Any], read_ns: int) -> list[bytes]:
    message = well(read_ns + each.get("later_ms", 0) * MS) | each.get("change", {})
    message.pop(each.get("without"), None)
    payload = json.dumps(message)
    sent = [_changed(payload, how) for how in each.get("frames", [{}])]
    return [each.get("topic", TOPIC.decode()).encode(), *sent]


def _changed(payload: str, how: dict[str, Any]) -> bytes:
    if "text" in how:
        payload = how["text"] * how.get("times", 1)
    if "swap" in how:
        former, new = how["swap"]
        if payload.count(former) != 1:
            raise ValueError(f"{former} is not there once")
        payload = payload.replace(former, new)
    whole: str = how.get("prepend", "") + payload + how.get("append", "")
    whole += " " * how.get("pad", 0)
    return whole[: len(whole) - how.get("cut", 0)].encode("latin-1")


PADDED = [TOPIC, json.dumps(well(START_NS)).encode().ljust(1 << 16)]
"""The longest message that is allowed."""


Grasps = Sequence[tuple[str, int]]
"""By `boot_id` and number."""


def told(messages: list[list[bytes]], max_p_slip: float = 0.5, ended: Grasps = ()) -> Newest:
    """The Python client's rules after these have come, with outcomes of these grasps told."""
    newest = Newest(TOPIC, MAX_AGE_NS, True, max_p_slip)
    for boot_id, grasp in ended:
        newest.end((boot_id, grasp))
    for frames in messages:
        newest.take(frames, START_NS, NOW_NS)
    return newest


def told_to(probe: Probe, messages: list[list[bytes]], ended: Grasps = ()) -> str:
    """What the C++ client's rules say after these have come."""
    probe.tell("new", MAX_AGE_NS, 1)
    for grasp in ended:
        probe.tell("end", *grasp)
    for frames in messages:
        probe.tell("take", START_NS, NOW_NS, *map(as_hex, frames))
    return probe.ask("at", NOW_NS)


def test_python_lifts_on_no_refused_case() -> None:
    lifts = []
    for case in CASES:
        found = told(came(case, START_NS), ended=case.get("told", ())).at(NOW_NS)
        if found or found.supervised:
            lifts.append(case["name"])
    assert not lifts


def test_cpp_says_of_each_case_what_python_says(probe: Probe) -> None:
    differs = []
    for case in CASES:
        messages, ended = came(case, START_NS), case.get("told", ())
        answer = told_to(probe, messages, ended)
        if answer.startswith("stable") or answer != said(told(messages, ended=ended), NOW_NS):
            differs.append(case["name"])
    assert not differs


def test_what_the_cases_begin_with_is_lifted_on_in_both(probe: Probe) -> None:
    assert told([PADDED]).at(NOW_NS)
    assert told_to(probe, [PADDED]) == said(told([PADDED]), NOW_NS)


def test_only_the_grasp_that_was_told_is_refused_in_both(probe: Probe) -> None:
    others = [("a", 2), ("b", 1)]
    assert told([PADDED], ended=others).at(NOW_NS)
    assert told_to(probe, [PADDED], others) == said(told([PADDED]), NOW_NS)


def test_told_grasps_are_remembered_in_bounded_memory(probe: Probe) -> None:
    many = [("a", 1), *(("a", grasp) for grasp in range(2, 258))]
    assert told([PADDED], ended=many).at(NOW_NS), "the 257th before"
    assert not told([PADDED], ended=many[:-1]).at(NOW_NS)
    for ended in (many, many[:-1], [*many, ("a", 1)]):
        expected = said(told([PADDED], ended=ended), NOW_NS)
        assert told_to(probe, [PADDED], ended) == expected


def test_a_client_believes_a_higher_threshold_only_if_told() -> None:
    unsure = [[TOPIC, json.dumps(well(START_NS) | {"p_slip": 0.6}).encode()]]
    assert told(unsure).at(NOW_NS).reasons == ("p-slip",)
    assert told(unsure, max_p_slip=0.7).at(NOW_NS)
    for wrong in (0.0, 1.1, float("nan")):
        with pytest.raises(ValueError, match="max_p_slip"):
            Client("ipc:///nowhere", max_p_slip=wrong)
