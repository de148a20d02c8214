"""Bags of ROS 1 and 2 are judged as the same stream is; nothing stale or absent becomes a count."""

from __future__ import annotations

import contextlib
import gzip
import random
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from rosbags import rosbag1
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from graspd import judge, read_grasps, read_recording
from graspd.biotac import electrode_columns
from graspd.daemon.publish.messages import Verdict
from graspd.drivers.base import DriverError, RecordingError, TactileReading
from graspd.drivers.recordings.bag import SENSOR, TACTILE, BagDriver, fingers_of, has_joints
from graspd.drivers.recordings.csv_player import DEMO_RECORDING
from tests.drivers.recordings.bags import ABSENT, WITH_ARRAY, BagOf, Sweep, held
from tests.kit.inside import refused

START_NS = 1_542_585_600_000_000_000
PERIOD_NS = 10_000_000
JOINTS = ("FFJ3", "MFJ3", "THJ5", "FFJ2", "MFJ2", "THJ2")
FINGERS = ("ff", "mf", "th")
ROWS = 300
"""Number of first rows of the demo, which hold one grasp."""


def demo() -> pd.DataFrame:
    return pd.read_csv(DEMO_RECORDING)[:ROWS]


def sweeps_of(stream: pd.DataFrame, prefix: str = "rh_") -> list[Sweep]:
    """Rows of a stream as messages. `prefix`: of the joints' names."""
    return [
        Sweep(
            START_NS + round(row["t"] * 1e9),
            {finger: row[electrode_columns(finger)].to_numpy(dtype=np.int16) for finger in FINGERS},
            {prefix + name: float(row[name]) for name in JOINTS},
        )
        for _, row in stream.drop(columns=["object", "slipped"]).iterrows()
    ]


def noise(number: int, seed: int = 1) -> list[Sweep]:
    """Sweeps that never repeat."""
    counts = np.random.default_rng(seed).integers(1000, 3000, (number, 3, 24), dtype=np.int16)
    return [
        Sweep(START_NS + index * PERIOD_NS, dict(zip(FINGERS, sweep, strict=True)))
        for index, sweep in enumerate(counts)
    ]


def played(
    *paths: Path, fingers: Sequence[str] = FINGERS
) -> tuple[BagDriver, list[TactileReading]]:
    found: list[TactileReading] = []
    with BagDriver(paths, fingers) as driver:
        while not driver.exhausted:
            found += [each for each in driver.read_ready() if isinstance(each, TactileReading)]
    return driver, found


def readings_of(path: Path, fingers: Sequence[str] = FINGERS) -> list[TactileReading]:
    return played(path, fingers=fingers)[1]


@pytest.fixture(scope="module")
def as_stream(tmp_path_factory: pytest.TempPathFactory) -> Sequence[Verdict]:
    path = tmp_path_factory.mktemp("stream") / "stream.csv"
    demo().drop(columns=["object", "slipped"]).to_csv(path, index=False)
    return list(judge(path))


