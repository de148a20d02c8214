"""From a scene to its parts: every key arrives where it belongs, and nothing else is loaded."""

from __future__ import annotations

import itertools
import re
import shutil
import tomllib
from pathlib import Path
from typing import Any, cast

import pytest
from msgspec.structs import replace

from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.assembly.sources import LinkLogs, Tables
from graspd.daemon.judge.reasons import Decision, Reason
from graspd.daemon.scene import Scene, SceneError, parse
from graspd.drivers.base import DriverError, LinkCause, LinkError, RecordingError, TactileReading
from graspd.drivers.palm.calibration import CalibrationError
from graspd.drivers.recordings.csv_player import DEMO_TABLE, ReplayDriver
from graspd.models import zoo
from graspd.models.contract import ModelError
from tests.daemon.fakes import Clock, FakeDriver, reading

REPLAY = {"driver": "replay", "recordings": [str(DEMO_TABLE)]}
SPI: dict[str, Any] = {"driver": "spi", "port": "/nowhere"}
PALM: dict[str, Any] = {"driver": "palm", "source": "udp://127.0.0.1:9870"}


def scene_of(tactile: dict[str, Any], **sections: dict[str, Any]) -> Scene:
    return parse({"tactile": tactile, **sections}, Path("scene.toml"))


TRUST = {
    "": (True, None, 0),
    "[learn]\nenabled = false": None,
    "[risk]": (True, 0.05, 50),
    "[risk]\nmax_slip_when_stable = 0.1\nwarm_up = 7\n[learn]\nenabled = false": (False, 0.1, 7),
}


@pytest.mark.parametrize("text", TRUST)
def test_the_scene_decides_on_learning_and_risk(text: str) -> None:
    scene = scene_of(REPLAY, **tomllib.loads(text))
    trust = assembly.build_pipeline(Plan.of(scene), assembly.load_model(scene), Clock()).trust
    if TRUST[text] is None:
        assert trust is None
    else:
        assert trust is not None
        report = trust.report()
        assert (trust.learns, report.target, report.warm_up_left) == TRUST[text]


@pytest.mark.parametrize("threshold", [1e-9, 1 - 1e-9])
def test_the_scenes_slip_threshold_and_max_age_decide_the_verdict(threshold: float) -> None:
    scene = scene_of(REPLAY, model={"slip_threshold": threshold}, gate={"max_age_ms": 1.0})
    driver = assembly.build_drivers(Plan.of(scene))[0]
    driver.open()
    (first,) = driver.read_ready()
    driver.close()
    clock = Clock(first.t_ns)
    pipeline = assembly.build_pipeline(Plan.of(scene), assembly.load_model(scene), clock)
    assert first.t_ns == clock()
    judgement = pipeline.judge(first)  # type: ignore[arg-type]
    assert judgement.decision is (Decision.SLIP if threshold < 0.5 else Decision.STABLE)
    clock.now_ns += 2_000_000
    assert pipeline.judge(reading(clock() - 1_500_000)).decision is Decision.UNKNOWN


def test_a_replayed_table_measures_age_by_the_drivers_clock() -> None:
    """Now is the driver's `handed_over_ns`; by the computer's clock both would be stale."""
    source = Tables([DEMO_TABLE], {})
    scene = source.scene({}, {}, None)
    parts = source.parts(scene, assembly.load_model(scene), None)
    with cast(ReplayDriver, parts.drivers[0]) as driver:
        (first,) = driver.read_ready()
        driver.handed_over_ns = 2_000_000
        for t_ns, is_stale in ((1_000_000, False), (-(10**10), True)):
            judged = parts.pipeline.judge(replace(cast(TactileReading, first), t_ns=t_ns))
            assert (Reason.STALE in judged.reasons) is is_stale


def test_a_replayed_link_log_is_judged_as_its_scene_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    log, path = Path("can.log"), Path("sub", "scene.toml")
    path.parent.mkdir()
    log.write_text("(1700000000.000000) can0 100#0000000000000000\n")
    shutil.copy(zoo.find("small-session"), "sub/mine.onnx")
    sections = "[learn]\nenabled = false\n[risk]\nwarm_up = 7\n"
    path.write_text(f'[tactile]\ndriver = "can"\n[model]\npath = "mine.onnx"\n{sections}')
    source = LinkLogs([log], path)
    scene = source.scene({}, {}, None)
    trust = source.parts(scene, assembly.load_model(scene), None).pipeline.trust
    assert trust is not None
    assert (trust.learns, trust.report().warm_up_left) == (False, 7)


def hand(fingers: tuple[str, ...], tactile: dict[str, Any] = SPI, **model: str) -> Scene:
    return scene_of(tactile, hand={"fingers": fingers}, model=model)


SOME = [
    *itertools.permutations(("ff", "mf", "th"), 1),
    *itertools.permutations(("ff", "mf", "th"), 2),
]


