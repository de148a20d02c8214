"""Clients in a program that forks, has threads, or gets signals."""

from __future__ import annotations

import pickle
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import zmq

from deploy.clients.python.graspd_client import Client
from tests.clients.building import compiled_probe
from tests.clients.false_daemon import false_daemon
from tests.conftest import ROOT
from tests.kit.programs import ran

HOURS_S, LIMIT_S = 1e6, 60.0

FORKS = """
import asyncio, os, sys
from deploy.clients.python.graspd_client import AsyncClient, Client, Decision, Verdict

HOURS_S = 1e6
out, ask = sys.argv[1:]
lifted = Verdict(Decision.STABLE, boot_id="a", grasp=1)


def refused(call):
    try:
        answer = call()
        if asyncio.iscoroutine(answer):
            asyncio.run(answer)
    except RuntimeError as error:
        return f"of process {os.getppid()}: make another one" in str(error)
    return False


other = AsyncClient(out, ask_endpoint=ask)
with Client(out, ask_endpoint=ask) as graspd:
    assert graspd.may_i_lift(HOURS_S)
    child = os.fork()
    if child == 0:
        for client in (graspd, other):
            assert refused(lambda: client.verdict())
            assert refused(lambda: client.verdict(HOURS_S))
            assert refused(lambda: client.may_i_lift(HOURS_S))
            assert refused(lambda: client.wait_for_slide(HOURS_S))
            assert refused(lambda: client.wait_for_grasp(HOURS_S))
            assert refused(lambda: client.tell(lifted, "held", wait_s=HOURS_S))
            client.close()
        with Client(out, ask_endpoint=ask) as own:
            assert own.may_i_lift(HOURS_S)
        sys.exit()
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert graspd.may_i_lift(HOURS_S)
    assert graspd.counts.restarts == 0
"""
"""Program whose forked child uses the parent's clients and its own and exits; then the parent."""


def test_in_a_forked_process_the_parents_clients_raise_at_once(tmp_path: Path) -> None:
    places = [f"ipc://{tmp_path}/{end}" for end in ("out", "ask")]
    with false_daemon(tmp_path):
        subprocess.run([sys.executable, "-c", FORKS, *places], check=True, cwd=ROOT, timeout=60)


DROPPED = """
import asyncio, gc, sys
from deploy.clients.python.graspd_client import AsyncClient, Client

place, loop = sys.argv[1], asyncio.new_event_loop()
dropped, left, closed = Client(place), AsyncClient(place), AsyncClient(place)
dropped.verdict(0.05)
waiting = [loop.create_task(each.wait_for_grasp(1e6)) for each in (left, closed)]
loop.call_later(0.05, loop.stop)
loop.run_forever()
loop.close()
closed.close()
del dropped, left, closed, loop, waiting
gc.collect()
"""
"""Program that drops two clients unclosed, and closes one after its event loop has ended."""


def test_a_program_that_drops_clients_unclosed_still_ends(tmp_path: Path) -> None:
    place = f"ipc://{tmp_path}/out"
    subprocess.run([sys.executable, "-c", DROPPED, place], check=True, cwd=ROOT, timeout=60)


def test_pickling_a_client_raises_a_type_error(tmp_path: Path) -> None:
    with (
        Client(f"ipc://{tmp_path}/out") as graspd,
        pytest.raises(TypeError, match="make one in each process"),
    ):
        pickle.dumps(graspd)


def test_during_a_call_another_thread_may_only_close_the_client(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits, poll = threading.Event(), zmq.zmq_poll

    def noted(*given: Any) -> object:  # noqa: ANN401
        waits.set()
        return poll(*given)

    monkeypatch.setattr(zmq, "zmq_poll", noted)
    with ThreadPoolExecutor(1) as other, Client(f"ipc://{tmp_path}/out") as graspd:
        lifting = other.submit(graspd.may_i_lift, HOURS_S)
        assert waits.wait(LIMIT_S)
        with pytest.raises(RuntimeError, match="one call at a time"):
            graspd.verdict()
        graspd.close()
        assert lifting.result().verdict.reasons == ("closed",)
        assert graspd.verdict().reasons == ("closed",)


def test_cpp_survives_signals_and_refuses_after_a_fork() -> None:
    result = ran(compiled_probe("signals"), 100)
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.splitlines() == [
        *["unknown other-process"] * 3,
        "0",
        "other-process",
        "status 0",
    ]