@pytest.mark.parametrize(
    ("version", "name", "options", "biotac"),
    [
        (1, "hand.bag", {}, {}),
        (1, "hand.bag", {}, {"biotac": WITH_ARRAY}),
        (2, "hand", {"storage_plugin": StoragePlugin.MCAP}, {}),
        (2, "hand", {"storage_plugin": StoragePlugin.SQLITE3, "version": 8}, {}),
    ],
)
def test_a_bag_is_judged_as_the_same_data_in_csv(
    tmp_path: Path,
    as_stream: Sequence[Verdict],
    version: int,
    name: str,
    options: dict[str, Any],
    biotac: dict[str, str],
) -> None:
    path = BagOf(version, **biotac).write(tmp_path / name, sweeps_of(demo()), **options)
    as_bag = list(judge(path))
    assert sum(verdict.judged for verdict in as_bag) == 1
    assert [(v.verdict, v.p_slip, v.reasons, v.gate) for v in as_bag] == [
        (v.verdict, v.p_slip, v.reasons, v.gate) for v in as_stream
    ]
    frame, wanted = read_recording(path), demo()
    columns = [name for name in wanted.columns if name not in ("t", "object", "slipped")]
    assert (frame[columns] == wanted[columns]).all().all()
    assert np.allclose(frame["t"] - frame["t"][0], wanted["t"], atol=1e-6)


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_a_ros_2_bags_storage_file_is_read_alone(tmp_path: Path, plugin: StoragePlugin) -> None:
    folder = BagOf(2).write(tmp_path / "hand", noise(30), storage_plugin=plugin)
    (storage,) = (path for path in folder.iterdir() if path.name != "metadata.yaml")
    assert [reading.seq for reading in readings_of(storage)] == list(range(30))
    assert len(readings_of(storage.rename(tmp_path / "hand.bin"))) == 30


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_a_storage_file_of_packed_messages_names_the_folder(
    tmp_path: Path, plugin: StoragePlugin
) -> None:
    folder = BagOf(2).write(
        tmp_path / "hand", noise(3), packing=CompressionMode.MESSAGE, storage_plugin=plugin
    )
    (storage,) = (path for path in folder.iterdir() if path.name != "metadata.yaml")
    with pytest.raises(RecordingError, match=r"packed \(zstd\), .* give the bag's folder"):
        fingers_of(storage)


def test_a_ros_2_bag_cut_off_at_its_start_is_refused(tmp_path: Path) -> None:
    folder = BagOf(2).write(tmp_path / "hand", noise(3), storage_plugin=StoragePlugin.MCAP)
    (folder / "hand.mcap").write_bytes(b"\x89MCAP0\r\n")
    assert f"{folder}: cannot be read: " in refused("replay", folder)


@pytest.mark.parametrize(
    ("rails", "absent", "is_there"),
    [(24, range(9), True), (12, range(10, 20), False), (11, range(30), True)],
)
def test_a_finger_with_counts_in_most_early_messages_has_a_sensor(
    tmp_path: Path, rails: int, absent: range, is_there: bool
) -> None:
    """Of the first 20 messages, in those of `absent` it has `rails` electrodes at a rail."""
    sweeps, counts = noise(30), np.array([0, 4095] * 12 + [1, 4094] * 12, dtype=np.int16)
    for place in absent:
        sweeps[place].electrodes["th"] = counts[24 - rails : 48 - rails]
    path = BagOf(1).write(tmp_path / "hand.bag", sweeps)
    assert fingers_of(path) == (FINGERS if is_there else ("ff", "mf"))
    assert played(path, fingers=("ff",))[0].period_ns == PERIOD_NS


@pytest.mark.parametrize(
    ("version", "options", "packing"),
    [
        *((1, {}, packing) for packing in rosbag1.Writer.CompressionFormat),
        (2, {"storage_plugin": StoragePlugin.SQLITE3}, CompressionMode.FILE),
        (2, {"storage_plugin": StoragePlugin.SQLITE3}, CompressionMode.MESSAGE),
        (2, {"storage_plugin": StoragePlugin.MCAP}, CompressionMode.STORAGE),
    ],
)
def test_a_packed_bag_that_unpacks_to_too_much_is_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    version: int,
    options: dict[str, Any],
    packing: Any,  # noqa: ANN401
) -> None:
    path = BagOf(version).write(tmp_path / "hand", noise(30), packing=packing, **options)
    assert len(readings_of(path)) == 30
    monkeypatch.setattr("graspd.drivers.recordings.bag.CHUNK_MAX_BYTES", 100)
    monkeypatch.setattr("graspd.drivers.recordings.kinds.COPIED_BYTES_MAX", 1000)
    with pytest.raises(RecordingError, match=r"unpacks to more than 100"):
        fingers_of(path)


