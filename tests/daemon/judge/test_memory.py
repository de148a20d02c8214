"""A judge that takes over what another one knew says, from there on, the very same."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from graspd.biotac import Finger
from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.judge.memory import encode, recall, remember
from graspd.daemon.judge.pipeline import Judgement, Pipeline
from graspd.daemon.judge.reasons import Decision, Reason
from graspd.daemon.trust import trust
from graspd.drivers.base import ElectrodeFault, JointReading, Reading, TactileReading
from graspd.drivers.recordings.csv_player import DEMO_RECORDING, ReplayDriver
from graspd.models.runtime import TactileModel
from graspd.models.session_statistics import SessionState

FINGERS: tuple[Finger, ...] = ("ff", "mf", "th")
SECTIONS: dict[str, Any] = {
    "hand": {"fingers": FINGERS},
    "tactile": {"driver": "palm", "source": "udp://127.0.0.1:9870"},
    "joints": {"driver": "stream", "source": "udp://127.0.0.1:9871"},
}
STEP = 23
"""Readings between one judge and the next: some 200 places, of all that happens in a grasp."""
OLD = 30
"""So many tactile readings before was an old sweep sent first."""


@pytest.fixture(scope="module")
def readings() -> list[Reading]:
    with ReplayDriver([DEMO_RECORDING], FINGERS, speed=None, clock=lambda: 10**12) as driver:
        found: list[Reading] = []
        while not driver.exhausted:
            found += driver.read_ready()
    return found


@pytest.fixture(scope="module")
def troubled(readings: list[Reading]) -> list[Reading]:
    """The same with electrodes that jump, stand still or are missing, old sweeps and outages."""
    rng, sent = np.random.default_rng(4), list[NDArray[np.uint16]]()
    found: list[Reading] = []
    for place, reading in enumerate(readings):
        if place % 1900 > 1700 or (isinstance(reading, JointReading) and 700 < place < 1000):
            continue
        if isinstance(reading, TactileReading):
            counts, faults = reading.counts.copy(), reading.faults.copy()
            if place % 1000 > 600:
                counts[0, 3] += 400 * (rng.random() < 0.3)
                faults[2, 7] = ElectrodeFault.MISSING * (rng.random() < 0.5)
            if place % 800 > 400:
                counts[1, 11] = 2000
            # Not the first readings after somebody took over: nobody keeps what `motion` was.
            if place % 700 > 640 and len(found) % STEP > 2:
                counts[2] = sent[-OLD]  # of before that
            sent.append(counts[2])
            found.append(msgspec.structs.replace(reading, counts=counts, faults=faults))
        else:
            found.append(reading)
    return found


def judge(
    now: list[int], gate: dict[str, Any], model: str | TactileModel = "small-session"
) -> Pipeline:
    """Finds readings as old as `now` says."""
    named = model if isinstance(model, str) else model.contract.name
    sections = {**SECTIONS, "gate": gate, "model": {"name": named}}
    if gate.get("mode") == "every":
        del sections["joints"]
        sections["tactile"] = {"driver": "replay", "recordings": [str(DEMO_RECORDING)]}
    wanted = scene.parse(sections, Path("test"))
    loaded = assembly.load_model(wanted) if isinstance(model, str) else model
    return assembly.build_pipeline(wanted, loaded, lambda: now[0])


def judged(
    pipeline: Pipeline, now: list[int], readings: Sequence[Reading]
) -> list[tuple[Judgement, dict[str, Reason]]]:
    """What is said of readings, and of the health then; sometimes somebody asks."""
    found = []
    for reading in readings:
        now[0] = reading.t_ns
        if isinstance(reading, JointReading):
            if reading.seq % 97 == 0:
                pipeline.ask()
            pipeline.observe_joints(reading)
        else:
            said = msgspec.structs.replace(pipeline.judge(reading), judged_counts=None)
            found.append((said, pipeline.health()))
    return found


def handed_on(former: Pipeline, other: Pipeline) -> Pipeline:
    """The other one, with what this one knows, as a recording tells it."""
    assert former.session is not None
    assert other.session is not None
    memory = encode(remember(former))
    state = msgspec.json.encode(former.session.state())
    recall(other, memory, same_model=True)
    other.session.restore(msgspec.json.decode(state, type=SessionState))
    assert former.trust is not None
    assert other.trust is not None
    other.trust.restore(trust.decode(trust.encode(former.trust.state())))
    return other


@pytest.mark.parametrize("mode", ["settled", "request", "every"])
def test_whoever_takes_over_anywhere_judges_the_rest_the_same(
    mode: str, troubled: list[Reading]
) -> None:
    now, gate = [0], {"mode": mode}
    whole, other = judge(now, gate), judge(now, gate)
    model = assembly.load_model(scene.parse(SECTIONS, Path("test")))
    times, frozen = 0, 0
    for cut in range(0, len(troubled), STEP):
        part = troubled[cut : cut + STEP]
        expected = judged(whole, now, part)
        other = handed_on(other, judge(now, gate, model))
        assert judged(other, now, part) == expected
        times += sum(each.moment.judged for each, _ in expected)
        frozen += sum(Reason.FROZEN in each.reasons for each, _ in expected)
    assert times > 5
    assert frozen > 100


def test_what_is_taken_does_not_change_when_the_judge_goes_on(readings: list[Reading]) -> None:
    now = [0]
    pipeline = judge(now, {"mode": "settled"})
    judged(pipeline, now, readings[:2000])
    memory = remember(pipeline)
    before = encode(memory)
    judged(pipeline, now, readings[2000:])
    assert encode(memory) == before


def test_another_model_judges_the_grasp_at_hand_anew_and_knows_where_the_hand_rests(
    readings: list[Reading],
) -> None:
    now = [0]
    pipeline = judge(now, {"mode": "settled"})
    said: list[Judgement] = []
    place = 0
    while not (said and said[-1].decision is not Decision.UNKNOWN):
        said += [each for each, _ in judged(pipeline, now, readings[place : place + 1])]
        place += 1
    other = judge(now, {"mode": "settled"}, "cnn1")
    recall(other, encode(remember(pipeline)), same_model=False)
    found = [each for each, _ in judged(other, now, readings[place : place + 100])]
    assert found[0].decision is Decision.UNKNOWN
    assert Reason.NOT_TARED not in {reason for each in found for reason in each.reasons}
    assert found[0].moment.grasp == said[-1].moment.grasp
    assert any(each.moment.judged for each in found if each.moment.grasp == said[-1].moment.grasp)


def test_the_memory_of_another_hand_is_refused(readings: list[Reading]) -> None:
    now = [0]
    pipeline = judge(now, {"mode": "settled"})
    judged(pipeline, now, readings[:1000])
    sections = {**SECTIONS, "hand": {"fingers": ["ff", "th"]}}
    wanted = scene.parse(sections, Path("test"))
    two = assembly.build_pipeline(wanted, assembly.load_model(wanted))
    with pytest.raises(ValueError, match="shape"):
        recall(two, encode(remember(pipeline)), same_model=False)


@pytest.fixture(scope="module")
def known(readings: list[Reading]) -> bytes:
    now = [0]
    pipeline = judge(now, {"mode": "settled"})
    judged(pipeline, now, readings[:1500])
    return encode(remember(pipeline))


@pytest.fixture(scope="module")
def spare() -> tuple[Pipeline, list[int]]:
    """A judge that is given one memory after the other, and its clock."""
    now = [0]
    return judge(now, {"mode": "settled"}), now


ODD = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**63), 2**64 - 1),
    st.floats(),
    st.sampled_from(["(1,", "f8,("]),  # kinds of arrays that numpy cannot parse
    st.sampled_from(["", "idle", "<u2", "O", "<f8", [], {}, b"", b"\0" * 48, [0] * 40, ["<u2"]]),
)


@settings(max_examples=400)
@given(st.data(), ODD)
def test_whatever_is_in_a_memory_is_refused_or_can_be_gone_on_from(
    known: bytes,
    spare: tuple[Pipeline, list[int]],
    readings: list[Reading],
    data: st.DataObject,
    odd: object,
) -> None:
    tree = place = msgspec.msgpack.decode(zlib.decompress(known))
    while True:
        keys = sorted(place) if isinstance(place, dict) else list(range(len(place)))
        key = data.draw(st.sampled_from(keys))
        if not (isinstance(place[key], dict | list) and place[key]) or data.draw(st.booleans()):
            break
        place = place[key]
    place[key] = odd
    pipeline, now = spare
    try:
        recall(pipeline, zlib.compress(msgspec.msgpack.encode(tree)), same_model=True)
    except ValueError:
        return
    judged(pipeline, now, readings[1500:1504])


@pytest.mark.parametrize("data", [b"", b"\x80", zlib.compress(b"{}"), zlib.compress(bytes(9**7))])
def test_what_is_no_memory_is_refused(spare: tuple[Pipeline, list[int]], data: bytes) -> None:
    with pytest.raises(ValueError, match=r".+"):
        recall(spare[0], data, same_model=True)


@pytest.mark.parametrize(
    ("group", "part", "field", "value"),
    [
        ("judge", "judge", "readings", -1),
        ("hand", "motion", "last_ns", 2**63 - 1),
        ("hand", "motion", "total_ns", 2**63 - 1),
        ("hand", "motion", "number", 53),
        ("hand", "motion", "first", 100),
    ],
)
def test_numbers_that_no_judge_counts_to_are_refused(
    known: bytes,
    spare: tuple[Pipeline, list[int]],
    group: str,
    part: str,
    field: str,
    value: int,
) -> None:
    tree = msgspec.msgpack.decode(zlib.decompress(known))
    assert isinstance(tree[group][part][field], int)
    tree[group][part][field] = value
    with pytest.raises(ValueError, match=r".+"):
        recall(spare[0], zlib.compress(msgspec.msgpack.encode(tree)), same_model=True)
