"""No value of any key of a scene makes bad, old or missing data `stable`.

The keys and their ranges come from the scene's own schema, so a new key is swept without a change
here. What `stable` needs is `Necessity`, written after the documentation; here it knows of the keys
only what their documentation says.
"""

from __future__ import annotations

import csv
import itertools
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.daemon import scene as scenes
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.judge.reasons import Decision
from graspd.drivers.base import ElectrodeFault, JointReading, TactileReading
from graspd.drivers.recordings.csv_player import DEMO_DAY
from graspd.models import zoo
from graspd.models.runtime import TactileModel
from tests.daemon.judge.necessity import EARLY_MS, STILL_MS, Necessity
from tests.kit.clock import Clock

MS = 1_000_000
FINGERS = ("ff", "mf", "th")
ELSEWHERE = {"tactile", "joints", "publish", "ask", "curve", "realtime", "record"}
"""Sections that say where readings come from and verdicts go. All others are swept."""
NAMES: Mapping[str, tuple[Any, ...]] = {
    "hand.name": ("left",),
    "model.name": (None,),  # follows from the fingers
    "model.path": (None,),
    "session.folder": (None,),
}
"""Values of the keys that are names and paths."""
MOVED_COUNTS = 40.0
"""Certainly motion, also where few false alarms are asked for: the poses are further apart."""
SESSION_GRASPS = 20
"""Grasps that a session needs (deploy/JUDGING.md)."""
COMBINATIONS, CHUNKS = 5, 2
SILENCES = tuple(itertools.product((85, 95, 101, 150, 990, 4990), ("rest", "shifted", "other")))
"""Lengths, ms, and what the hand does when the readings come again."""

Counts = NDArray[np.int64]
Keys = dict[str, dict[str, Any]]


def swept() -> dict[str, list[Any]]:
    """Values of each key, by `section.key`: both ends of its range, and some within."""
    schema = scenes.Scene.model_json_schema()
    sections = schema["properties"]
    keys: dict[str, list[Any]] = {}
    for name in sorted(sections.keys() - ELSEWHERE):
        (section,) = [each for each in kinds(sections[name], schema) if each["type"] == "object"]
        for key, kind in section["properties"].items():
            place = f"{name}.{key}"
            values = [each for one in kinds(kind, schema) for each in values_of(place, one)]
            keys[place] = list(dict.fromkeys(values))
    return keys


def kinds(kind: dict[str, Any], schema: dict[str, Any]) -> list[dict[str, Any]]:
    """What a key may be."""
    if "$ref" in kind:
        return kinds(schema["$defs"][kind["$ref"].rsplit("/", 1)[1]], schema)
    if "anyOf" in kind:
        return [each for one in kind["anyOf"] for each in kinds(one, schema)]
    return [kind]


def values_of(place: str, kind: dict[str, Any]) -> list[Any]:
    if "enum" in kind:
        return list(kind["enum"])
    match kind["type"]:
        case "null":
            return [None]
        case "boolean":
            return [False, True]
        case "string":
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


KEYS = swept()


def scene_of(keys: Keys) -> scenes.Scene:
    """A live hand with these keys, and the zoo's model for its fingers."""
    fingers = keys.get("hand", {}).get("fingers", FINGERS)
    (name,) = [name for name in zoo.judging(fingers) if name.startswith("small-session")]
    given: Keys = {section: dict(values) for section, values in keys.items()}
    given["model"] = {"slip_threshold": 0.999, **given.get("model", {}), "name": name}
    given["tactile"] = {"driver": "spi", "port": "x"}
    given["joints"] = {"driver": "stream", "source": "udp://127.0.0.1:5701"}
    without = {
        section: {key: value for key, value in values.items() if value is not None}
        for section, values in given.items()
    }
    return scenes.parse(without, Path("x"))


@cache
def model_of(name: str) -> TactileModel:
    return TactileModel(zoo.find(name))


@cache
def poses() -> dict[str, Counts]:
    """Shape (3, 24) each; the first is a grasp that the model calls stable."""
    with DEMO_DAY.open(newline="") as file:
        rows = list(csv.reader(file))[1:60]
    grasps = [np.array(row[2:], dtype=np.int64).reshape(3, 24) for row in rows if row[1] == "0"]
    rest = np.minimum(grasps[0] + 150 * (np.arange(72).reshape(3, 24) % 4), 4000)
    shift = np.random.default_rng(0).choice([-1, 1], rest.shape)
    return {
        "grasp": grasps[0],
        "rest": rest,
        "shifted": grasps[0] + 20 * shift,
        "other": grasps[0] + 60 * shift,
    }


