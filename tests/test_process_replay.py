"""What graspd says of known input is what it was, within a tolerance that is stated."""

from __future__ import annotations

import copy

import pytest

from tests.process_replay import commands, messages, verdicts
from tests.process_replay.__main__ import KINDS, SHOWN_MAX
from tests.process_replay.commands import lines_apart
from tests.process_replay.verdicts import P_SLIP_TOLERANCE, entries_apart, is_near, reference

ALL = [(kind, name) for kind in KINDS for name in KINDS[kind].NAMES]


@pytest.mark.parametrize(("kind", "name"), ALL)
def test_known_input_gets_the_answer_that_it_had(kind: str, name: str) -> None:
    net = KINDS[kind]
    found = net.differences(net.path_of(name).read_text(), net.made(name))
    advice = "if that is meant, `python -m tests.process_replay --renew`"
    assert not found, "\n".join([*found[:SHOWN_MAX], advice])


def test_every_reference_is_compared() -> None:
    known = {net.path_of(name) for net in KINDS.values() for name in net.NAMES}
    assert set(verdicts.FOLDER.rglob("*.*")) == known


@pytest.mark.parametrize("name", ["demo", "twin_faults", "request_risk", "mcap", "serial_log"])
def test_a_reference_has_judged_and_unjudged_grasps(name: str) -> None:
    known = reference(name)
    assert sum(entry["n"] for entry in known) > 2500  # readings of the demo recording: 2836
    assert {entry["verdict"] for entry in known} >= {"stable", "slip", "unknown"}
    assert sum(entry["judged"] for entry in known) >= 12  # grasps of the demo recording


@pytest.mark.parametrize("name", verdicts.NAMES)
def test_every_reference_judges_some_grasp(name: str) -> None:
    assert any(entry["judged"] and entry["valid"] for entry in reference(name))


def test_a_replayed_recording_is_judged_as_before() -> None:
    assert verdicts.path_of("mcap").read_text() == verdicts.path_of("request_risk").read_text()


def test_under_faults_electrodes_are_repaired() -> None:
    repaired = {name for entry in reference("twin_faults") for name in entry["repaired"]}
    assert {"ff_7", "th_16"} <= repaired  # those that the twin's faults name, counted from 1


def test_a_slow_computer_skips_readings_is_overloaded_and_late() -> None:
    text = messages.path_of("slow").read_text()
    assert '"overloaded":true' in text
    assert '"stale"' in text
    assert text.rpartition('"skipped_readings":')[2].partition(",")[0] != "0"


def test_outcomes_are_taken_and_refused_in_the_references() -> None:
    lines = messages.path_of("request_risk").read_text().splitlines()
    answers = {line.partition(": ")[2].partition(":")[0] for line in lines if " answer " in line}
    assert answers == {"None", "contradicts", "unknown boot_id"}


@pytest.mark.parametrize("code", [0, 1, 2])
def test_the_references_have_each_exit_code(code: int) -> None:
    texts = [commands.path_of(name).read_text() for name in commands.NAMES]
    assert any(f"\nexit code {code}\n" in text for text in texts)


def test_no_reference_is_near_the_threshold() -> None:
    for name in verdicts.NAMES:
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
    (line,) = entries_apart(was, now)
    assert line.startswith(f"1: {field}: ")


def test_a_stream_that_ends_early_is_found() -> None:
    known = reference("demo")
    assert entries_apart(known, known[:-1]) == [f"{len(known)} entries became {len(known) - 1}"]


def test_only_so_near_to_the_threshold_the_verdict_may_turn() -> None:
    was = {"n": 1, "verdict": "slip", "verdict_code": 2, "p_slip": 0.50005}
    now = was | {"verdict": "stable", "verdict_code": 1, "p_slip": 0.49998}
    assert entries_apart([was], [now]) == []
    far = was | {"p_slip": 0.52}
    assert entries_apart([far], [far | {"verdict": "stable"}]) != []


def test_a_reference_reads_as_it_was_written() -> None:
    text = (
        '{"n": 2, "grasp": 1, "gate": "idle", "p_slip": 0.25}\n'
        '{"n": 1, "p_slip": null}\n'
        '{"n": 1, "grasp": 2}\n'
    )
    assert verdicts.parsed(text) == [
        {"n": 2, "grasp": 1, "gate": "idle", "p_slip": 0.25},
        {"n": 1, "grasp": 1, "gate": "idle"},
        {"n": 1, "grasp": 2, "gate": "idle"},
    ]


@pytest.mark.parametrize(
    ("now", "differs"),
    [
        ('1 verdict {"seq":3,"p_slip":0.2501,"gate":null}', False),
        ('1 verdict {"seq":3,"p_slip":0.2509,"gate":null}', True),
        ('1 verdict {"seq":4,"p_slip":0.25,"gate":null}', True),
        ('1 verdict {"p_slip":0.25,"seq":3,"gate":null}', True),
        ('1 verdict {"seq":3,"p_slip":0.25, "gate":null}', True),
        ('1 verdict {"seq":3,"p_slip":null,"gate":null}', True),
    ],
)
def test_only_numbers_with_a_point_may_differ_slightly(now: str, *, differs: bool) -> None:
    was = '1 verdict {"seq":3,"p_slip":0.25,"gate":null}'
    assert bool(lines_apart([was], [now], 2e-4)) == differs
