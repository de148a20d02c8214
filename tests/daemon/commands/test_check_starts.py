"""What `run` refuses at its start is found by `check`, in one line with the key."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.daemon.processes import graspd
from tests.kit.scenes import demo_scene, written

ABSENT = os.sysconf("SC_NPROCESSORS_CONF")
"""A processor that this computer lacks."""
CAN = '[tactile]\ndriver = "can"\ninterface = "{}"\n[publish]\nendpoint = "ipc://{}/v"\n'


@pytest.mark.parametrize(
    ("section", "says"),
    [
        ("[realtime]\ncpus = [-1]", "realtime.cpus.0: input should be greater than"),
        (f"[realtime]\ncpus = [0, {10**30}]", "realtime.cpus.1: input should be less than"),
        (f"[realtime]\ncpus = [0, {ABSENT}]", f"realtime.cpus: no processor {ABSENT}"),
        ('[ask]\ntell = ["root", "no-such-user"]', "ask.tell: there is no user no-such-user"),
        (f'[ask]\ntell = ["{"9" * 5000}"]', "ask.tell: there is no user 9"),
        ('[ask]\nendpoint = "ipc://F/absent/a"', "ask: there is no folder F/absent"),
        ('[ask]\nendpoint = "ipc://F/scene.toml"', "ask: F/scene.toml is not a socket"),
        ('[ask]\nendpoint = "ipc://F/./v"', "ask.endpoint ipc://F/./v must differ"),
    ],
)
def test_check_finds_what_run_refuses(section: str, says: str, tmp_path: Path) -> None:
    scene = demo_scene(tmp_path, sections=section.replace("F/", f"{tmp_path}/"))
    refused = graspd("check", scene)
    assert refused.returncode == 2
    (line,) = refused.stderr.splitlines()
    assert says.replace("F/", f"{tmp_path}/") in line
    assert graspd("run", scene).returncode != 0


@pytest.mark.parametrize("interface", ["socketcan_native", "usb2can", "socketcand"])
def test_check_finds_a_can_interface_that_cannot_be_used(interface: str, tmp_path: Path) -> None:
    scene = written(tmp_path, CAN.format(interface, tmp_path))
    for command in ("check", "run"):
        refused = graspd(command, scene)
        assert refused.returncode == 2
        assert "[tactile] interface: " in refused.stderr
        assert "pip install" not in refused.stderr


def test_check_finds_a_palm_source_of_another_kind(tmp_path: Path) -> None:
    text = '[tactile]\ndriver = "palm"\nsource = "tcp://127.0.0.1:5"\n'
    refused = graspd(
        "check", written(tmp_path, text + f'[publish]\nendpoint = "ipc://{tmp_path}/v"')
    )
    assert refused.returncode == 2
    assert "tactile.source: string should match pattern '^udp://'" in refused.stderr
