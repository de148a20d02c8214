"""What `check` calls fine must start: drawn from the scene's own classes, up to the open link."""

from __future__ import annotations

import types
from argparse import Namespace
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import annotated_types
import pytest
from hypothesis import HealthCheck, Phase, event, given, note, settings
from hypothesis import strategies as st
from pydantic import BaseModel
from pydantic.fields import FieldInfo

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


def numbers(kind: type, bounds: list[object]) -> st.SearchStrategy[Any]:
    found = {name: getattr(bound, name) for bound in bounds for name in vars_of(bound)}
    low, high = found.get("ge", found.get("gt", 0)), found.get("le", found.get("lt", 10_000))
    if kind is int:
        return st.integers(low, high)
    ends = [float(found[name]) for name in ("ge", "le") if name in found]
    inside = st.floats(low, high, exclude_min="gt" in found, exclude_max="lt" in found)
    return inside | st.sampled_from(ends) if ends else inside


def vars_of(bound: object) -> list[str]:
    return [name for name in ("ge", "gt", "le", "lt") if hasattr(bound, name)]


def values(annotation: Any, bounds: list[object]) -> st.SearchStrategy[Any]:  # noqa: ANN401
    """Values of a type as TOML has them; some are refused."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return values(inner[0], [*bounds, *inner[1:]])
    if origin in (Union, types.UnionType):
        kinds = [values(each, bounds) for each in inner if each is not type(None)]
        return st.one_of(kinds)
    if origin is Literal:
        return st.sampled_from(inner)
    if origin is tuple:
        return st.lists(values(inner[0], []), min_size=1, max_size=3)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return sections(annotation)
    if annotation is bool:
        return st.booleans()
    if annotation in (int, float):
        spread = [bound for each in bounds for bound in unpacked(each)]
        return numbers(annotation, spread)
    raise NotImplementedError(f"values of {annotation}")


def unpacked(bound: object) -> list[object]:
    """The bounds in a field of pydantic, or a bound itself."""
    if isinstance(bound, FieldInfo):
        return list(bound.metadata)
    return [bound] if isinstance(bound, annotated_types.BaseMetadata) else []


@st.composite
def sections(draw: st.DrawFn, kind: type[BaseModel]) -> dict[str, Any]:
    drawn: dict[str, Any] = {}
    for key, field in kind.model_fields.items():
        if not field.is_required() and draw(st.floats(0.0, 1.0)) > SHARE:
            continue
        if key in PLACES:
            good, bad = PLACES[key]
            drawn[key] = draw(st.sampled_from([*good * GOOD * max(len(bad), 1), *bad]))
        else:
            drawn[key] = draw(values(field.annotation, list(field.metadata)))
    return drawn


def filled(drawn: Any, folder: Path, port: int) -> Any:  # noqa: ANN401
    """The same with the folder and the port of this test."""
    if isinstance(drawn, dict):
        return {key: filled(value, folder, port) for key, value in drawn.items()}
    if isinstance(drawn, list | tuple):
        return [filled(value, folder, port) for value in drawn]
    if isinstance(drawn, str):
        return drawn.replace("F/", f"{folder}/").replace(":P", f":{port}")
    return drawn


def as_toml(drawn: dict[str, Any]) -> str:
    lines = []
    for name, section in drawn.items():
        lines.append(f"[{name}]")
        tables = {key: value for key, value in section.items() if isinstance(value, dict)}
        lines += [f"{key} = {text(value)}" for key, value in section.items() if key not in tables]
        for key, value in tables.items():
            lines.append(f"[{name}.{key}]")
            lines += [f"{inner} = {text(each)}" for inner, each in value.items()]
    return "\n".join(lines) + "\n"


def text(value: Any) -> str:  # noqa: ANN401
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(map(text, value))}]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def start(path: Path) -> None:
    """Do what `run` does up to an open link; a link that is not there is not its fault."""
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
    """A folder with what scenes name, and a free port. No service makes folders here."""
    folder = tmp_path_factory.mktemp("s")
    (folder / "folder").mkdir()
    make(folder / "keys", "daemon")
    (folder / "a-file").write_text("x")
    (folder / "link").symlink_to(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surroundings, "SERVICE_FOLDER", None)
        patch.setattr("graspd.daemon.scene.scene.STATE_DIRECTORY", folder)
        yield folder, free_port()


@pytest.mark.filterwarnings("ignore")
@settings(
    max_examples=EXAMPLES,
    deadline=None,
    phases=[Phase.generate],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
@given(drawn=sections(Scene))
def test_what_check_calls_fine_starts(place: tuple[Path, int], drawn: dict[str, Any]) -> None:
    folder, port = place
    drawn = filled({"publish": {"endpoint": "ipc://F/a"}, **drawn}, folder, port)
    drawn["publish"].setdefault("endpoint", f"ipc://{folder}/a")
    path = folder / "scene.toml"
    path.write_text(as_toml(drawn))
    note(path.read_text())
    fine = check.run(Namespace(scene=[path], json=True)) == 0
    event(f"fine: {fine}")
    if fine:
        start(path)
