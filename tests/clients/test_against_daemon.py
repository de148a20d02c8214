"""Both clients against daemons in processes of their own."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import zmq

from deploy.clients.python.graspd_client import Client, Keys, Outcome, Verdict
from graspd.daemon.publish.keys import make
from graspd.daemon.publish.messages import decode_outcome
from tests.clients.bench import Daemon, free_endpoint
from tests.clients.building import sleep_at_will
from tests.clients.messages import frames, verdict
from tests.kit.programs import ran
from tests.kit.waiting import wait_until

pytestmark = pytest.mark.slow


@contextmanager
def watching(lift_gate: Path, *words: str | Path) -> Iterator[subprocess.Popen[str]]:
    """Run `lift_gate --watch`, then `words`, during the block; yield the process."""
    command = [lift_gate, "--watch", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def line_with(process: subprocess.Popen[str], *wanted: str) -> list[str]:
    """Read lines up to the first that has any of `wanted`; return that line's words."""
    assert process.stdout is not None
    while True:
        words = process.stdout.readline().split()
        assert words, "it has ended"
        if set(wanted) & set(words):
            return words


def boot_id(words: list[str]) -> str:
    return words[words.index("boot") + 1]


def test_over_tcp_without_a_shared_clock_a_lift_is_allowed(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with (
        Daemon(tmp_path, endpoint=endpoint) as daemon,
        Client(endpoint, ask_endpoint=daemon.ask_endpoint, same_computer=False) as graspd,
    ):
        wait_until(lambda: bool(graspd.may_i_lift(1.0)))
        assert (graspd.counts.lost, graspd.counts.malformed) == (0, 0)


def test_early_verdicts_allow_lifts_unless_stillness_is_required(
    lift_gate: Path, tmp_path: Path
) -> None:
    with (
        Daemon(tmp_path, "[gate]\nearly = true\n", whole_grasps=True) as daemon,
        Client(daemon.endpoint) as graspd,
    ):
        for still_ms, early in ((None, True), (240.0, False)):

            def may_i_lift(still_ms: float | None = still_ms, early: bool = early) -> bool:
                answer = graspd.may_i_lift(1.0, still_ms=still_ms)
                assert still_ms is None or not (answer and answer.verdict.early)
                assert not answer or (answer.verdict.still_ms or 0.0) >= (still_ms or 100.0)
                return bool(answer) and answer.verdict.early == early

            wait_until(may_i_lift)
        words = "--still", 240, daemon.endpoint, 1.0
        wait_until(lambda: "\nlift after" in ran(lift_gate, *words).stdout)


def test_a_lifts_outcome_is_published_once_and_contradictions_are_refused(
    lift_gate: Path, tmp_path: Path
) -> None:
    with (
        Daemon(tmp_path, whole_grasps=True) as daemon,
        Client(daemon.endpoint, ask_endpoint=daemon.ask_endpoint) as graspd,
        zmq.Context() as context,
        context.socket(zmq.SUB) as listener,
    ):
        listener.linger = 0
        listener.connect(daemon.endpoint)
        for topic in ("outcome.right", "verdict.right"):
            listener.subscribe(topic)
        assert listener.poll(100_000)  # so its first subscription has been taken, too
        lifted: list[Verdict] = []

        def may_i_lift() -> bool:
            answer = graspd.may_i_lift(1.0)
            lifted.append(answer.verdict)
            return bool(answer)

        wait_until(may_i_lift)
        lifted_on = lifted[-1]
        tell = "--tell", daemon.endpoint, daemon.ask_endpoint, lifted_on.boot_id, lifted_on.grasp
        refused = ran(lift_gate, *tell, "stable")
        assert (refused.returncode, refused.stdout[:9]) == (1, "not yours")
        for _ in range(2):
            assert graspd.tell(lifted_on, Outcome.SLIPPED, "mug", wait_s=10.0)
        contradicts = graspd.tell(lifted_on, Outcome.HELD, wait_s=10.0)
        assert contradicts.why.startswith("contradicts")
        never = replace(lifted_on, grasp=10**9)
        assert graspd.tell(never, Outcome.SLIPPED, wait_s=10.0).why.startswith("unknown grasp")
        listener.unsubscribe("verdict.right")
        heard = []
        while listener.poll(1000):
            heard.append(listener.recv_multipart())
    (told,) = [decode_outcome(payload) for topic, payload in heard if topic == b"outcome.right"]
    assert (told.outcome, told.object) == ("slip", "mug")
    assert (told.boot_id, told.grasp) == (lifted_on.boot_id, lifted_on.grasp)


def test_lift_gate_reports_the_typed_outcome_of_its_lift(lift_gate: Path, tmp_path: Path) -> None:
    with Daemon(tmp_path, whole_grasps=True) as daemon:
        words = "--supervised", daemon.endpoint, 1.0, daemon.ask_endpoint, "mug"
        wait_until(lambda: ran(lift_gate, *words, typed="slipped").stdout.endswith("taken\n"))


def test_after_a_daemons_kill_verdicts_are_unknown_until_its_restart(tmp_path: Path) -> None:
    with Daemon(tmp_path) as daemon, Client(daemon.endpoint, max_age_ms=1e6) as graspd:
        wait_until(lambda: graspd.verdict(0.1).p_slip is not None)
        former = graspd.verdict().boot_id
        daemon.kill()
        wait_until(lambda: graspd.verdict().reasons == ("silent",))
        assert (graspd.verdict().decision, graspd.verdict().boot_id) == ("unknown", former)
        daemon.start()
        wait_until(lambda: graspd.verdict(0.1).p_slip is not None)
        assert graspd.verdict().boot_id != former  # nothing of before has come back


def test_the_cpp_client_reports_stalls_restarts_and_losses(lift_gate: Path, tmp_path: Path) -> None:
    with Daemon(tmp_path) as daemon, watching(lift_gate, daemon.endpoint) as watch:
        former = boot_id(line_with(watch, "stable", "slip"))
        daemon.send(signal.SIGSTOP)
        line_with(watch, "silent")
        daemon.send(signal.SIGCONT)
        line_with(watch, "stable", "slip")
        daemon.kill()
        line_with(watch, "silent")
        daemon.start()
        words = line_with(watch, "stable", "slip")
        assert boot_id(words) != former
        assert words[-2] == "lost"
        lost = words[-1]  # 0, where the computer is not too busy to read
        watch.send_signal(signal.SIGSTOP)
        time.sleep(5.5)  # longer than it may be without reading
        watch.send_signal(signal.SIGCONT)
        while line_with(watch, "stable", "slip")[-1] == lost:
            pass


def test_only_clients_with_keys_get_verdicts(lift_gate: Path, tmp_path: Path) -> None:
    public, secret = make(tmp_path, "daemon")
    own_public, own_secret = make(tmp_path / "clients", "lab")
    endpoint = free_endpoint()
    curve = f'[curve]\nsecret_key = "{secret}"\nclients = "{own_public.parent}"\n'
    with (
        Daemon(tmp_path, curve, endpoint=endpoint),
        Client(endpoint, keys=Keys.load(public, own_secret)) as admitted,
        Client(endpoint) as stranger,
    ):
        wait_until(lambda: admitted.verdict(0.1).p_slip is not None)
        with watching(lift_gate, endpoint, public, own_secret) as watch:
            line_with(watch, "stable", "slip")
        assert stranger.verdict(0.2).reasons == ("no-message",)
        assert ran(lift_gate, endpoint, 0.3).stdout.startswith("unknown [ no-message ]")
    with pytest.raises(ValueError, match="no secret key"):
        Keys.load(public, own_public)


def test_the_cpp_client_forgets_messages_after_the_computer_slept(
    lift_gate: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept, endpoint = sleep_at_will(tmp_path, monkeypatch), f"ipc://{tmp_path}/out"
    with (
        zmq.Context() as context,
        context.socket(zmq.XPUB) as out,
        watching(lift_gate, endpoint) as watch,
    ):
        out.linger = 0
        out.bind(endpoint)
        for seq in range(2):
            while out.recv()[:1] != b"\x01":  # it has subscribed, then reconnected
                pass
            message = verdict(seq, time.monotonic_ns(), "unknown", silence_ms=1e9)
            out.send_multipart(frames(message))
            line_with(watch, "moving", "stale")  # it is shown, on a busy machine as old
            if not slept.exists():
                slept.touch()
                line_with(watch, "slept")


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["ipc:///x"],
        ["ipc:///x", "-1"],
        ["ipc:///x", "0,5"],
        ["--still", "240ms", "ipc:///x", "1"],
        ["ipc:///x", "1", "ipc:///y", "a mug"],
        ["--tell", "ipc:///x", "ipc:///y", "a", "1.5", "held"],
        ["nowhere", "1"],
        ["--watch"],
    ],
)
def test_lift_gate_exits_with_2_on_a_wrong_command_line(lift_gate: Path, words: list[str]) -> None:
    result = ran(lift_gate, *words)
    assert result.returncode == 2
    assert "lift_gate" in result.stdout + result.stderr


def test_a_refused_endpoint_leaves_no_socket_open() -> None:
    with pytest.raises(zmq.ZMQError):
        Client("nowhere")
