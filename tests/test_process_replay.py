"""What is judged of known streams is what it was, within a tolerance that is stated."""

from __future__ import annotations

import copy

import pytest

from tests import process_replay
from tests.process_replay import P_SLIP_TOLERANCE, differences, entries, is_near, reference


@pytest.mark.parametrize("name", ["demo", "twin_faults"])
def test_known_streams_are_judged_as_they_were(name: str) -> None:
    found = differences(reference(name), entries(name))
    advice = "if that is meant, `python -m tests.process_replay --renew`"
    assert not found, "\n".join([*found[: process_replay.SHOWN_MAX], advice])


@pytest.mark.parametrize("name", ["demo", "twin_faults"])
def test_a_reference_has_grasps_that_were_judged_and_some_that_were_not(name: str) -> None:
    known = reference(name)
    assert sum(entry["n"] for entry in known) > 2500  # readings of the demo recording: 2836
    assert {entry["verdict"] for entry in known} >= {"slip", "unknown"}
    assert sum(entry["judged"] for entry in known) >= 12  # grasps of the demo recording


def test_under_faults_electrodes_are_repaired() -> None:
    repaired = {name for entry in reference("twin_faults") for name in entry["repaired"]}
    assert {"ff_7", "th_16"} <= repaired  # those that the twin's faults name, counted from 1


def test_no_reference_is_so_near_to_the_threshold_that_another_processor_could_turn_it() -> None:
    for name in process_replay.streams():
        for entry in reference(name):
            assert entry.get("near", False) == is_near(entry)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("verdict", "stable"),
        ("p_slip", 0.5 + 2 * P_SLIP_TOLERANCE),
        ("reasons", ["moving"]),
        ("repaired", ["ff_1"]),
        ("gate", "settled"),
        ("contact", ["ff"]),
        ("n", 3),
        ("grasp", 7),
    ],
)
def test_a_verdict_that_changes_is_found(field: str, value: object) -> None:
    was = [
        entry for entry in reference("demo") if entry.get("p_slip") is not None and entry["n"] != 3
    ][:2]
    now = copy.deepcopy(was)
    now[1][field] = value
    (line,) = differences(was, now)
    assert line.startswith(f"1: {field}: ")


def test_a_stream_that_ends_early_is_found() -> None:
    known = reference("demo")
    assert differences(known, known[:-1]) == [f"{len(known)} entries became {len(known) - 1}"]


def test_only_so_near_to_the_threshold_the_verdict_may_turn() -> None:
    was = {"n": 1, "verdict": "slip", "verdict_code": 2, "p_slip": 0.50005}
    now = was | {"verdict": "stable", "verdict_code": 1, "p_slip": 0.49998}
    assert differences([was], [now]) == []
    far = was | {"p_slip": 0.52}
    assert differences([far], [far | {"verdict": "stable"}]) != []
