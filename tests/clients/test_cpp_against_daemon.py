"""The C++ client against daemons in processes of their own."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zmq

from graspd.daemon.publish.keys import make
from tests.clients.bench import Daemon, free_endpoint
from tests.clients.building import asked, sleep_at_will
from tests.clients.messages import frames, verdict

pytestmark = pytest.mark.slow

MAY, MAY_NOT, WRONG = 0, 1, 2
"""Exit codes of `lift_gate`."""


def told(lift_gate: Path, *words: object) -> tuple[int, str]:
    """Exit code and output of one question."""
    result = asked(lift_gate, *words)
    return result.returncode, result.stdout + result.stderr


@contextmanager
def watching(lift_gate: Path, *words: str | Path) -> Iterator[subprocess.Popen[str]]:
    """`lift_gate --watch`, as long as the block lasts."""
    command = [lift_gate, "--watch", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def line_with(process: subprocess.Popen[str], *wanted: str) -> list[str]:
    """Words of the next line with one of these."""
    assert process.stdout is not None
    while True:
        words = process.stdout.readline().split()
        assert words, "it has ended"
        if set(wanted) & set(words):
            return words


def boot_id(words: list[str]) -> str:
    return words[words.index("boot") + 1]


def test_a_cpp_client_lifts_a_settled_grasp_either_way(lift_gate: Path, tmp_path: Path) -> None:
    with Daemon(tmp_path, whole_grasps=True) as daemon:
        for ask in ([daemon.ask_endpoint], []):
            code, text = MAY_NOT, ""
            while code == MAY_NOT:
                code, text = told(lift_gate, daemon.endpoint, 1.0, *ask)
                assert text.startswith("stable") == (code == MAY) == ("\nlift after" in text)
            assert code == MAY, text


def test_stopped_restarted_and_slow_it_says_so(lift_gate: Path, tmp_path: Path) -> None:
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


def test_only_who_has_keys_is_told(lift_gate: Path, tmp_path: Path) -> None:
    public, secret = make(tmp_path, "daemon")
    own_public, own_secret = make(tmp_path / "clients", "lab")
    endpoint = free_endpoint()
    curve = f'[curve]\nsecret_key = "{secret}"\nclients = "{own_public.parent}"\n'
    with Daemon(tmp_path, curve, endpoint=endpoint):
        with watching(lift_gate, endpoint, public, own_secret) as watch:
            line_with(watch, "stable", "slip")
        code, text = told(lift_gate, endpoint, 0.3)
    assert (code, text.startswith("unknown [ no-message ]")) == (MAY_NOT, True)


def test_cpp_trusts_nothing_from_before_a_sleep(
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
    "words", [[], ["ipc:///x"], ["ipc:///x", "-1"], ["nowhere", "1"], ["--watch"]]
)
def test_a_wrong_command_line_never_means_yes(lift_gate: Path, words: list[str]) -> None:
    code, text = told(lift_gate, *words)
    assert code == WRONG
    assert "lift_gate" in text
