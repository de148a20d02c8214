"""Nothing that a rogue publisher or an earlier start of the daemon sends lets a client lift.

The messages of a case `came` in this order. Each is a verdict in which all is well, except the
fields in `change`, the field that it is `without`, or a reading `later_ms` after the others.
`frames`: how to change this payload for each frame after the topic, as text (Latin-1: each
character is a byte). `told`: `boot_id` and number of each grasp with an outcome told before.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from deploy.clients.python.graspd_client import Client, Newest, Verdict
from tests.clients.building import Probe
from tests.clients.messages import ADDED, MAX_AGE_NS, MS, TOPIC, verdict
from tests.clients.rules import START_NS, Rules

CASES: list[dict[str, Any]] = json.loads(
    (Path(__file__).parent / "golden" / "refused.json").read_text()
)
"""Cases on which no client may lift, one table for the tests of both languages."""
NOW_NS = START_NS + MS
"""Time when messages arrive, ns: 1 ms after `START_NS`, when their reading was made."""


def well(read_ns: int, seq: int = 0) -> dict[str, Any]:
    """Return a message that permits a lift, of a reading at `read_ns`."""
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
"""Grasps, each by `boot_id` and number."""


def told(cpp: Probe | None, messages: list[list[bytes]], ended: Grasps = ()) -> Verdict:
    """Return the verdict after `messages`; outcomes of the grasps `ended` were reported before.

    `cpp`: runs the C++ client too; None: only Python's.
    """
    rules = Rules(cpp)
    for grasp in ended:
        rules.end(*grasp)
    for frames in messages:
        rules.take(frames, START_NS, NOW_NS)
    return rules.at(NOW_NS)


@pytest.mark.parametrize("case", CASES, ids=[case["name"] for case in CASES])
def test_no_bad_message_or_ended_grasp_allows_a_lift(
    cpp: Probe | None, case: dict[str, Any]
) -> None:
    found = told(cpp, came(case, START_NS), case.get("told", ()))
    assert not found
    assert not found.supervised


def test_the_undamaged_message_allows_a_lift(cpp: Probe | None) -> None:
    assert told(cpp, [PADDED])
    assert told(cpp, [PADDED], [("a", 2), ("b", 1)]), "other grasps were told"


def test_the_last_256_grasps_with_an_outcome_are_remembered(cpp: Probe | None) -> None:
    many = [("a", 1), *(("a", grasp) for grasp in range(2, 258))]
    assert told(cpp, [PADDED], many), "the 257th before"
    assert not told(cpp, [PADDED], many[:-1])
    assert not told(cpp, [PADDED], [*many, ("a", 1)])


def test_a_stable_with_p_slip_above_max_is_unknown() -> None:
    unsure = [TOPIC, json.dumps(well(START_NS) | {"p_slip": 0.6}).encode()]
    for most, reasons in ((0.5, ("p-slip",)), (0.7, ())):
        newest = Newest(TOPIC, MAX_AGE_NS, True, most)
        newest.take(unsure, START_NS, NOW_NS)
        assert newest.at(NOW_NS).reasons == reasons
    for wrong in (0.0, 1.1, float("nan")):
        with pytest.raises(ValueError, match="max_p_slip"):
            Client("ipc:///nowhere", max_p_slip=wrong)
