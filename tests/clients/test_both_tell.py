"""Both clients tell outcomes to a daemon that answers what it should not."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
import zmq

from deploy.clients.python.graspd_client import (
    Client,
    Decision,
    Outcome,
    OutcomeAnswer,
    Verdict,
)
from tests.clients.building import Probe, asked
from tests.clients.messages import verdict
from tests.clients.test_both_ask import DEADLINE_S, PERIOD_MS, false_daemon, says_no, told
from tests.threads import at_work

BOOT = "0f0e0d0c0b0a09080706050403020100"
LIFTED_ON = Verdict(Decision.STABLE, grasp=42, boot_id=BOOT)


@contextmanager
def heard(folder: Path, frames: Sequence[bytes]) -> Iterator[list[bytes]]:
    """What is told to a daemon that answers so, or not at all."""
    found: list[bytes] = []
    with zmq.Context() as context, context.socket(zmq.ROUTER) as door:
        door.linger = 0
        door.bind(f"ipc://{folder}/ask")

        def listen(stop: threading.Event) -> None:
            while not stop.is_set():
                if door.poll(PERIOD_MS):
                    who, *words = door.recv_multipart()
                    found.extend(words)
                    if frames:
                        door.send_multipart([who, *frames])

        with at_work(listen):
            yield found


def told_in_python(folder: Path, name: str | None) -> OutcomeAnswer:
    with Client(f"ipc://{folder}/out", ask_endpoint=f"ipc://{folder}/ask") as graspd:
        return graspd.tell(LIFTED_ON, Outcome.SLIPPED, name)


def told_in_cpp(lift_gate: Path, folder: Path, *words: str) -> tuple[int, str]:
    """Exit code and what it says."""
    places = [f"ipc://{folder}/out", f"ipc://{folder}/ask"]
    result = asked(lift_gate, "--tell", *places, *words)
    return result.returncode, (result.stdout + result.stderr).splitlines()[0]


TAKEN: dict[str, tuple[list[bytes], str]] = {
    "taken": ([b'{"v":1,"ok":true}'], ""),
    "with a later field": ([b'{"v":1,"ok":true,"later":[1]}'], ""),
    "refused": ([b'{"v":1,"ok":false,"why":"unknown grasp: no"}'], "unknown grasp: no"),
    "not kept": ([b'{"v":1,"ok":false,"why":"not kept: no room"}'], "not kept: no room"),
    "of a later version": ([b'{"v":2,"ok":true}'], "version"),
    "refused without why": ([b'{"v":1,"ok":false}'], "malformed"),
    "refused with a number": ([b'{"v":1,"ok":false,"why":1}'], "malformed"),
    "a verdict": ([json.dumps(verdict()).encode()], "malformed"),
    "not JSON": ([b"yes"], "malformed"),
    "empty": ([b""], "malformed"),
    "of two frames": ([b'{"v":1,"ok":true}'] * 2, "malformed"),
    "nothing": ([], "no-answer"),
}


@pytest.mark.parametrize(("frames", "why"), TAKEN.values(), ids=TAKEN)
def test_an_outcome_is_taken_only_if_the_answer_says_so(
    lift_gate: Path, tmp_path: Path, frames: list[bytes], why: str
) -> None:
    with heard(tmp_path, frames) as found:
        answer = told_in_python(tmp_path, "mug")
        assert (bool(answer), answer.why) == (not why, why)
        code, text = told_in_cpp(lift_gate, tmp_path, BOOT, "42", "slip", "mug")
        assert (code, text) == (1 if why else 0, why or "taken")
    assert found == [f"outcome {BOOT} 42 slip mug".encode()] * 2


@pytest.mark.parametrize("name", [None, "035_power-drill", "_Z.a-9", "x" * 64])
def test_an_outcome_has_the_object_as_it_was_given(
    lift_gate: Path, tmp_path: Path, name: str | None
) -> None:
    with heard(tmp_path, [b'{"v":1,"ok":true}']) as found:
        assert told_in_python(tmp_path, name)
        given = [] if name is None else [name]
        assert told_in_cpp(lift_gate, tmp_path, BOOT, "42", "slip", *given)[0] == 0
    assert found == [" ".join(["outcome", BOOT, "42", "slip", *given]).encode()] * 2


@pytest.mark.parametrize("name", ["a mug", "mug,cup", "müg", "mug\n", "x" * 65, "=1", "a/b"])
def test_a_malformed_object_name_is_not_sent(lift_gate: Path, tmp_path: Path, name: str) -> None:
    with heard(tmp_path, [b'{"v":1,"ok":true}']) as found:
        with pytest.raises(ValueError, match="no name of an object: 1 to 64 ASCII letters, "):
            told_in_python(tmp_path, name)
        code, text = told_in_cpp(lift_gate, tmp_path, BOOT, "42", "slip", name)
        assert (code, "no name of an object" in text, "1 to 64 ASCII" in text) == (2, True, True)
    assert found == []


def test_an_outcome_needs_a_grasp_an_endpoint_and_a_client(tmp_path: Path) -> None:
    asking = Client(f"ipc://{tmp_path}/out", ask_endpoint=f"ipc://{tmp_path}/ask")
    with asking as graspd, pytest.raises(ValueError, match="of no grasp"):
        graspd.tell(graspd.verdict(), Outcome.SLIPPED)
    assert asking.tell(LIFTED_ON, Outcome.SLIPPED).why == "closed"
    with Client(f"ipc://{tmp_path}/out") as graspd, pytest.raises(ValueError, match="ask_endpoint"):
        graspd.tell(LIFTED_ON, Outcome.SLIPPED)


def test_a_told_grasp_is_offered_no_more_in_either_language(probe: Probe, tmp_path: Path) -> None:
    places = [f"ipc://{tmp_path}/out", f"ipc://{tmp_path}/ask"]
    with false_daemon(tmp_path, told()), Client(places[0], ask_endpoint=places[1]) as graspd:
        assert graspd.tell(graspd.may_i_lift(30.0).verdict, Outcome.SLIPPED, wait_s=30.0)
        says_no(lambda: graspd.may_i_lift(DEADLINE_S, supervised=True), "outcome-told")
        probe.tell("client", *places)
        assert probe.ask("lift").startswith("1 1 ")
        assert probe.ask("slipped") == "told"
        assert probe.ask("watch", DEADLINE_S).startswith("0 ")


def test_cpp_counts_and_warns_of_lifts_never_told(probe: Probe, tmp_path: Path) -> None:
    grasps: dict[str, bool] = {}
    warned = []
    with false_daemon(tmp_path, told(), messages_each=10):
        probe.tell("client", f"ipc://{tmp_path}/out", f"ipc://{tmp_path}/ask")
        while len(grasps) < 24:
            tell = len(grasps) % 4 == 3
            line = probe.ask("lift").split()
            while line[0] == "warn":
                warned.append(line[1])
                line = probe.line().split()
            may, grasp, unreported = line
            assert may == "1"
            before = [told_of for each, told_of in grasps.items() if each != grasp]
            assert int(unreported) == before.count(False)
            grasps[grasp] = grasps.get(grasp, False) or tell
            assert not tell or probe.ask("tell") == "told"
    assert warned == ["1", "11"]
