"""Drawn scenes in which `check` finds no error start, except their links."""

from __future__ import annotations

import json
from argparse import Namespace
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, event, given, note, settings
from hypothesis import strategies as st

from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import Assembly
from graspd.daemon.commands import check
from graspd.daemon.doctor import surroundings
from graspd.daemon.publish.keys import make
from graspd.daemon.run.runner import enter_realtime, prepare
from graspd.daemon.scene.scene import Scene
from graspd.drivers.base import LinkError
from graspd.drivers.recordings.csv_player import DEMO_DAY, DEMO_RECORDING, DEMO_TABLE
from graspd.models import zoo
from tests.conftest import ROOT
from tests.ports import free_port

EXAMPLES = 50
SHARE = 0.15
"""Share of the optional keys that are written."""
CALIBRATION = str(ROOT / "deploy" / "calibration" / "example_hand.toml")
PLACES: dict[str, tuple[list[Any], list[Any]]] = {
    "recordings": ([[str(DEMO_DAY)], [str(DEMO_TABLE)], [str(DEMO_RECORDING)]], [["absent.csv"]]),
    "endpoint": (
        ["ipc://F/a", "ipc://F//a", "ipc://F/b", "ipc://F/link/b", "tcp://127.0.0.1:P"],
        ["ipc://F/a.lock", "ipc://F/folder", "ipc://F/absent/a", "tcp://0.0.0.0:P"],
    ),
    "interface": (
        ["socketcan", "slcan", "virtual", "udp_multicast"],
        ["gs_usb", "socketcand", "usb2can", "none"],
    ),
    "options": ([{}, {"host": "127.0.0.1", "port": 9}], [{"nonsense": True}]),
    "channel": (["can0", "239.74.163.9", "/dev/absent"], []),
    "port": (["/dev/absent", "loop://"], []),
    "source": (["udp://127.0.0.1:0", "udp://127.0.0.1:P"], ["absent.bin", "tcp://127.0.0.1:P"]),
    "calibration": ([CALIBRATION], ["absent.toml"]),
    "name": (["mlp", "small-session"], ["absent"]),
    "path": ([str(zoo.find("svm"))], ["absent.onnx"]),
    "folder": (["F/kept", "F/folder"], ["F/absent/kept", "F/a-file"]),
    "directory": (["F/record"], ["F/a-file", "/proc/absent"]),
    "group": (["root"], ["absent"]),
    "tell": (
        [["daemon"], ["0"], ["12345", "root"], []],
        [["absent"], ["root", "-1"], ["9" * 5000]],
    ),
    "secret_key": (["F/keys/daemon.key_secret"], ["absent"]),
    "clients": (["F/folder", "F/keys"], ["F/absent"]),
    "only_from": (["127.0.0.1", "::1"], []),
    "fingers": ([["ff", "mf", "th"], ["ff", "th"]], [["th", "ff"]]),
    "sensors": ([["ff", "mf", "th"]], [["ff"]]),
    "cpus": ([[0]], [[5000], [-1], [0, 10**30]]),
    "file_mode": (["0660", "660"], ["odd"]),
}
"""Good and bad values of keys whose type says little; F: this test's folder, P: a free port."""
GOOD = 4
"""Number of good values for each bad one."""


SCHEMA = Scene.model_json_schema()


def values(schema: dict[str, Any]) -> st.SearchStrategy[Any]:
    """Return a strategy for values that a schema allows; the scene may still refuse some."""
    if "$ref" in schema:
        return sections(SCHEMA["$defs"][schema["$ref"].rpartition("/")[2]])
    if choices := schema.get("anyOf", schema.get("oneOf")):
        return st.one_of([values(each) for each in choices if each.get("type") != "null"])
    if "const" in schema:
        return st.just(schema["const"])
    if "enum" in schema:
        return st.sampled_from(schema["enum"])
    if schema["type"] == "boolean":
        return st.booleans()
    if schema["type"] == "integer":
        return st.integers(schema["minimum"], schema["maximum"])
    return st.floats(
        schema.get("minimum", schema.get("exclusiveMinimum")),
        schema.get("maximum", schema.get("exclusiveMaximum")),
        exclude_min="exclusiveMinimum" in schema,
        exclude_max="exclusiveMaximum" in schema,
    )


@st.composite
def sections(draw: st.DrawFn, schema: dict[str, Any]) -> dict[str, Any]:
    drawn: dict[str, Any] = {}
    for key, value in schema["properties"].items():
        if key not in schema.get("required", ()) and draw(st.floats(0.0, 1.0)) > SHARE:
            continue
        if key in PLACES:
            good, bad = PLACES[key]
            drawn[key] = draw(st.sampled_from([*good * GOOD * max(len(bad), 1), *bad]))
        else:
            drawn[key] = draw(values(value))
    return drawn


def as_toml(value: object) -> str:
    """Return a value as TOML; a section is an inline table."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {as_toml(each)}" for key, each in value.items()) + "}"
    return json.dumps(value)


def start(path: Path) -> None:
    """Open all that `run` opens, without the loop; ignore links that cannot be opened."""
    parts = prepare(path)
    with ExitStack() as stack:
        around = Assembly(parts, stack)
        around.open_sockets()
        for driver in parts.drivers:
            stack.callback(driver.close)
            with suppress(LinkError):
                assembly.open_driver(driver)
        around.keep_session()
        enter_realtime(parts.scene, stack)
        around.record()
        around.build_outbox()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, int]]:
    """A folder with what drawn scenes name, and a free port. A missing folder fails `check`."""
    folder = tmp_path_factory.mktemp("s")
    (folder / "folder").mkdir()
    make(folder / "keys", "daemon")
    (folder / "a-file").write_text("x")
    (folder / "link").symlink_to(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surroundings, "SERVICE_FOLDER", None)
        patch.setattr("graspd.daemon.scene.scene.STATE_DIRECTORY", folder)
        yield folder, free_port()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@settings(
    max_examples=EXAMPLES,
    deadline=None,
    phases=[Phase.generate],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
@given(drawn=sections(SCHEMA))
def test_a_scene_in_which_check_finds_no_error_starts(
    place: tuple[Path, int], drawn: dict[str, Any]
) -> None:
    folder, port = place
    drawn["publish"] = {"endpoint": "ipc://F/a", **drawn.get("publish", {})}
    text = "\n".join(f"{name} = {as_toml(section)}" for name, section in drawn.items())
    path = folder / "scene.toml"
    path.write_text(text.replace("F/", f"{folder}/").replace(":P", f":{port}"))
    note(path.read_text())
    fine = check.run(Namespace(scene=[path], json=True)) == 0
    event(f"fine: {fine}")
    if fine:
        start(path)
