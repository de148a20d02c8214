"""The Python client against daemons in processes of their own."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import zmq

from deploy.clients.python.graspd_client import Client, Keys, Outcome, Verdict
from graspd.daemon.publish.keys import make
from graspd.daemon.publish.messages import OutcomeMessage, decode_outcome
from tests.clients.bench import Daemon, free_endpoint
from tests.clients.building import asked
from tests.kit.waiting import wait_until

pytestmark = pytest.mark.slow


def test_a_python_client_lifts_a_settled_grasp_either_way(tmp_path: Path) -> None:
    with (
        Daemon(tmp_path, whole_grasps=True) as daemon,
        Client(daemon.endpoint) as listening,
        Client(daemon.endpoint, ask_endpoint=daemon.ask_endpoint) as asking,
        Client(daemon.endpoint, ask_endpoint=f"{daemon.ask_endpoint}.nobody") as unanswered,
    ):
        wait_until(lambda: bool(asking.may_i_lift(0.5)))
        wait_until(lambda: bool(listening.verdict(0.1)))
        wait_until(lambda: bool(unanswered.verdict(0.1)))
        answer = unanswered.may_i_lift(0.2)
        # Before it, what the hand does by now on a slow machine.
        assert (bool(answer), answer.verdict.reasons[-1]) == (False, "no-answer")
        assert answer.waited_s >= 0.2
        for client in (listening, asking):
            assert client.counts.messages > 0
            assert client.counts.malformed == 0


def test_a_client_on_another_computer_asks_for_the_clock(tmp_path: Path) -> None:
    with (
        Daemon(tmp_path, whole_grasps=True) as daemon,
        Client(daemon.endpoint, ask_endpoint=daemon.ask_endpoint, same_computer=False) as remote,
    ):

        def compared() -> bool:
            remote.verdict(0.1)
            return remote._newest._bound is not None  # noqa: SLF001

        wait_until(compared)
        wait_until(lambda: bool(remote.may_i_lift(0.5)))
        assert remote.counts.malformed == 0


def test_soon_or_sure_is_for_who_lifts_to_choose(tmp_path: Path) -> None:
    with (
        Daemon(tmp_path, "[gate]\nearly = true\n", whole_grasps=True) as daemon,
        Client(daemon.endpoint) as graspd,
    ):
        lifted = dict.fromkeys((None, 240.0), graspd.verdict())
        for still_ms, early in ((None, True), (240.0, False)):

            def may_i_lift(still_ms: float | None = still_ms, early: bool = early) -> bool:
                answer = graspd.may_i_lift(1.0, still_ms=still_ms)
                lifted[still_ms] = answer.verdict
                assert still_ms is None or not (answer and answer.verdict.early)
                return bool(answer) and answer.verdict.early == early

            wait_until(may_i_lift)
        soon, sure = lifted.values()
        assert 100.0 <= (soon.still_ms or 0.0) < 240.0 <= (sure.still_ms or 0.0)
        assert soon.motion is not None
        assert soon.motion_limits is not None
        assert set(soon.motion) == set(soon.motion_limits) == {"ff", "mf", "th"}
        assert graspd.counts.malformed == 0


def test_a_supervised_grasp_is_never_early(tmp_path: Path) -> None:
    sections = "[gate]\nearly = true\n[risk]\nmax_slip_when_stable = 0.1\nwarm_up = 50\n"
    with Daemon(tmp_path, sections, whole_grasps=True) as daemon, Client(daemon.endpoint) as graspd:
        said = [graspd.wait_for_grasp(30.0, supervised=True) for _ in range(2)]
        said += [graspd.may_i_lift(30.0, supervised=True).verdict]
    for verdict in said:
        assert verdict is not None
        assert verdict.supervised
        assert (verdict.still_ms or 0.0) >= 240.0


def test_how_a_lift_ended_is_told_to_all_who_listen(lift_gate: Path, tmp_path: Path) -> None:
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
        grasp = [str(lifted_on.boot_id), str(lifted_on.grasp)]
        tell = [str(lift_gate), "--tell", daemon.endpoint, daemon.ask_endpoint, *grasp, "stable"]
        refused = subprocess.run(tell, check=False, timeout=200, capture_output=True, text=True)
        assert (refused.returncode, refused.stdout[:9]) == (1, "not yours")
        assert graspd.tell(lifted_on, Outcome.SLIPPED, "mug", wait_s=10.0)
        assert graspd.tell(lifted_on, Outcome.SLIPPED, wait_s=10.0)
        contradicts = graspd.tell(lifted_on, Outcome.HELD, wait_s=10.0)
        assert contradicts.why.startswith("contradicts")
        heard: list[OutcomeMessage] = []
        verdicts = 0
        while verdicts < 20 or not heard:
            assert listener.poll(100_000)
            about, payload = listener.recv_multipart()
            verdicts += about == b"verdict.right"
            if about == b"outcome.right":
                heard.append(decode_outcome(payload))
        never = replace(lifted_on, grasp=10**9)
        assert graspd.tell(never, Outcome.SLIPPED, wait_s=10.0).why.startswith("unknown grasp")
    (told,) = heard  # what is told again is not published again
    assert (told.outcome, told.object) == ("slip", "mug")
    assert (told.boot_id, told.grasp) == (lifted_on.boot_id, lifted_on.grasp)


def test_the_program_that_asked_tells_how_it_ended(lift_gate: Path, tmp_path: Path) -> None:
    with Daemon(tmp_path, whole_grasps=True) as daemon:
        words = "--supervised", daemon.endpoint, 1.0, daemon.ask_endpoint, "mug"
        wait_until(lambda: asked(lift_gate, *words, typed="slipped").stdout.endswith("taken\n"))


def test_the_second_controller_learns_who_owns_the_grasp(lift_gate: Path, tmp_path: Path) -> None:
    with Daemon(tmp_path, whole_grasps=True) as daemon:
        places = daemon.endpoint, daemon.ask_endpoint

        def in_cpp() -> tuple[str, str | None]:
            words = asked(lift_gate, places[0], 1.0, places[1]).stdout.split()
            return words[words.index("grasp") + 1], words[-1] if "owner:" in words else None

        def in_python() -> tuple[str, str | None]:
            with Client(places[0], ask_endpoint=places[1]) as graspd:
                said = graspd.may_i_lift(1.0).verdict
            return str(said.grasp), said.owner

        def both_ask_for_one() -> bool:
            (grasp, owner), (again, second) = in_python(), in_cpp()
            # A computer that is slow has lost the grasp by then.
            assert second in (None, "another" if grasp == again and owner else "you")
            return (grasp, owner, second) == (again, "you", "another")

        wait_until(both_ask_for_one)


def test_a_killed_daemon_is_unknown_until_its_next_message(tmp_path: Path) -> None:
    with Daemon(tmp_path) as daemon, Client(daemon.endpoint, max_age_ms=1e6) as graspd:
        wait_until(lambda: graspd.verdict(0.1).p_slip is not None)
        former = graspd.verdict().boot_id
        daemon.kill()
        wait_until(lambda: graspd.verdict().reasons == ("silent",))
        assert (graspd.verdict().decision, graspd.verdict().boot_id) == ("unknown", former)
        daemon.start()
        wait_until(lambda: graspd.verdict(0.1).p_slip is not None)
        assert graspd.verdict().boot_id != former  # nothing of before has come back


def test_over_tcp_as_from_another_computer(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with Daemon(tmp_path, endpoint=endpoint), Client(endpoint, same_computer=False) as graspd:
        wait_until(lambda: bool(graspd.may_i_lift(1.0)))
        assert graspd.counts.lost == 0


def test_only_who_has_keys_is_told(tmp_path: Path) -> None:
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
        assert stranger.verdict(0.2).reasons == ("no-message",)
    with pytest.raises(ValueError, match="no secret key"):
        Keys.load(public, own_public)


def test_an_endpoint_that_is_none_leaves_nothing_behind() -> None:
    with pytest.raises(zmq.ZMQError):
        Client("nowhere")