class Bench:
    """One hand under one scene, and all that a `stable` needs."""

    def __init__(self, scene: scenes.Scene, seed: int) -> None:
        gate, fingers = scene.gate, scene.hand.fingers
        self.scene, self.seed = scene, seed
        self.random, self.clock = np.random.default_rng(seed), Clock()
        self.rows = [FINGERS.index(finger) for finger in fingers]
        model = model_of(scene.model.name or "")
        self.pipeline: Pipeline = assembly.build_pipeline(Plan.of(scene), model, self.clock)
        self.pipeline.boot_id = "b" * 32
        self.necessity = Necessity(
            poses()["rest"][self.rows],
            fingers,
            gate.fingers or fingers,
            EARLY_MS if gate.early else STILL_MS,
            moved_counts=MOVED_COUNTS,
        )
        self.sent = np.zeros((len(self.rows), 24), dtype=np.uint16)
        self.asked = False
        self.stable = 0

    def play(
        self,
        pose: str,
        times: int,
        *,
        age_ms: float = 0.0,
        without: int | None = None,
        joints: bool = True,
    ) -> None:
        """Sweeps of a pose. `without`: number of the finger that is missing."""
        for _ in range(times):
            self._wait(10.0, joints=joints)
            faults = np.zeros((len(self.rows), 24), dtype=np.uint8)
            if without is not None:
                faults[without % len(self.rows)] = ElectrodeFault.MISSING
            self._judge(pose, faults, round(age_ms * MS))

    def _wait(self, ms: float, *, joints: bool = True) -> None:
        self.clock.now_ns += round(ms * MS)
        if joints:
            angles = self.random.uniform(-0.0005, 0.0005, 1)
            reading = JointReading(self.clock(), 0, ("FFJ3",), angles)
            self.necessity.observe_joints(reading)
            self.pipeline.observe_joints(reading)

    def _judge(self, pose: str, faults: NDArray[np.uint8], age_ns: int) -> None:
        counts = self.sent
        if pose != "same":
            noise = self.random.integers(-3, 4, (3, 24))
            counts = (poses()[pose] + noise).clip(1, 4094).astype(np.uint16)[self.rows]
        self.sent = counts
        reading = TactileReading(self.clock() - age_ns, 0, counts, faults)
        self.necessity.observe(reading)
        said = self.pipeline.judge(reading)
        if said.decision is not Decision.STABLE:
            return
        self.stable += 1
        lacks = [*self.necessity.lacks()]
        if not 0 <= age_ns <= self.scene.gate.max_age_ms * MS:
            lacks.append("a reading that is not too old")
        if self.scene.gate.mode == "request" and not self.asked:
            lacks.append("a question")
        if self.scene.session.required and said.moment.grasp <= SESSION_GRASPS:
            lacks.append("a session")
        if said.p_slip is None or said.p_slip >= self.scene.model.slip_threshold:
            lacks.append("a probability below the threshold")
        given = self.scene.model_dump(exclude_defaults=True)
        assert not lacks, f"{pose} of seed {self.seed} with {given} is stable without {lacks}"

    def hold(self) -> None:
        hand = self.pipeline.hand
        if hand.tared is None or len(hand.tared) < len(self.rows):
            self.play("rest", 115)
        if self.random.random() < 0.7:
            self.pipeline.ask()
            self.asked = True
        self.play("grasp", 36)

    def silence(self, silence_ms: int, pose: str) -> None:
        """After a silence of the fingers, not of the joints, the hand has another pose."""
        for _ in range(silence_ms // 10 - 1):
            self._wait(10.0)
        self._wait(silence_ms % 10)
        self.play(pose, 8)

    def trouble(self, kind: int) -> None:
        """What must not be `stable`, or only if it is new again."""
        match kind:
            case 0:
                self.play("same", 5)
            case 1:
                self.play("grasp", 5, without=int(self.random.integers(3)))
            case 2:
                self.clock.now_ns -= int(self.random.choice([10, 200, 1500])) * MS
                self.play("shifted", 5)
            case 3:
                self.play("grasp", 5, age_ms=float(self.random.choice([90, 101, 3000, 10_001])))
            case 4:
                self.play("grasp", 20, joints=False)

    def run(self) -> None:
        drawn = [SILENCES[number] for number in self.random.permutation(len(SILENCES))[:2]]
        for silence_ms, pose in ((990, "shifted"), *drawn, (4990, "rest")):
            self.hold()
            self.silence(silence_ms, pose)
        for kind in self.random.permutation(5)[:3].tolist():
            self.hold()
            self.trouble(kind)


def sections(values: Mapping[str, Any]) -> Keys:
    keys: Keys = {}
    for place, value in values.items():
        section, key = place.split(".")
        keys.setdefault(section, {})[key] = value
    return keys


def run(values: Mapping[str, Any], seed: int) -> int:
    """Number of `stable` under these keys; -1: the scene is refused, as it should be."""
    values = {place: value for place, value in values.items() if value is not None}
    hand, required = values.get("hand.fingers", FINGERS), values.get("gate.fingers", ())
    refused = values.get("gate.mode") == "every" or not set(required) <= set(hand)
    try:
        scene = scene_of(sections(values))
    except scenes.SceneError:
        assert refused
        return -1
    assert not refused
    bench = Bench(scene, seed)
    bench.run()
    return bench.stable


def random_scenes(chunk: int) -> Iterator[dict[str, Any]]:
    random = np.random.default_rng(chunk)
    for _ in range(COMBINATIONS):
        yield {
            place: values[int(random.integers(len(values)))]
            for place, values in KEYS.items()
            if random.random() < (0.15 if place.startswith(("risk.", "session.")) else 0.4)
        }


@pytest.mark.parametrize("place", KEYS)
def test_no_value_of_a_key_makes_bad_data_stable(place: str) -> None:
    for seed, value in enumerate(KEYS[place]):
        run({place: value}, seed)


@pytest.mark.parametrize("chunk", range(CHUNKS))
def test_no_combination_of_keys_makes_bad_data_stable(chunk: int) -> None:
    for seed, values in enumerate(random_scenes(chunk)):
        run(values, seed)


def test_a_held_grasp_is_stable_by_the_defaults() -> None:
    assert run({}, 0) > 40


def test_each_section_that_judges_is_swept() -> None:
    assert {"gate.max_age_ms", "model.slip_threshold", "risk.explore", "hand.fingers"} < KEYS.keys()
    assert all(KEYS.values())
