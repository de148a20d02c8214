"""The scene file: what is right is taken over, what is wrong is one line that names the key."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from graspd.daemon.scene import SceneError, load, parse
from graspd.daemon.scene.drivers import ReplayTactile
from graspd.daemon.scene.scene import SCENE_MAX_BYTES
from tests.kit.scenes import written

GOOD = """
[tactile]
driver = "replay"
recordings = ["grasps.csv"]
"""
SPI = "[tactile]\ndriver = 'spi'\nport = '/dev/ttyACM0'\n"
CAN = "[tactile]\ndriver = 'can'\n"
PALM = "[tactile]\ndriver = 'palm'\nsource = 'udp://127.0.0.1:5555'\n"


def test_a_scene_without_hand_publish_or_gate_gets_their_defaults(tmp_path: Path) -> None:
    scene = load(written(tmp_path, GOOD))
    assert scene.hand.fingers == ("ff", "mf", "th")
    assert scene.endpoint == "ipc:///run/graspd/right.ipc"
    assert scene.max_age_ns == 100_000_000
    assert scene.gate.mode is None


def test_paths_are_relative_to_the_scene_file(tmp_path: Path) -> None:
    scene = load(written(tmp_path, GOOD + '[model]\npath = "mine.onnx"\n'))
    assert isinstance(scene.tactile, ReplayTactile)
    assert scene.tactile.recordings == (tmp_path / "grasps.csv",)
    assert scene.model.path == tmp_path / "mine.onnx"


@pytest.mark.parametrize(
    ("text", "key", "says"),
    [
        ("", "tactile", "is missing"),
        ("[tactile]\nrecordings = ['a']", "tactile.driver", "is missing"),
        ("[tactile]\ndriver = 'i2c'", "tactile.driver", "there are: replay, spi, can, palm, "),
        ("[tactile]\ndriver = 'spii'", "tactile.driver", "no driver 'spii'; did you mean spi?"),
        (GOOD + "[hnad]\nname = 'left'", "hnad", "did you mean hand?"),
        (GOOD + "outcome = true", "tactile.outcome", "did you mean outcomes?"),
        (GOOD + "[gate]\nmax_age_s = 0.1", "gate.max_age_s", "did you mean max_age_ms?"),
        (GOOD + "[hand]\nfingers = ['ff', 'ff']", "hand.fingers", "twice"),
        (GOOD + "[hand]\nfingers = ['thumb']", "hand.fingers.0", "'th'"),
        (GOOD + "[model]\nname = 'cnn1'\npath = 'x.onnx'", "model", "not both"),
        (GOOD + "[publish]\nendpoint = 'tcp://0.0.0.0:5'", "scene", "publish.endpoint tcp://0.0"),
        (GOOD + "[publish]\nendpoint = 'tcp://127.0.0.1'", "publish.endpoint", "port"),
        (GOOD + "[publish]\nendpoint = 'udp://127.0.0.1:5'", "publish.endpoint", "ipc://"),
        (GOOD + f"[publish]\nendpoint = 'ipc://{'x' * 108}'", "publish.endpoint", "107 bytes"),
        (GOOD + "[publish]\nendpoint = 'tcp://[::2]:5'", "scene", "not a loopback address"),
        (GOOD + "[publish]\nendpoint = 'tcp://127.0.0.1]:5'", "publish.endpoint", "IP address"),
        (GOOD + "[publish]\nendpoint = 'tcp://127.0.0.1:0'", "publish.endpoint", "port"),
        (
            GOOD + f"[publish]\nendpoint = 'tcp://127.0.0.1:{'9' * 5000}'",
            "publish.endpoint",
            "port",
        ),
        (GOOD + "[publish]\nendpoint = 'ipc://*'", "publish.endpoint", "not '*'"),
        (GOOD + "[ask]\nendpoint = 'ipc://@graspd'", "ask.endpoint", "no file mode"),
        (
            GOOD + "[ask]\nendpoint = 'tcp://127.0.0.1:5555'\ntell = ['root']",
            "scene",
            "ask.tell needs an ipc:// socket",
        ),
        (GOOD + '[publish]\nendpoint = "ipc:///tmp/\\u0000"', "publish.endpoint", "NUL"),
        (GOOD + '[model]\npath = "\\u0000.onnx"', "model.path", "NUL"),
        (PALM + "[gate]\nmode = 'every'", "scene", "gate.mode every is for grasp tables"),
        (SPI + "sped = 1", "tactile.sped", "there are: driver, port, sensors, baud"),
        ("[hand]\nfingers = ['ff', 'mf', 'rf', 'th']\n" + CAN, "scene", "three sensors"),
        (
            CAN + "[joints]\ndriver = 'palm'\ncalibration = 'hand.toml'",
            "scene",
            "joints.driver palm needs tactile.driver palm",
        ),
        (CAN + "sensors = ['th', 'ff']", "scene", "tactile.sensors must name every finger"),
        ("[tactile]\ndriver = 'palm'\nsource = 'hand.palm'", "tactile.source", "'^udp://'"),
        (PALM + "only_from = 'the-relay'", "tactile.only_from", "does not appear to be an IPv4"),
        (PALM + "[record]\nraw = true", "scene", "record.raw is for tactile.driver spi and can"),
        (PALM + "[joints]\ndriver = 'ros'", "joints.driver", "there are: palm, stream"),
    ],
)
def test_a_mistake_is_one_line_naming_file_and_key(
    tmp_path: Path, text: str, key: str, says: str
) -> None:
    path = written(tmp_path, text)
    with pytest.raises(SceneError) as error:
        load(path)
    message = str(error.value)
    assert message.startswith(f"{path}: {key}: ")
    assert says in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"[tactile\n", "not TOML"),
        (b"a = 1\na = 2\n", "not TOML"),
        (b"\xff\x00", "not a text file"),
        (b"\xff\xfe[\x00", "is UTF-16; save it as UTF-8"),
        (b"\xfe\xff\x00[", "is UTF-16; save it as UTF-8"),
        (b"a = " + b"[" * 20_000, "not TOML that can be read: nested too deeply"),
        (b"a = " + b"9" * 5000, "not TOML: Exceeds the limit"),
        (b"[" + b"a" * 10_000 + b"]\n[" + b"a" * 10_000 + b"]", r"not TOML: .{320}$"),
        (b"#" * (SCENE_MAX_BYTES + 1), "larger than 131072 bytes"),
    ],
)
def test_an_unreadable_scene_file_is_refused_in_one_line(
    tmp_path: Path, content: bytes, says: str
) -> None:
    path = tmp_path / "scene.toml"
    path.write_bytes(content)
    with pytest.raises(SceneError, match=says) as error:
        load(path)
    assert "\n" not in str(error.value)


def test_of_many_mistakes_twenty_are_listed(tmp_path: Path) -> None:
    path = written(tmp_path, GOOD + "".join(f"wrong{number} = 1\n" for number in range(1000)))
    with pytest.raises(SceneError) as error:
        load(path)
    *lines, last = str(error.value).splitlines()
    assert len(lines) == 20
    assert last == f"{path}: and 980 more"


@pytest.mark.parametrize(
    "text",
    [
        GOOD + f"loop = '{'x' * 100_000}'",
        GOOD + f"{'x' * 100_000} = 1",
        GOOD + f"[risk]\nwarm_up = 0x{'f' * 5000}",
        f"[tactile]\ndriver = '{'x' * 100_000}'",
        GOOD + f"[publish]\nendpoint = 'tcp://{'x' * 100_000}:1'",
    ],
)
def test_a_long_value_is_shortened_in_the_message(tmp_path: Path, text: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(SceneError) as error:
        load(path)
    assert len(str(error.value)) < len(str(path)) + 600


def test_control_characters_are_escaped_in_the_message(tmp_path: Path) -> None:
    escape = '"\\u001b[2J\\n\\u202e"'
    texts = [f"loop = {escape}", f"{escape} = 1", f"[publish]\nendpoint = {escape}"]
    for text in [*(GOOD + text for text in texts), f"[tactile]\ndriver = {escape}"]:
        with pytest.raises(SceneError) as error:
            load(written(tmp_path, text))
        assert str(error.value).isprintable()
        assert "\\x1b[2J\\n\\u202e" in str(error.value)


def test_a_loaded_scene_cannot_be_changed(tmp_path: Path) -> None:
    scene = load(written(tmp_path, GOOD))
    with pytest.raises(ValidationError, match="frozen"):
        scene.hand.name = "left"


@pytest.mark.parametrize(
    ("first", "second", "clash"),
    [
        ("ipc:///run/graspd/right.ipc", None, False),
        (None, "ipc:///run/graspd/right.ipc", True),
        (None, "ipc:///run/graspd/../graspd//right.ipc", True),
        ("ipc://{}/a", "ipc://{}//a", True),
        ("ipc://{}/a", "ipc://{}/./a", True),
        ("ipc://{}/a", "ipc://{}/link/a", True),
        ("ipc://{}/a", "ipc://{}/a.lock", True),
        ("ipc://{}/a.lock", "ipc://{}/a", True),
        ("ipc://{}/a", "ipc://{}/b", False),
        ("tcp://127.0.0.1:5555", "tcp://127.0.0.1:05555", True),
        ("tcp://127.0.0.1:5555", "tcp://[::ffff:127.0.0.1]:5555", True),
        ("tcp://127.0.0.1:5555", "tcp://127.0.0.1:5556", False),
        ("tcp://127.0.0.1:5555", "tcp://[::1]:5555", False),
        ("tcp://0.0.0.0:5555", "tcp://127.0.0.1:5555", True),
        ("tcp://[::]:5555", "tcp://127.0.0.1:5555", True),
        ("tcp://127.0.0.1:5555", "ipc://{}/a", False),
    ],
)
def test_publish_and_ask_endpoints_that_clash_are_refused_however_written(
    first: str | None, second: str | None, clash: bool, tmp_path: Path
) -> None:
    (tmp_path / "link").symlink_to(tmp_path)
    sections: dict[str, Any] = {"tactile": {"driver": "spi", "port": "/nowhere"}, "ask": {}}
    sections["curve"] = {"secret_key": "own.key_secret", "clients": "clients"}
    for name, endpoint in (("publish", first), ("ask", second)):
        if endpoint is not None:
            sections[name] = {"endpoint": endpoint.format(tmp_path)}
    if not clash:
        parse(sections, tmp_path / "s.toml")
        return
    with pytest.raises(SceneError, match=r"publish\.endpoint .* and ask\.endpoint .* must"):
        parse(sections, tmp_path / "s.toml")


@pytest.mark.parametrize(
    ("counts", "angles", "clash"),
    [
        # What Linux binds, and what it refuses with `Address already in use`.
        ("udp://127.0.0.1:9872", "udp://127.0.0.1:9872", True),
        ("udp://127.0.0.1:9872", "udp://[::ffff:127.0.0.1]:9872", True),
        ("udp://0.0.0.0:9872", "udp://127.0.0.1:09872", True),
        ("udp://127.0.0.1:9872", "udp://[::]:9872", True),
        ("udp://[::1]:9872", "udp://::1:9872", True),
        ("udp://127.0.0.1:9872", "udp://127.0.0.1:9871", False),
        ("udp://127.0.0.1:9872", "udp://127.0.0.2:9872", False),
        ("udp://127.0.0.1:9872", "udp://[::1]:9872", False),
        ("udp://127.0.0.1:0", "udp://127.0.0.1:0", False),
        ("udp://127.0.0.1:9872", "udp://here", False),  # the driver says what is wrong
    ],
)
def test_counts_and_angles_on_one_udp_port_are_refused(
    counts: str, angles: str, clash: bool, tmp_path: Path
) -> None:
    sections = {
        "tactile": {"driver": "datagrams", "source": counts},
        "joints": {"driver": "stream", "source": angles},
    }
    if not clash:
        parse(sections, tmp_path / "s.toml")
        return
    with pytest.raises(SceneError, match=r"tactile\.source .* and joints\.source .* must") as error:
        parse(sections, tmp_path / "s.toml")
    assert "\n" not in str(error.value)


def test_a_utf_8_byte_order_mark_is_accepted(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_bytes(b'\xef\xbb\xbf[tactile]\ndriver = "can"\n')
    assert load(path).tactile.driver == "can"
