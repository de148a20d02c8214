"""Clients in a program that forks, and in one that gets signals."""

from __future__ import annotations

import os
import traceback
from pathlib import Path

from deploy.clients.python.graspd_client import Client, Decision, Verdict
from tests.clients.building import asked, compiled_probe

HOURS_S = 1e6


def test_a_forked_process_is_told_so_at_once(tmp_path: Path) -> None:
    with Client(f"ipc://{tmp_path}/out", ask_endpoint=f"ipc://{tmp_path}/ask") as graspd:
        graspd.verdict(0.05)
        child = os.fork()
        if child == 0:
            code = 1
            try:
                check_that_it_says_so(graspd)
                code = 0
            finally:
                traceback.print_exc()
                os._exit(code)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert graspd.verdict(0.05).reasons == ("no-message",)


def check_that_it_says_so(graspd: Client) -> None:
    said = Verdict(Decision.UNKNOWN, ("other-process",))
    assert graspd.verdict(HOURS_S) == said
    assert graspd.may_i_lift(HOURS_S).verdict == said
    assert graspd.wait_for_slide(HOURS_S).verdict == said
    assert graspd.wait_for_grasp(HOURS_S) is None
    lifted = Verdict(Decision.STABLE, boot_id="a", grasp=1)
    assert graspd.tell(lifted, "held", wait_s=HOURS_S).why == "other-process"
    graspd.close()


def test_in_cpp_signals_end_no_call_and_a_fork_is_told_so() -> None:
    result = asked(compiled_probe("signals"), 100)
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.splitlines() == [
        *["unknown other-process"] * 3,
        "0",
        "other-process",
        "status 0",
    ]
