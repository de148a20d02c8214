"""What drivers are told by a scene, and how one that cannot use it is said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from graspd.daemon.assembly import assembly
from graspd.daemon.scene import Scene, SceneError, parse
from graspd.drivers.base import DriverError, LinkCause, LinkError, RecordingError
from graspd.drivers.palm.calibration import CalibrationError
from graspd.drivers.recordings.csv_player import DEMO_TABLE
from tests.daemon.fakes import Clock, FakeDriver


def scene(tactile: dict[str, Any], **sections: dict[str, Any]) -> Scene:
    return parse({"tactile": tactile, **sections}, Path("scene.toml"))


class Constructed:
    """Takes a driver's place and keeps the arguments."""

    def __init__(self, *positional: object, **named: object) -> None:
        self.positional, self.named = positional, named


def made(monkeypatch: pytest.MonkeyPatch, driver: str, wanted: Scene) -> dict[str, object]:
    monkeypatch.setattr(driver, Constructed)
    (constructed,) = assembly.build_drivers(wanted)
    assert isinstance(constructed, Constructed)
    return constructed.named


PALM = {"driver": "palm", "source": "udp://127.0.0.1:5555"}


@pytest.mark.parametrize(
    ("keys", "address", "heeded"),
    [
        ({}, None, True),
        ({"only_from": "10.0.0.2", "heed_finger_bits": False}, "10.0.0.2", False),
    ],
)
def test_the_palm_is_told_whom_to_hear_and_what_to_heed(
    monkeypatch: pytest.MonkeyPatch, keys: dict[str, Any], address: str | None, heeded: bool
) -> None:
    named = made(monkeypatch, "graspd.drivers.palm.driver.PalmDriver", scene(PALM | keys))
    assert named["only_from"] == address
    assert named["heed_finger_bits"] is heeded


def test_the_can_bridge_is_told_the_order_of_its_sensors(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = scene({"driver": "can", "sensors": ["th", "ff", "mf"]})
    named = made(monkeypatch, "graspd.drivers.can.driver.CanBridgeDriver", wanted)
    assert named["sensors"] == ("th", "ff", "mf")
    assert named["fingers"] == ("ff", "mf", "th")


@pytest.mark.parametrize(
    ("sections", "says"),
    [
        (
            {"tactile": {"driver": "can", "bitrate": 500_000}},
            r"^\[tactile\] bit rates of socketcan",
        ),
        ({"tactile": {"driver": "can", "data_length": 3}}, r"^\[tactile\] frames of 3 bytes"),
        ({"tactile": {"driver": "palm", "source": "udp://nowhere"}}, r"^\[tactile\] "),
        ({"tactile": PALM, "joints": {"driver": "stream", "source": "udp://x"}}, r"^\[joints\] "),
    ],
)
def test_what_a_driver_refuses_is_one_line_naming_the_section(
    sections: dict[str, dict[str, Any]], says: str
) -> None:
    with pytest.raises(SceneError, match=says) as error:
        assembly.build_drivers(scene(**sections))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("raised", "expected"),
    [
        (LinkError(LinkCause.UNKNOWN, "gone"), LinkError),
        (DriverError("no such interface"), SceneError),
        (RecordingError(Path("a.csv"), "empty"), SceneError),
        (CalibrationError(Path("hand.toml"), ["no joint"]), SceneError),
        (ValueError("baud"), SceneError),
    ],
)
def test_only_a_link_is_worth_another_try(raised: Exception, expected: type[Exception]) -> None:
    class Refusing(FakeDriver):
        def open(self) -> None:
            raise raised

    with pytest.raises(expected, match=str(raised)):
        assembly.open_driver(Refusing([], Clock()))


def test_outcomes_that_no_recording_has_cannot_be_told(tmp_path: Path) -> None:
    bare = tmp_path / "bare.csv"
    header, row, *_ = DEMO_TABLE.read_text().splitlines()
    bare.write_text(header.replace("slipped", "other") + f"\n{row}\n")
    wanted = scene({"driver": "replay", "recordings": [str(bare)], "outcomes": True})
    with pytest.raises(SceneError, match="outcomes needs the column `slipped`"):
        assembly.build_drivers(wanted)
