"""What `run` refuses at its start is found by `check`, in one line with the key, or warned of."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest

from tests.kit.inside import graspd, output, refused
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
def test_check_refuses_what_run_would_refuse(section: str, says: str, tmp_path: Path) -> None:
    scene = demo_scene(tmp_path, sections=section.replace("F/", f"{tmp_path}/"))
    (line,) = refused("check", scene).splitlines()
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
        ('interface = "serial"\noptions = { timeout = 0.0 }', "options.timeout: must be 0.1"),
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
        (line,) = refused(command, scene).splitlines()
        assert line.startswith(f"graspd: [tactile] {says}")
        assert "pip install" not in line


def checked(folder: Path, text: str) -> dict[str, Any]:
    """The JSON document that `graspd check` prints on a right scene with this text."""
    document: dict[str, Any] = json.loads(output("check", written(folder, text), "--json"))
    return document


TWO = '[hand]\nname = "{}"\n[tactile]\ndriver = {}\n[publish]\nendpoint = "{}"\n'


@pytest.mark.parametrize(
    ("hand", "tactile", "endpoint", "shared"),
    [
        ("left", '"spi"\nport = "/dev/b"', "tcp://127.0.0.1:6001", []),
        (
            "right",
            '"spi"\nport = "/dev/b"',
            "tcp://127.0.0.1:6001",
            ["hand.name", "session.folder"],
        ),
        ("left", '"spi"\nport = "/dev/../dev/a"', "tcp://127.0.0.1:6001", ["tactile.port"]),
        (
            "left",
            '"can"\ninterface = "slcan"\nchannel = "/dev/a"\narbitration_id = 1',
            "tcp://127.0.0.1:6001",
            ["tactile.port"],
        ),
        ("left", '"palm"\nsource = "udp://0.0.0.0:98"', "tcp://127.0.0.1:6001", ["joints.source"]),
        ("left", '"can"', "tcp://[::ffff:127.0.0.1]:6000", ["endpoint"]),
    ],
)
def test_check_says_what_two_scenes_cannot_share(
    tmp_path: Path, hand: str, tactile: str, endpoint: str, shared: list[str]
) -> None:
    text = TWO.format("right", '"spi"\nport = "/dev/a"', "tcp://127.0.0.1:6000")
    joints = '[joints]\ndriver = "stream"\nsource = "udp://127.0.0.1:98"\n'
    right = written(tmp_path, text + joints)
    other = tmp_path / "other.toml"
    other.write_text(TWO.format(hand, tactile, endpoint))
    result = graspd("check", right, other)
    _, _, told = result.stderr.partition("cannot run together: the same ")
    assert re.findall(r"(?:^|, )([a-z.]+)", told) == shared
    assert result.returncode == 0


@pytest.mark.parametrize(
    ("source", "only_from", "warned"),
    [
        ("udp://0.0.0.0:9870", "", True),
        ("udp://[::]:9870", "", True),
        ("udp://0.0.0.0:9870", "10.0.0.2", False),
        ("udp://[::]:9870", "fd00::2", False),
        ("udp://127.0.0.1:9870", "", False),
        ("udp://10.0.0.1:9870", "", False),
    ],
)
def test_check_warns_of_udp_that_anybody_can_send_to(
    tmp_path: Path, source: str, only_from: str, warned: bool
) -> None:
    heard = f'source = "{source}"\n' + (f'only_from = "{only_from}"\n' if only_from else "")
    stream = f'[joints]\ndriver = "stream"\n{heard.replace(":98", ":99")}'
    told = checked(tmp_path, f'[tactile]\ndriver = "palm"\n{heard}{stream}')["warnings"]
    assert [warning[: warning.index(" ")] for warning in told] == ["[tactile]", "[joints]"] * warned
    assert all("name its sender with only_from" in warning for warning in told)


@pytest.mark.parametrize(
    ("tactile", "absent"),
    [
        ('driver = "spi"\nport = "{folder}/bridge"\n', "the port {folder}/bridge"),
        ('driver = "spi"\nport = "{folder}/there"\n', None),
        ('driver = "spi"\nport = "socket://localhost:1"\n', None),
        ('driver = "can"\nchannel = "can77"\n', "the CAN interface can77"),
        ('driver = "can"\ninterface = "virtual"\nchannel = "can77"\n', None),
    ],
)
def test_check_warns_of_a_missing_port_or_can_interface(
    tmp_path: Path, tactile: str, absent: str | None
) -> None:
    (tmp_path / "there").touch()
    told = checked(tmp_path, "[tactile]\n" + tactile.format(folder=tmp_path))["warnings"]
    said = "" if absent is None else f"{absent.format(folder=tmp_path)} is not there yet; "
    assert [warning.startswith(said) for warning in told] == [True] * (absent is not None)
