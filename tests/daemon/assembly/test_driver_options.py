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
from graspd.drivers.recordings.faults import ReplayFaults
from tests.daemon.fakes import Clock, FakeDriver


def scene(tactile: dict[str, Any], **sections: dict[str, Any]) -> Scene:
    return parse({"tactile": tactile, **sections}, Path("scene.toml"))


class Constructed:
    """Takes a driver's place and keeps the arguments."""

    def __init__(self, *_positional: object, **named: object) -> None:
        self.named = named


PALM = {"driver": "palm", "source": "udp://127.0.0.1:5555"}
REPLAY = {"driver": "replay", "recordings": [str(DEMO_TABLE)], "rate_hz": 20.0}
BEHIND = ("th", "ff", "mf")


@pytest.mark.parametrize(
    ("driver", "tactile", "told"),
    [
        ("palm.stream.PalmDriver", PALM, {"only_from": None, "heed_finger_bits": True}),
        (
            "palm.stream.PalmDriver",
            PALM | {"only_from": "10.0.0.2", "heed_finger_bits": False},
            {"only_from": "10.0.0.2", "heed_finger_bits": False},
        ),
        (
            "can.driver.CanBridgeDriver",
            {"driver": "can", "sensors": BEHIND},
            {"sensors": BEHIND, "fingers": ("ff", "mf", "th")},
        ),
        (
            "spi.driver.SpiBridgeDriver",
            {"driver": "spi", "port": "/dev/serial/by-id/mine", "sensors": BEHIND},
            {"port": "/dev/serial/by-id/mine", "sensors": BEHIND},
        ),
        (
            "recordings.csv_player.ReplayDriver",
            REPLAY | {"speed": 2.0, "faults": {"slow_every": 7}},
            {"rate_hz": 20.0, "speed": 2.0, "faults": ReplayFaults(slow_every=7)},
        ),
        ("recordings.csv_player.ReplayDriver", REPLAY | {"pace": "fast"}, {"speed": None}),
    ],
)
def test_a_driver_is_told_what_the_scene_says(
    monkeypatch: pytest.MonkeyPatch, driver: str, tactile: dict[str, Any], told: dict[str, Any]
) -> None:
    monkeypatch.setattr(f"graspd.drivers.{driver}", Constructed)
    (constructed,) = assembly.build_drivers(scene(tactile))
    assert isinstance(constructed, Constructed)
    assert constructed.named | told == constructed.named


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
