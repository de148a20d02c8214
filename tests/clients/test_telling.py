"""Both clients report how a lift ended, to a stand-in daemon with right and wrong answers."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from deploy.clients.python.graspd_client import Client, Decision, Outcome, Verdict
from tests.clients.either import Connect, Grasp
from tests.clients.false_daemon import TAKEN, false_daemon, of, told
from tests.clients.messages import TEACHES, verdict
from tests.clients.test_both import DEADLINE_S, LONG_S
from tests.conftest import ROOT
from tests.kit.programs import ran
from tests.kit.waiting import wait_until

PYTHON = ROOT / "deploy" / "clients" / "python"
LIFTED_ON = Grasp("0f0e0d0c0b0a09080706050403020100", 42)
ANSWERED_S = 0.5
"""Longest time until an answer of the stand-in arrives, s."""
ANSWERS: dict[str, tuple[list[bytes], str]] = {
    "taken": ([TAKEN], ""),
    "with a later field": ([b'{"v":1,"ok":true,"later":[1]}'], ""),
    "refused": ([b'{"v":1,"ok":false,"why":"unknown grasp: no"}'], "unknown grasp: no"),
    "of a later version": ([b'{"v":2,"ok":true}'], "version"),
    "refused without why": ([b'{"v":1,"ok":false}'], "malformed"),
    "refused with a number": ([b'{"v":1,"ok":false,"why":1}'], "malformed"),
    "a verdict": ([json.dumps(verdict()).encode()], "malformed"),
    "not JSON": ([b"yes"], "malformed"),
    "empty": ([b""], "malformed"),
    "of two frames": ([TAKEN] * 2, "malformed"),
    "nothing": ([], "no-answer"),
}


@pytest.mark.parametrize(("frames", "why"), ANSWERS.values(), ids=ANSWERS)
def test_an_outcome_is_accepted_only_if_the_answer_says_so(
    connect: Connect, tmp_path: Path, frames: Sequence[bytes], why: str
) -> None:
    with false_daemon(tmp_path, taken=frames) as heard:
        wait_s = LONG_S if frames else DEADLINE_S
        assert connect(tmp_path).tell(LIFTED_ON, "slip", "mug", wait_s) == why
    assert heard == [f"outcome {LIFTED_ON.boot_id} 42 slip mug".encode()]


@pytest.mark.parametrize("name", [None, "035_power-drill", "_Z.a-9", "x" * 64])
def test_an_outcome_carries_the_objects_name_unchanged(
    connect: Connect, tmp_path: Path, name: str | None
) -> None:
    with false_daemon(tmp_path) as heard:
        assert connect(tmp_path).tell(LIFTED_ON, "slip", name) == ""
    assert heard == [f"outcome {LIFTED_ON.boot_id} 42 slip {name or ''}".rstrip().encode()]


@pytest.mark.parametrize("name", ["a mug", "mug,cup", "müg", "mug\n", "x" * 65, "=1", "a/b"])
def test_a_malformed_object_name_is_not_sent(connect: Connect, tmp_path: Path, name: str) -> None:
    with false_daemon(tmp_path) as heard:
        with pytest.raises(ValueError, match="no name of an object: 1 to 64 ASCII letters, "):
            connect(tmp_path).tell(LIFTED_ON, "slip", name)
        assert heard == []


def test_an_outcome_needs_grasp_ask_endpoint_and_open_client(tmp_path: Path) -> None:
    lifted_on = Verdict(Decision.STABLE, grasp=42, boot_id="a" * 32)
    asking = Client(f"ipc://{tmp_path}/out", ask_endpoint=f"ipc://{tmp_path}/ask")
    with asking as graspd, pytest.raises(ValueError, match="of no grasp"):
        graspd.tell(graspd.verdict(), Outcome.SLIPPED)
    assert asking.tell(lifted_on, Outcome.SLIPPED).why == "closed"
    with Client(f"ipc://{tmp_path}/out") as graspd, pytest.raises(ValueError, match="ask_endpoint"):
        graspd.tell(lifted_on, Outcome.SLIPPED)


def test_a_grasp_with_an_outcome_is_not_offered_again(connect: Connect, tmp_path: Path) -> None:
    with false_daemon(tmp_path):
        graspd = connect(tmp_path)
        assert graspd.tell(graspd.lift(LONG_S).grasp, "slip") == ""
        told = ("outcome-told",)
        wait_until(lambda: graspd.lift(DEADLINE_S, supervised=True).reasons == told)
        assert graspd.grasp(DEADLINE_S) is None


def test_a_grasp_reported_as_not_lifted_is_offered_again(connect: Connect, tmp_path: Path) -> None:
    grasp = [1]
    with false_daemon(tmp_path, grasp=lambda _: grasp[0]) as heard:
        graspd = connect(tmp_path)
        assert graspd.tell(graspd.lift(LONG_S).grasp, "not-lifted") == ""
        assert heard[-1].endswith(b" 1 not-lifted")
        assert graspd.lift(LONG_S).may
        assert graspd.unreported == 0
        grasp[0] = 2
        wait_until(lambda: graspd.lift(LONG_S).grasp.number == 2)
        assert graspd.unreported == 1, "the second lift of the first grasp"


def test_an_answer_that_came_after_tell_counts_at_the_next_tell(
    connect: Connect, tmp_path: Path
) -> None:
    grasp = [1]
    with false_daemon(tmp_path, grasp=lambda _: grasp[0]) as heard:
        graspd = connect(tmp_path)
        first = graspd.lift(LONG_S).grasp
        grasp[0] = 2
        wait_until(lambda: (second := graspd.lift(LONG_S)).may and second.grasp != first)
        graspd.tell(first, "slip", wait_s=0.0)
        wait_until(lambda: b" 1 slip" in heard[-1])
        time.sleep(ANSWERED_S)
        assert graspd.tell(first._replace(number=2), "slip") == ""
        graspd.lift(DEADLINE_S)
        assert graspd.unreported == 0


def test_an_outcome_that_graspd_cannot_keep_stays_unreported(
    connect: Connect, tmp_path: Path
) -> None:
    not_kept = b'{"v":1,"ok":false,"why":"not kept: No space left on device"}'
    with false_daemon(tmp_path, taken=[not_kept], messages_each=10):
        graspd = connect(tmp_path)
        first = graspd.lift(LONG_S).grasp
        assert graspd.tell(first, "slip") == "not kept: No space left on device"
        wait_until(lambda: graspd.lift(LONG_S).grasp != first)
        assert graspd.unreported > 0


def test_lifts_without_an_outcome_are_counted_and_warned_of(
    connect: Connect, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    lifted: dict[Grasp, bool] = {}
    with false_daemon(tmp_path, messages_each=10):
        graspd = connect(tmp_path)
        while len(lifted) < 24:
            tell = len(lifted) % 4 == 3
            said = graspd.lift(LONG_S)
            assert said.may
            before = [told for each, told in lifted.items() if each != said.grasp]
            assert graspd.unreported == before.count(False)
            lifted[said.grasp] = lifted.get(said.grasp, False) or tell
            assert not tell or graspd.tell(said.grasp, "slip") == ""
    assert caplog.messages + graspd.warned == [
        f"{number} lifts were allowed, and their outcome not told" for number in (1, 11)
    ]


@pytest.mark.parametrize(
    ("typed", "told"), [("held", "stable"), ("mist\nslipped", "slip"), ("", "not-lifted")]
)
def test_lift_gate_reports_the_typed_outcome_or_not_lifted(
    lift_gate: Path, tmp_path: Path, typed: str, told: str
) -> None:
    with false_daemon(tmp_path) as heard:
        words = f"ipc://{tmp_path}/out", LONG_S, f"ipc://{tmp_path}/ask", "mug"
        result = ran(lift_gate, *words, typed=typed)
    assert (result.returncode, result.stdout[-6:]) == (0, "taken\n")
    assert heard[-1].split()[2:] == [b"1", told.encode(), b"mug"]


def test_the_example_controller_reports_a_supervised_unknown_grasp(tmp_path: Path) -> None:
    code = (PYTHON / "try_outcomes.py").read_text()
    for place, name in (("/tmp/graspd-loop.ask.ipc", "ask"), ("/tmp/graspd-loop.ipc", "out")):
        code = code.replace(f"ipc://{place}", f"ipc://{tmp_path}/{name}")
    refusals = iter([of("slip")])

    def answer(published: dict[str, Any]) -> list[bytes]:
        return next(refusals, told())(published)

    with false_daemon(tmp_path, answer, "unknown", messages_each=100, **TEACHES) as heard:
        controller = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "PYTHONPATH": str(PYTHON)},
            input="h\n",  # and then the input ends
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    assert (controller.returncode, controller.stderr) == (0, "")
    refused, lifted = controller.stdout.splitlines()[:2]
    assert refused == "do not lift: slip"
    assert re.match(r"grasp \d+: unknown, p_slip not known Risk\(", lifted)
    outcomes = [each.split()[3:] for each in heard if each.startswith(b"outcome ")]
    assert outcomes == [[b"stable", b"mug"], [b"not-lifted", b"mug"]]