@pytest.mark.parametrize(
    ("change", "left", "repeats"),
    [
        (lambda sweeps: sweeps, 70, 0),
        # The topic at 100 Hz repeats 2 of 7 of what comes at 71.43 Hz, with the same stamp or not.
        (lambda sweeps: held(sweeps, same_stamp=True), 50, 20),
        (lambda sweeps: held(sweeps, same_stamp=False), 50, 20),
        (lambda sweeps: sweeps[:40] + sweeps[30:], 70, 10),
    ],
)
def test_a_repeated_message_is_dropped_and_counted(
    tmp_path: Path, change: Callable[[list[Sweep]], list[Sweep]], left: int, repeats: int
) -> None:
    path = BagOf(1).write(tmp_path / "hand.bag", change(noise(70)))
    counters = played(path)[0].counters
    assert (counters.readings, counters.repeats) == (left, repeats)


@pytest.mark.parametrize(("back_ns", "left"), [(900_000_000, 20), (1_000_000_000, 40)])
def test_messages_after_a_clock_set_back_a_second_are_kept(
    tmp_path: Path, back_ns: int, left: int
) -> None:
    first, sweeps = BagOf(1).write(tmp_path / "1.bag", noise(20)), noise(20, seed=2)
    later = [each._replace(t_ns=each.t_ns + 19 * PERIOD_NS - back_ns) for each in sweeps]
    _, readings = played(first, BagOf(1).write(tmp_path / "2.bag", later), fingers=("ff",))
    assert len(readings) == left


def test_a_bag_whose_stamps_stand_still_logs_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = BagOf(1).write(tmp_path / "hand.bag", [each._replace(t_ns=10**18) for each in noise(30)])
    assert len(readings_of(path)) == 1
    assert "header of 29 of 30 messages has no newer stamp" in caplog.text
    caplog.clear()
    half = held(noise(4), same_stamp=True)[2:]
    assert len(readings_of(BagOf(1).write(tmp_path / "half.bag", half))) == 1
    assert "no newer stamp" not in caplog.text


def test_an_unstamped_message_beyond_64_bits_is_refused(tmp_path: Path) -> None:
    late = noise(1)[0]._replace(t_ns=0, later_ns=1 << 63)
    path = BagOf(2).write(tmp_path / "hand", [late], storage_plugin=StoragePlugin.MCAP)
    with pytest.raises(RecordingError, match=r"the time 9223372036\.85 s is later than any"):
        fingers_of(path)


def test_a_bag_whose_values_freeze_gets_only_unknown_verdicts(tmp_path: Path) -> None:
    sweeps = sweeps_of(demo())
    stuck = [sweeps[110]._replace(t_ns=sweep.t_ns) for sweep in sweeps[110:]]
    path = BagOf(1).write(tmp_path / "hand.bag", [*sweeps[:110], *stuck])
    with pytest.warns(UserWarning, match="nothing was judged"):
        assert {verdict.verdict for verdict in judge(path)} == {"unknown"}


def test_values_not_counts_are_flagged_and_absent_sensors_refused(tmp_path: Path) -> None:
    sweeps = noise(30)
    sweeps[25].electrodes["ff"][:5] = -1, 4096, 5000, 0, 4095  # a count has 12 bits
    path = BagOf(1).write(tmp_path / "hand.bag", sweeps)
    driver, readings = played(path)
    assert driver.counters.faulty_readings == 1
    reading = readings[25]
    assert reading.counts[0, :5].tolist() == [0, 0, 0, 0, 4095]
    assert np.argwhere(reading.faults).tolist() == [[0, 0], [0, 1], [0, 2]]
    with pytest.raises(RecordingError, match="no sensor on rf, only on ff, mf, th"):
        readings_of(path, ("ff", "rf"))


def test_a_gzipped_bag_is_refused_with_advice_to_unpack(tmp_path: Path) -> None:
    path = BagOf(1).write(tmp_path / "hand.bag", noise(5))
    path.write_bytes(gzip.compress(path.read_bytes()))
    assert "is a packed bag: `gunzip` it first" in refused("replay", path)
    with pytest.raises(RecordingError, match="does not say how lifts ended"):
        read_grasps(path)


