"""What an operator is told: dead links, silent daemons, parts not well, what a verdict rests on."""

from __future__ import annotations

from pathlib import Path

import pytest

from graspd.daemon.commands.watch import where_to_look
from graspd.daemon.judge.reasons import ADVICE, Decision, Need, Reason
from graspd.daemon.watch.snapshot import Line, Link, Tone
from graspd.daemon.watch.view import View
from tests.daemon.watch.watch_fakes import ENDPOINT, MS, a_view, after, status, verdict


@pytest.mark.parametrize(
    "unreadable", [Reason.STALE, Reason.FROZEN, Reason.ELECTRODES_BROKEN, Reason.SENSOR_MISSING]
)
def test_a_dead_link_never_asks_to_close_the_hand(unreadable: Reason) -> None:
    reasons = [unreadable, Reason.NOT_TARED, Reason.NO_CONTACT]
    seen = after((b"verdict.right", verdict(0, reasons=reasons))).snapshot(0)
    assert (seen.tone, seen.why[0]) == (Tone.TROUBLE, Line(unreadable.value, ADVICE[unreadable]))
    assert {line.what for line in seen.why[1:]} <= {"look"}


def test_outage_names_the_command_that_examines_the_link() -> None:
    view = View(ENDPOINT, doctor="graspd doctor right.toml")
    view.take(b"verdict.right", verdict(0, reasons=[Reason.STALE, Reason.NO_CONTACT]), 0)
    assert view.snapshot(0).why[1:] == [Line("look", "graspd doctor right.toml")]
    view.take(b"verdict.right", verdict(1, reasons=[Reason.NO_CONTACT]), 0)
    assert "look" not in {line.what for line in view.snapshot(0).why}


def test_a_dead_link_does_not_look_like_a_dead_daemon() -> None:
    """Without readings the daemon sends an `unknown` each `silence_ms`, here 100."""
    view = after((b"verdict.right", verdict(0, reasons=[Reason.STALE])))
    assert view.snapshot(120 * MS).why[0].what == "stale"
    assert view.snapshot(301 * MS).why[0].what == "silent"


def test_a_delayed_viewer_dates_messages_by_their_own_times() -> None:
    """For 800 ms nothing was taken; the newest of 80 messages is 10 ms old, or 600."""
    for sent_ms, tone in ((790, Tone.STABLE), (200, Tone.SILENT)):
        view = a_view()
        sent = verdict(0, Decision.STABLE, t_mono_ns=5 * MS, age_ms=0.0)
        view.take(b"verdict.right", sent, 0, 1 * MS)
        for seq in range(1, 80):
            at_ns = 5 * MS + sent_ms * MS * seq // 79
            late = verdict(seq, Decision.STABLE, t_mono_ns=at_ns, age_ms=0.0)
            view.take(b"verdict.right", late, 10 * MS, 801 * MS)
        assert view.snapshot(801 * MS).tone is tone


def test_a_viewer_that_was_suspended_reports_for_how_long() -> None:
    view = after((b"verdict.right", verdict(0, Decision.STABLE)))
    view.snapshot(0)
    view.stood_still = 20 * MS, 5020 * MS
    seen = view.snapshot(5100 * MS)
    stood = "this viewer itself stood still for 5000 ms"
    assert seen.why[0] == Line("held up", f"{stood} and connects again")
    assert (seen.headline, seen.history) == ("unknown", ["s"])
    seen = view.snapshot(6100 * MS)
    assert seen.why[0] == Line("silent", f"no message since; {stood}")
    assert seen.history == ["s", "", "", "", "", "", "."]


def test_advice_on_silence_depends_on_the_state_of_the_link() -> None:
    look = "systemctl status graspd@right; journalctl -u graspd@right"
    view = View(ENDPOINT, look=look)
    assert view.snapshot(0).why[-1] == Line("look", look)
    view.link = Link.CONNECTED
    assert "the daemon is there" in view.snapshot(0).why[-1].advice
    view.link = Link.NEEDS_KEY
    assert [line.what for line in view.snapshot(0).why] == ["silent", "link"]


def test_health_names_all_parts_of_a_reason_at_once() -> None:
    dead, loose = Reason.ELECTRODE_DEAD, Reason.ELECTRODE_JUMPS
    health = {"session": Reason.NOT_CALIBRATED, "ff_7": dead, "th_2": loose, "mf_24": dead}
    view = after((b"status.right", status(0, health=health)), (b"verdict.right", verdict(0)))
    seen = view.snapshot(0)
    assert seen.health == [
        Line("ff_7, mf_24 electrode-dead", ADVICE[dead]),
        Line("th_2 electrode-jumps", ADVICE[loose]),
        Line("session not-calibrated", ADVICE[Reason.NOT_CALIBRATED], Need.WAIT),
    ]
    assert seen.not_well == "not well: ff_7, mf_24 electrode-dead and 1 more"


SERVICE = "systemctl status graspd@left; journalctl -u graspd@left"


@pytest.mark.parametrize(
    ("endpoint", "scene", "look"),
    [
        ("ipc:///tmp/x.ipc", "/etc/graspd/left.toml", SERVICE),
        ("ipc:///tmp/x.ipc", "my/demo.toml", "is it started? graspd run my/demo.toml"),
        ("tcp://10.0.0.2:5556", None, "on the daemon's computer: systemctl status 'graspd@*'"),
    ],
)
def test_advice_names_commands_for_this_endpoint_and_scene(
    endpoint: str, scene: str | None, look: str
) -> None:
    found, doctor = where_to_look(endpoint, None if scene is None else Path(scene))
    assert found == look
    assert f"graspd doctor {scene or 'SCENE'}; the daemon's log says why" in doctor


def test_the_evidence_names_network_lifts_slips_and_target() -> None:
    seen = after((b"verdict.right", verdict(0, Decision.STABLE))).snapshot(0)
    network = "slip probability by the network alone 30 %"
    lifts = "rests on 57 lifts; of 41 `stable` ones 2 slipped, target 10 %"
    assert seen.evidence == f"{network}, {lifts}"
    untold = verdict(0, Decision.STABLE, risk=None, outcomes=0, p_slip_model=None)
    assert after((b"verdict.right", untold)).snapshot(0).evidence == "no outcome reported yet"
