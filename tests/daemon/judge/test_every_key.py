"""No value of any key of a scene makes bad, old or missing data `stable`.

The keys and their ranges come from the scene's own schema, so a new key is swept without a change
here. `Necessity` says what `stable` needs. test_fewer_fingers has other hands, test_learning a
judge that needs a session.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from graspd.daemon import scene as scenes
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.judge.decision import Limits
from graspd.daemon.judge.reasons import Decision
from graspd.daemon.scene import explained
from graspd.models.runtime import TactileModel
from tests.daemon.fakes import FINGERS, MS
from tests.daemon.judge.felt_hand import HELD, QUIET_READINGS, Feel, Flaw, Hand
from tests.daemon.scene.test_explained import keys_of

ELSEWHERE = {"tactile", "joints", "publish", "ask", "curve", "realtime", "record"}
"""Sections that say where readings come from and verdicts go. All others are swept."""
NAMES: Mapping[str, tuple[Any, ...]] = {
    "hand.name": ("left",),
    "hand.fingers": (),
    "model.name": (),  # follows from the fingers
    "model.path": (),
    "session.folder": (),
}
"""Values of keys that are names, fingers of a hand or paths; empty: the key is not varied."""
MOVED_COUNTS = 40.0
"""Mean change of a finger's counts that is motion even with few false alarms."""
COMBINATIONS, CHUNKS = 5, 2
TROUBLES = (
    Feel("rest", times=30),
    Feel("old", times=10),
    Feel(times=5, repeats=True),
    Feel(times=5, flaws=(Flaw(1, 0, 24, 1, 0),)),
    Feel(times=20, joints="none"),
    *(Feel(times=5, age_ns=age_ms * MS) for age_ms in (90, 101, 3000, 10_001)),
    *(Feel("other", step_ns=-ms * MS) for ms in (10, 200, 1500)),
    *(
        Feel(pose, step_ns=ms * MS)
        for ms in (95, 101, 150, 990, 4990)
        for pose in ("rest", "other")
    ),
)
"""Bad, old or missing readings, which may be `stable` only once they are a new, held grasp."""

Keys = dict[str, dict[str, Any]]


def values_of(place: str, kind: Mapping[str, Any]) -> list[Any]:
    """Return values of the key `place`, of schema `kind`: ends of its range, and some within."""
    if "enum" in kind:
        return list(kind["enum"])
    match kind["type"]:
        case "boolean":
            return [False, True]
        case "string":
            return list(NAMES[place])
        case "array" if place in NAMES:
            return list(NAMES[place])
        case "array":
            numbers = range(1, len(FINGERS) + 1)
            return [part for size in numbers for part in itertools.combinations(FINGERS, size)]
        case "integer":
            low, high = kind["minimum"], kind["maximum"]
            return [low, (low + high) // 2, high]
    low, high = (kind.get(f"exclusive{end}") for end in ("Minimum", "Maximum"))
    low = kind["minimum"] if low is None else low + 1e-3
    high = kind["maximum"] if high is None else high - 1e-3
    return [low, float(np.sqrt(max(low, 1e-3) * high)), high]


KEYS = {
    place: values_of(place, kind)
    for place, kind in keys_of(explained.schema())
    if "." in place and place.partition(".")[0] not in ELSEWHERE
}


def scene_of(values: Mapping[str, Any]) -> scenes.Scene:
    """Return a scene of a live hand with `values`, by `section.key`."""
    given: Keys = {
        "model": {"slip_threshold": 0.999},
        "tactile": {"driver": "spi", "port": "x"},
        "joints": {"driver": "stream", "source": "udp://127.0.0.1:5701"},
    }
    for place, value in values.items():
        section, key = place.split(".")
        given.setdefault(section, {})[key] = value
    return scenes.parse(given, Path("x"))


def run(values: Mapping[str, Any], seed: int) -> int:
    """Return the number of `stable` verdicts with the keys `values`, in eight troubles drawn by
    `seed`; -1: the scene is rightly refused."""
    try:
        plan = Plan.of(scene_of(values))
    except scenes.SceneError:
        assert values["gate.mode"] == "every"
        return -1
    assert values.get("gate.mode") != "every"
    threshold, gate = plan.scene.model.slip_threshold, plan.hand
    assert gate is not None
    hand = Hand(
        gate,
        lambda model, clock: assembly.build_pipeline(plan, cast(TactileModel, model), clock),
        Limits(plan.scene.max_age_ns, threshold),
        MOVED_COUNTS,
    )
    said = hand.play(Feel("rest", times=QUIET_READINGS))
    for trouble in np.random.default_rng(seed).permutation(len(TROUBLES))[:8].tolist():
        said += [*hand.play(HELD), *hand.play(TROUBLES[trouble]), *hand.play(Feel(times=5))]
    if gate.on_request:
        assert hand.judged <= hand.asked * (2 if gate.gate.early else 1)
    return sum(each.decision is Decision.STABLE for each in said)


def random_scenes(chunk: int) -> Iterator[dict[str, Any]]:
    random = np.random.default_rng(chunk)
    for _ in range(COMBINATIONS):
        yield {
            place: values[int(random.integers(len(values)))]
            for place, values in KEYS.items()
            if values and random.random() < (0.15 if place.startswith("risk.") else 0.4)
        }


@pytest.mark.parametrize("place", [place for place, values in KEYS.items() if values])
def test_no_value_of_a_key_makes_bad_data_stable(place: str) -> None:
    for seed, value in enumerate(KEYS[place]):
        run({place: value}, seed)


@pytest.mark.parametrize("chunk", range(CHUNKS))
def test_no_combination_of_keys_makes_bad_data_stable(chunk: int) -> None:
    for seed, values in enumerate(random_scenes(chunk)):
        run(values, seed)


def test_a_held_grasp_is_stable_by_the_defaults() -> None:
    assert run({}, 0) > 40
    assert {"gate.max_age_ms", "model.slip_threshold", "risk.explore"} < KEYS.keys()