def test_a_bag_of_a_biotac_with_19_electrodes_is_refused(tmp_path: Path) -> None:
    sweeps = noise(30)
    for sweep in sweeps:
        sweep.electrodes["th"] = ABSENT[:19]
    path = BagOf(1).write(tmp_path / "hand.bag", sweeps)
    with pytest.raises(RecordingError, match="BioTac with 19 electrodes; an SP has 24"):
        fingers_of(path)


def test_options_of_tables_are_refused_for_a_bag(tmp_path: Path) -> None:
    path = BagOf(1).write(tmp_path / "hand.bag", noise(5))
    said = "is a ROS 1 bag, which is played as it is: no "
    for options in (["--as", "table"], ["--rate-hz", "50"], ["--loop"], ["--strict"]):
        assert f"{said}{options[0]}" in refused("replay", path, *options)
    with pytest.raises(RecordingError, match=f"{said}read_as"):
        list(judge(path, read_as="table"))
    with pytest.raises(RecordingError, match=f"{said}rate_hz"):
        read_recording(path, rate_hz=50.0)


@pytest.mark.parametrize(
    ("all_fields", "fields", "said"),
    [
        ("Biotac[5] tactiles\nHeader header", "int32[24] electrodes", "no sensor with counts in 1"),
        ("Biotac[5] tactiles", "int16[] electrodes", "without header or list of tactiles"),
        ("Header header\nBiotac tactiles", "int16[] electrodes", "without header or list"),
        ("Header header\nBiotac[5] tactiles", "float64[] electrodes", "without whole numbers"),
        ("Header header\nBiotac[5] tactiles", "int16 electrodes", "without whole numbers"),
    ],
)
def test_unusual_message_definitions_are_refused_with_the_reason(
    tmp_path: Path, all_fields: str, fields: str, said: str
) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(fields, SENSOR) | get_types_from_msg(all_fields, TACTILE))
    # A header at 0 and counts of 0, or a little of them; in 32 bits all are above 65535.
    nothing = np.full(600, 1 << 16, dtype="<u4").tobytes()
    with rosbag1.Writer(tmp_path / "hand.bag") as writer:
        where = writer.add_connection("/rh/tactile", TACTILE, typestore=store)
        writer.write(where, START_NS, nothing[: 5 * 24 * 4] + bytes(16))
    with pytest.raises(RecordingError, match=said):
        fingers_of(tmp_path / "hand.bag")


def test_the_joints_of_the_other_hand_are_left_out(tmp_path: Path) -> None:
    path = BagOf(1).write(tmp_path / "hand.bag", sweeps_of(demo()[:30], prefix="lh_"))
    assert "FFJ3" not in read_recording(path)
    left = BagOf(1).write(
        tmp_path / "left.bag", sweeps_of(demo()[:30], prefix="lh_"), topic="/lh/tactile"
    )
    assert (read_recording(left)["FFJ3"] == demo()["FFJ3"][:30]).all()


@pytest.mark.parametrize("prefix", ["", "rh_", "RH_"])
def test_joint_names_in_a_bag_may_have_any_letter_case(tmp_path: Path, prefix: str) -> None:
    angles = {prefix + "FFJ3": 0.5, prefix + "thj5": 0.7, "LH_THJ2": 0.1}
    path = BagOf(1).write(tmp_path / "hand.bag", [noise(1)[0]._replace(angles=angles)])
    frame = read_recording(path)
    assert (frame["FFJ3"].tolist(), frame["THJ5"].tolist()) == ([0.5], [0.7])
    assert "THJ2" not in frame


def test_a_joint_reported_for_both_hands_has_no_angle(tmp_path: Path) -> None:
    angles = {"rh_FFJ3": 0.5, "lh_FFJ3": 0.6, "rh_THJ5": 0.7}
    sweeps = [sweep._replace(angles=angles) for sweep in noise(3)]
    path = BagOf(1).write(tmp_path / "hand.bag", sweeps, topic="/tactile")
    frame = read_recording(path)
    assert frame["FFJ3"].isna().all()
    assert (frame["THJ5"] == 0.7).all()


