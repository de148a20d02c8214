"""The answers of graspd to known input equal the stored references, within a stated tolerance."""

from __future__ import annotations

import pytest

from tests.process_replay import commands, messages, verdicts
from tests.process_replay.__main__ import KINDS, SHOWN_MAX
from tests.process_replay.commands import lines_apart
from tests.process_replay.verdicts import entries_apart, reference

SLOW = ("can_log",)
"""Names of the references that take many seconds to make."""
ALL = [
    pytest.param(kind, name, marks=pytest.mark.slow if name in SLOW else ())
    for kind in KINDS
    for name in KINDS[kind].NAMES
]


@pytest.mark.parametrize(("kind", "name"), ALL)
def test_known_input_gives_the_output_stored_in_its_reference_file(kind: str, name: str) -> None:
    net = KINDS[kind]
    found = net.differences(net.path_of(name).read_text(), net.made(name))
    advice = "if that is meant, `python -m tests.process_replay --renew`"
    assert not found, "\n".join([*found[:SHOWN_MAX], advice])


def test_every_stored_reference_file_is_compared() -> None:
    known = {net.path_of(name) for net in KINDS.values() for name in net.NAMES}
    assert set(verdicts.FOLDER.rglob("*.*")) == known


def test_every_stored_verdict_reference_has_a_judged_grasp() -> None:
    for name in verdicts.NAMES:
        assert any(entry["judged"] and entry["valid"] for entry in reference(name)), name
    said = {entry["verdict"] for entry in reference("demo")}
    assert said >= {"stable", "slip", "unknown"}


def test_the_references_show_faults_overload_outcomes_and_exit_codes() -> None:
    repaired = {name for entry in reference("twin_faults") for name in entry["repaired"]}
    assert {"ff_7", "th_16"} <= repaired  # those that the twin's faults name, counted from 1
    slow = messages.path_of("slow").read_text()
    assert '"overloaded":true' in slow
    assert '"stale"' in slow
    assert slow.rpartition('"skipped_readings":')[2].partition(",")[0] != "0"
    lines = messages.path_of("request_risk").read_text().splitlines()
    answers = {line.partition(": ")[2].partition(":")[0] for line in lines if " answer " in line}
    assert answers == {"None", "contradicts", "unknown boot_id"}
    texts = "".join(commands.path_of(name).read_text() for name in commands.NAMES)
    assert all(f"\nexit code {code}\n" in texts for code in (0, 1, 2))


def test_a_changed_verdict_is_found_by_the_comparison() -> None:
    was = [entry for entry in reference("demo") if entry.get("p_slip") is not None][:2]
    for field, value in (("verdict", "none"), ("p_slip", 0.7), ("n", 3), ("reasons", ["moving"])):
        (line,) = entries_apart(was, [was[0], was[1] | {field: value}])
        assert line.startswith(f"1: {field}: ")
    assert entries_apart(was, was[:1]) == ["2 entries became 1"]


def test_verdicts_may_differ_only_close_to_the_threshold() -> None:
    was = {"n": 1, "verdict": "slip", "verdict_code": 2, "p_slip": 0.50005}
    now = was | {"verdict": "stable", "verdict_code": 1, "p_slip": 0.49998}
    assert entries_apart([was], [now]) == []
    far = was | {"p_slip": 0.52}
    assert entries_apart([far], [far | {"verdict": "stable"}]) != []


def test_only_decimal_numbers_may_differ_slightly() -> None:
    was = '1 verdict {"seq":3,"p_slip":0.25,"gate":null}'
    for before, after, differs in (
        ("0.25", "0.2501", False),
        ("0.25", "0.2509", True),
        ("3", "4", True),
        ("0.25", "null", True),
    ):
        now = was.replace(f":{before},", f":{after},")
        assert bool(lines_apart([was], [now], 2e-4)) == differs
