"""The joint stream: what is a message, what an angle, which messages are new, and their times."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd.drivers.base import JOINTS, JointReading
from graspd.drivers.datagrams.joints import (
    JointCounters,
    JointMessage,
    JointStream,
    JointStreamDriver,
)
from graspd.drivers.datagrams.messages import Order, Stamp
from graspd.drivers.link import LinkState
from tests.drivers.palm.palm_stream import MS, joints
from tests.drivers.udp_standin import Receiver
from tests.kit.clock import Clock

LOOPBACK = "udp://127.0.0.1:0"


@pytest.fixture
def driver(receiver: Receiver, clock: Clock) -> Iterator[JointStreamDriver]:
    with JointStreamDriver(LOOPBACK, clock=clock) as driver:
        yield driver


def parse(data: bytes | str) -> tuple[JointMessage | None, JointCounters]:
    stream = JointStream()
    text = data.encode() if isinstance(data, str) else data
    return stream.parse(text), stream.counters


def message(seq: int | None = None, t_s: float | None = None, **angles: float) -> bytes:
    fields: dict[str, object] = {"joints": angles or {"FFJ3": 0.5}}
    fields |= {} if seq is None else {"seq": seq}
    fields |= {} if t_s is None else {"t": t_s}
    return json.dumps(fields).encode()


def test_the_example_of_the_documentation_is_read() -> None:
    found, counters = parse(
        '{"seq": 1041, "t": 12.31, "joints": {"FFJ3": 0.51, "FFJ4": -0.02, "THJ5": 0.3}}'
    )
    assert found is not None
    assert found.stamp == (1041, 12.31)
    assert found.names == ("FFJ3", "FFJ4", "THJ5")
    assert found.position_rad.tolist() == [0.51, -0.02, 0.3]
    assert not any(counters.as_dict().values())


IMPOSSIBLE = ["NaN", "1e999", "true", "null", '"0.5"', "3.4908", "-3.4908", "1" + "0" * 400]


@pytest.mark.parametrize(
    ("joints", "angles", "counted"),
    [
        # A hand's prefix does no harm; 200 degrees at most.
        ('"rh_WRJ1": -3.4906, "lh_LFJ5": 3.4906', {"WRJ1": -3.4906, "LFJ5": 3.4906}, {}),
        *(
            (f'"FFJ3": 0.5, "FFJ4": {angle}', {"FFJ3": 0.5, "FFJ4": math.nan}, {"bad_angles": 1})
            for angle in IMPOSSIBLE
        ),
        ('"FFJ3": 0.5, "rh_FFJ3": 0.6', {"FFJ3": math.nan}, {"bad_angles": 1}),
        ('"ffj3": 0.1, "FFJ3": 0.5', {"FFJ3": 0.5}, {"unknown_names": 1}),
        ('"elbow": 0.1, "FFJ3": 0.5', {"FFJ3": 0.5}, {"unknown_names": 1}),
    ],
)
def test_a_value_that_is_not_an_angle_leaves_others_valid(
    joints: str, angles: dict[str, float], counted: dict[str, int]
) -> None:
    found, counters = parse(f'{{"v": 3, "joints": {{{joints}}}, "note": [1, {{}}]}}')
    assert found is not None
    assert found.names == tuple(angles)
    assert found.position_rad.tolist() == pytest.approx(list(angles.values()), nan_ok=True)
    assert {name: n for name, n in counters.as_dict().items() if n} == counted


@given(
    st.dictionaries(st.sampled_from(("FFJ3", "rh_THJ5", "elbow")), st.floats() | st.booleans()),
    st.integers(0, 60),
    st.binary(max_size=2),
)
def test_a_damaged_message_gives_no_impossible_angle(
    angles: dict[str, float], at: int, damage: bytes
) -> None:
    data = json.dumps({"seq": 1, "joints": angles}).encode()
    found, counters = parse(data[:at] + damage + data[at + len(damage) :])
    assert (found is None) == counters.bad_messages
    if found is not None:
        assert set(found.names) <= set(JOINTS)
        assert not (np.abs(found.position_rad) > math.radians(200)).any()


@pytest.mark.parametrize(("step", "missed", "restarts"), [(1001, 1000, 0), (1002, 0, 1)])
def test_a_gap_of_over_a_thousand_counts_as_restart(step: int, missed: int, restarts: int) -> None:
    counters = JointCounters()
    order = Order(counters)
    for seq in (5, 5 + step):
        assert order.admits(Stamp(seq, None))
    assert (counters.missed_readings, counters.restarts) == (missed, restarts)


def test_messages_give_readings_and_seq_gaps_count_as_missed(
    driver: JointStreamDriver, receiver: Receiver
) -> None:
    receiver.send(*(message(seq, FFJ3=seq / 100) for seq in (3, 4, 7, 8)))
    readings = joints(driver.read_ready())
    assert [reading.seq for reading in readings] == [0, 1, 4, 5]
    assert [reading.position_rad[0] for reading in readings] == [0.03, 0.04, 0.07, 0.08]
    assert driver.stream.counters.readings == 4
    assert driver.stream.counters.missed_readings == 2


def test_a_message_without_a_known_joint_is_not_a_reading(
    driver: JointStreamDriver, receiver: Receiver
) -> None:
    receiver.send(message(1, elbow=0.1), b'{"joints": {}}')
    assert driver.read_ready() == []
    assert driver.link.state is LinkState.UP


def test_the_first_reading_after_a_sender_restart_is_interrupted() -> None:
    stream, readings = JointStream(), list[JointReading]()
    for seq in (*range(50, 60), *range(20), 5000):
        readings += stream.receive(message(seq), 0) or []
    # Ten of the old numbers are dropped; 5000 is more than a thousand ahead.
    assert [at for at, reading in enumerate(readings) if reading.interrupted] == [10, 20]


@pytest.mark.parametrize(
    ("sent", "made", "interrupted"),
    [
        # Sender's time, s; arrival and the reading's time, ms: a queue fills up and holds 500 ms.
        ([(5.0, 100), (5.01, 110), (5.02, 620), (5.03, 630)], [100, 110, 120.51, 130.52], None),
        # No time, one time for all messages, and milliseconds, which leap.
        ([(None, 100), (None, 110), (None, 620)], [100, 110, 620], None),
        ([(5.0, 100), (5.0, 110), (5.0, 620)], [100], None),
        ([(5000.0, 100), (5010.0, 110), (5020.0, 620)], [100], None),
        # A clock that was set an hour ahead: one message is lost.
        ([(5.0, 100), (3605.01, 110), (3605.02, 120), (3605.03, 130)], [100, 120, 130], 1),
    ],
    ids=["queue", "no time", "time stands", "milliseconds", "clock set"],
)
def test_sender_time_dates_joint_readings_and_its_leaps_are_dropped(
    sent: list[tuple[float | None, float]], made: list[float], interrupted: int | None
) -> None:
    stream, readings = JointStream(), list[JointReading]()
    for seq, (t_s, arrival_ms) in enumerate(sent):
        readings += stream.receive(message(seq, t_s), round(arrival_ms * MS)) or []
    assert [reading.t_ns / MS for reading in readings] == pytest.approx(made, abs=0.001)
    assert [at for at, reading in enumerate(readings) if reading.interrupted] == (
        [] if interrupted is None else [interrupted]
    )
    counted = stream.counters.as_dict()
    assert len(made) + counted["bad_messages"] + counted["old_messages"] == len(sent)