def test_of_two_hands_in_a_bag_the_right_is_played(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bag, path, sweeps = BagOf(1), tmp_path / "hand.bag", noise(2)
    with rosbag1.Writer(path) as writer:
        writer.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=bag.store)
        for hand, sweep in zip(("lh", "rh"), sweeps, strict=True):
            where = writer.add_connection(f"/{hand}/tactile", TACTILE, typestore=bag.store)
            writer.write(where, START_NS, bag.store.serialize_ros1(bag.tactile(sweep), TACTILE))
    (reading,) = readings_of(path)
    assert (reading.counts[0] == sweeps[1].electrodes["ff"]).all()
    assert "/lh/tactile is left out" in caplog.text
    assert not has_joints(path)


def test_a_message_with_too_few_electrodes_is_dropped_and_counted(tmp_path: Path) -> None:
    sweeps = noise(3)
    sweeps[1].electrodes["ff"] = ABSENT[:20]
    path = BagOf(1).write(tmp_path / "hand.bag", sweeps)
    driver, readings = played(path)
    assert (len(readings), driver.counters.malformed) == (2, 1)


def test_joints_are_read_from_joint_states_among_several_topics(tmp_path: Path) -> None:
    bag, path, kind = BagOf(1), tmp_path / "hand.bag", "sensor_msgs/msg/JointState"
    with rosbag1.Writer(path) as writer:
        for topic, angle in (("/rh/j", 0.6), ("/joint_states", 0.5), ("/j", 0.7)):
            joints = bag.joints(START_NS - PERIOD_NS, {"rh_FFJ3": angle})
            where = writer.add_connection(topic, kind, typestore=bag.store)
            writer.write(where, START_NS - PERIOD_NS, bag.store.serialize_ros1(joints, kind))
        where = writer.add_connection("/rh/tactile", TACTILE, typestore=bag.store)
        sweep = bag.tactile(noise(1)[0])
        writer.write(where, START_NS, bag.store.serialize_ros1(sweep, TACTILE))
    assert read_recording(path)["FFJ3"].tolist() == [0.5]
    assert has_joints(path)


def test_bags_of_different_hands_are_refused_as_one_run(tmp_path: Path) -> None:
    bags = [
        BagOf(1).write(tmp_path / f"{hand}.bag", noise(5), topic=f"/{hand}/tactile")
        for hand in ("rh", "lh")
    ]
    with BagDriver(bags, FINGERS) as driver:
        readings = [driver.read_ready() for _ in range(5)]
        assert all(readings)
        with pytest.raises(RecordingError, match=r"lh\.bag: has /lh/tactile, .* /rh/tactile"):
            driver.read_ready()


def test_a_bag_needs_a_tactile_topic_and_refuses_gate_every(tmp_path: Path) -> None:
    bag = BagOf(1)
    with rosbag1.Writer(tmp_path / "arm.bag") as writer:
        writer.add_connection("/arm/joints", "sensor_msgs/msg/JointState", typestore=bag.store)
    assert "no topic of sr_robot_msgs/BiotacAll, but /arm/joints" in refused(
        "replay", tmp_path / "arm.bag"
    )
    path = bag.write(tmp_path / "hand.bag", noise(5))
    said = refused("replay", path, "--gate", "every")
    assert "gate mode `every` judges each row of a grasp table" in said


@pytest.mark.parametrize("seed", range(4))
def test_a_damaged_bag_raises_only_driver_errors(tmp_path: Path, seed: int) -> None:
    chance = random.Random(seed)
    path = BagOf(1).write(tmp_path / "hand.bag", noise(20))
    data = bytearray(path.read_bytes())
    if seed % 4 == 0:
        del data[chance.randrange(len(data)) :]
    for _ in range(chance.randrange(5)):
        data[chance.randrange(len(data))] = chance.randrange(256)
    path.write_bytes(bytes(data))
    with contextlib.suppress(DriverError):
        readings_of(path)
