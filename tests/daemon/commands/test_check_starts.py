"""What `run` refuses at its start is found by `check`, in one line with the key."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.kit.inside import graspd
from tests.kit.scenes import demo_scene, written

ABSENT = os.sysconf("SC_NPROCESSORS_CONF")
"""A processor that this computer lacks."""
CAN = '[tactile]\ndriver = "can"\n{}\n[publish]\nendpoint = "ipc://{}/v"\n'
SOCKETCAND = 'interface = "socketcand"\noptions = { host = "127.0.0.1", '


@pytest.mark.parametrize(
    ("section", "says"),
    [
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


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ('interface = "socketcan_native"', "interface: python-can has no interface"),
        ('interface = "usb2can"', "interface: python-can's interface 'usb2can' is for Windows"),
        ('interface = "pcan"', "interface: python-can's interface 'pcan' needs the library"),
        ('interface = "socketcand"', "options: python-can's interface 'socketcand' needs options"),
        (SOCKETCAND + 'port = "29536" }', "options.port: Expected `int`, got `str`"),
        (SOCKETCAND + "port = 99999 }", "options.port: Expected `int` <= 65535"),
        (SOCKETCAND + "port = 1, tune = true }", "options.tune: python-can's interface 'socketca"),
        (SOCKETCAND + "port = 1, bitrate = 1 }", "options.bitrate: is a key of its own"),
        (
            'interface = "virtual"\noptions = { self = 1 }',
            "options.self: python-can's interface 'v",
        ),
        ('interface = "slcan"\noptions = { timeout = 1.0 }', "options.timeout: must be 0.0"),
        (
            'interface = "slcan"\nbitrate = 123456',
            "bitrate: python-can's interface 'slcan' has",
        ),
        ('interface = "slcan"\nchannel = "foo://x"', "channel foo://x: invalid URL"),
        ('interface = "udp_multicast"', "channel can0: 'can0' does not appear to be an IP"),
        ('channel = "a-name-of-16-byte"', "channel a-name-of-16-byte: longer than 15 bytes"),
    ],
)
def test_check_finds_a_can_bus_that_can_never_open(keys: str, says: str, tmp_path: Path) -> None:
    scene = written(tmp_path, CAN.format(keys, tmp_path))
    for command in ("check", "run"):
        refused = graspd(command, scene)
        assert refused.returncode == 2
        (line,) = refused.stderr.splitlines()
        assert line.startswith(f"graspd: [tactile] {says}")
        assert "pip install" not in line