@pytest.mark.parametrize(
    ("name", "fingers", "file"),
    [
        # The alphabet happens to go from the first finger to the thumb.
        *((None, fingers, "-".join(("small-session", *sorted(fingers)))) for fingers in SOME),
        ("small-session", ("ff", "mf", "th"), "small-session"),
        ("small-session", ("th", "mf", "ff"), "small-session"),
        ("small-session-ff-th", ("ff", "th"), "small-session-ff-th"),
        # A form has no forms: this is not `small-session-ff` for a thumb.
        ("small-session-ff", ("th",), "small-session-ff"),
        ("cnn1", ("ff", "th"), "cnn1"),
        ("small-session", ("ff", "rf"), "small-session"),
    ],
)
def test_fewer_fingers_get_the_models_variant_for_them_if_any(
    name: str | None, fingers: tuple[str, ...], file: str
) -> None:
    scene = hand(fingers) if name is None else hand(fingers, name=name)
    assert assembly.model_path(scene).name == f"{file}.onnx"
    if name is None:
        assert assembly.load_model(scene).contract.fingers == tuple(sorted(fingers))


@pytest.mark.parametrize(
    ("scene", "says"),
    [
        (hand(("ff", "th"), name="cnn1"), "the zoo has small-session-ff-th for these"),
        (hand(("ff", "rf")), "the zoo has no model for these"),
    ],
    ids=["cnn1", "ring finger"],
)
def test_a_model_of_other_fingers_is_refused_naming_fitting_models(scene: Scene, says: str) -> None:
    with pytest.raises(ModelError, match=r"judges the fingers .* the hand has ") as refusal:
        assembly.build_pipeline(Plan.of(scene), assembly.load_model(scene))
    assert str(refusal.value).endswith(f": {says}")


@pytest.mark.parametrize(
    ("tactile", "sensors"),
    [
        (SPI, ["th", "ff"]),
        ({"driver": "can"}, ["th", "ff"]),
        (SPI | {"sensors": ["mf", "th", "ff"]}, ["mf", "th", "ff"]),
        (PALM, None),
    ],
    ids=["spi", "can", "spi-sensors", "palm"],
)
def test_fingers_in_another_order_are_refused_with_working_advice(
    tactile: dict[str, Any], sensors: list[str] | None
) -> None:
    scene = hand(("th", "ff"), tactile)
    with pytest.raises(ModelError, match="write ") as refusal:
        assembly.build_pipeline(Plan.of(scene), assembly.load_model(scene))
    advice = str(refusal.value).partition("write ")[2]
    wanted = tomllib.loads("\n".join(re.findall(r"[a-z]+\.[a-z]+ = \[[^]]*\]", advice)))
    assert wanted["hand"] == {"fingers": ["ff", "th"]}
    # What was wired in the order th, ff stays so.
    as_written = hand(("ff", "th"), tactile | wanted.get("tactile", {}))
    assembly.build_pipeline(Plan.of(as_written), assembly.load_model(as_written))
    assert (tactile | wanted.get("tactile", {})).get("sensors") == sensors


class Constructed:
    """Stands in for a driver's class; keeps its named arguments in `named`."""

    def __init__(self, *_positional: object, **named: object) -> None:
        self.named = named


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
            REPLAY | {"loop": True},
            {"speed": 1.0, "loop": True},
        ),
        ("recordings.csv_player.ReplayDriver", REPLAY | {"pace": "fast"}, {"speed": None}),
    ],
)
def test_a_driver_gets_the_options_of_the_scene(
    monkeypatch: pytest.MonkeyPatch, driver: str, tactile: dict[str, Any], told: dict[str, Any]
) -> None:
    monkeypatch.setattr(f"graspd.drivers.{driver}", Constructed)
    (constructed,) = assembly.build_drivers(Plan.of(scene_of(tactile)))
    assert isinstance(constructed, Constructed)
    assert constructed.named | told == constructed.named


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
def test_open_driver_raises_scene_error_except_for_link_errors(
    raised: Exception, expected: type[Exception]
) -> None:
    class Refusing(FakeDriver):
        def open(self) -> None:
            raise raised

    with pytest.raises(expected, match=str(raised)):
        assembly.open_driver(Refusing([], Clock()))


def test_replaying_outcomes_needs_a_recording_that_has_them(tmp_path: Path) -> None:
    bare = tmp_path / "bare.csv"
    header, row, *_ = DEMO_TABLE.read_text().splitlines()
    bare.write_text(header.replace("slipped", "other") + f"\n{row}\n")
    wanted = scene_of({"driver": "replay", "recordings": [str(bare)], "outcomes": True})
    with pytest.raises(SceneError, match="outcomes needs the column `slipped`"):
        assembly.build_drivers(Plan.of(wanted))
