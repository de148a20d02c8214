"""From a scene to its parts: every key arrives where it belongs, and nothing else is loaded."""

from __future__ import annotations

import itertools
import re
import tomllib
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import Assembly, Parts
from graspd.daemon.judge.reasons import Decision
from graspd.daemon.scene import Scene, parse
from graspd.drivers.recordings.csv_player import DEMO_TABLE
from graspd.models.contract import ModelError
from tests.daemon.fakes import Clock, reading

REPLAY = {"driver": "replay", "recordings": [str(DEMO_TABLE)]}


TRUST = {
    "": (True, None, 0),
    "[learn]\nenabled = false": None,
    "[risk]": (True, 0.05, 50),
    "[risk]\nmax_slip_when_stable = 0.1\nwarm_up = 7\n[learn]\nenabled = false": (False, 0.1, 7),
}


@pytest.mark.parametrize("text", TRUST)
def test_outcomes_teach_and_a_risk_is_kept_as_the_scene_says(text: str) -> None:
    data = {"tactile": REPLAY, **tomllib.loads(text)}
    scene = parse(data, Path("scene.toml"))
    trust = assembly.build_pipeline(scene, assembly.load_model(scene), Clock()).trust
    if TRUST[text] is None:
        assert trust is None
    else:
        assert trust is not None
        report = trust.report()
        assert (trust.learns, report.target, report.warm_up_left) == TRUST[text]


@pytest.mark.parametrize("threshold", [1e-9, 1 - 1e-9])
def test_the_threshold_of_the_scene_decides(threshold: float) -> None:
    scene = parse(
        {"tactile": REPLAY, "model": {"slip_threshold": threshold}, "gate": {"max_age_ms": 1.0}},
        Path("scene.toml"),
    )
    driver = assembly.build_drivers(scene)[0]
    driver.open()
    (first,) = driver.read_ready()
    driver.close()
    clock = Clock(first.t_ns)
    pipeline = assembly.build_pipeline(scene, assembly.load_model(scene), clock)
    assert first.t_ns == clock()
    judgement = pipeline.judge(first)  # type: ignore[arg-type]
    assert judgement.decision is (Decision.SLIP if threshold < 0.5 else Decision.STABLE)
    clock.now_ns += 2_000_000
    assert pipeline.judge(reading(clock() - 1_500_000)).decision is Decision.UNKNOWN


SPI: dict[str, Any] = {"driver": "spi", "port": "/nowhere"}
PALM: dict[str, Any] = {"driver": "palm", "source": "udp://127.0.0.1:9870"}
OTHERS = "cnn1, cnn1-session, mlp, rf, small-electrodes, small-session, svm"


def hand(fingers: tuple[str, ...], tactile: dict[str, Any] = SPI, **model: str) -> Scene:
    content = {"hand": {"fingers": fingers}, "tactile": tactile, "model": model}
    return parse(content, Path("scene.toml"))


@pytest.mark.parametrize(
    "fingers",
    [
        fingers
        for number in (1, 2)
        for fingers in itertools.permutations(("ff", "mf", "th"), number)
    ],
    ids="-".join,
)
def test_a_hand_with_fewer_sensors_gets_the_model_of_just_these_fingers(
    fingers: tuple[str, ...],
) -> None:
    in_order = sorted(fingers)  # the alphabet happens to go from the first finger to the thumb
    assert assembly.model_path(hand(fingers)).stem == "-".join(("small-session", *in_order))
    assert assembly.load_model(hand(fingers)).contract.fingers == tuple(in_order)


@pytest.mark.parametrize(
    ("name", "fingers", "file"),
    [
        ("small-session", ("ff", "mf", "th"), "small-session"),
        ("small-session", ("th", "mf", "ff"), "small-session"),
        ("small-session-ff-th", ("ff", "th"), "small-session-ff-th"),
        # A form has no forms: this is not `small-session-ff` for a thumb.
        ("small-session-ff", ("th",), "small-session-ff"),
        ("cnn1", ("ff", "th"), "cnn1"),
        ("small-session", ("ff", "rf"), "small-session"),
    ],
)
def test_a_name_that_has_no_form_for_the_hand_is_taken_as_it_is(
    name: str, fingers: tuple[str, ...], file: str
) -> None:
    assert assembly.model_path(hand(fingers, name=name)).name == f"{file}.onnx"


@pytest.mark.parametrize(
    ("scene", "says"),
    [
        (hand(("ff", "th"), name="cnn1"), "the zoo has small-session-ff-th for these"),
        (hand(("ff", "mf", "th"), name="small-session-ff-th"), f"the zoo has {OTHERS} for these"),
        (hand(("th",), name="small-session-ff"), "the zoo has small-session-th for these"),
        (hand(("ff", "rf")), "the zoo has no model for these"),
    ],
    ids=["cnn1", "two of three", "thumb", "ring finger"],
)
def test_a_model_of_other_fingers_is_refused_and_those_that_fit_are_named(
    scene: Scene, says: str
) -> None:
    with pytest.raises(ModelError, match=r"judges the fingers .* the hand has ") as refusal:
        assembly.build_pipeline(scene, assembly.load_model(scene))
    assert str(refusal.value).endswith(f": {says}")


@pytest.mark.parametrize(
    ("tactile", "sensors"),
    [
        (SPI, ["th", "ff"]),
        ({"driver": "can"}, ["th", "ff"]),
        ({"driver": "can", "format": "sweep_fd"}, None),
        (SPI | {"sensors": ["mf", "th", "ff"]}, ["mf", "th", "ff"]),
        (PALM, None),
    ],
    ids=["spi", "can", "can-fd", "spi-sensors", "palm"],
)
def test_fingers_in_another_order_are_told_what_to_write_instead(
    tactile: dict[str, Any], sensors: list[str] | None
) -> None:
    scene = hand(("th", "ff"), tactile)
    with pytest.raises(ModelError, match="write ") as refusal:
        assembly.build_pipeline(scene, assembly.load_model(scene))
    advice = str(refusal.value).partition("write ")[2]
    wanted = tomllib.loads("\n".join(re.findall(r"[a-z]+\.[a-z]+ = \[[^]]*\]", advice)))
    assert wanted["hand"] == {"fingers": ["ff", "th"]}
    # What was wired in the order th, ff stays so.
    as_written = hand(("ff", "th"), tactile | wanted.get("tactile", {}))
    assembly.build_pipeline(as_written, assembly.load_model(as_written))
    assert (tactile | wanted.get("tactile", {})).get("sensors") == sensors


def test_grasps_are_named_by_the_start_that_tells_of_them_also_where_a_former_scene_goes_on() -> (
    None
):
    parts = Parts.of(scene := parse({"tactile": REPLAY}, Path("s")), assembly.load_model(scene))
    named = []
    for _ in range(2):
        with ExitStack() as stack:
            outbox = Assembly(parts, stack).build_outbox()
        judgement = parts.pipeline.silence(0)
        named.append(outbox.verdict(judgement, 0, 1)[0].boot_id)
        assert parts.pipeline.boot_id == named[-1]
    assert named[0] != named[1]
