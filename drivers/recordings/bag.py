"""Driver that plays ROS bags of a Shadow hand with BioTac SP sensors, without ROS. Extra `bag`.

Topics: one of type sr_robot_msgs/BiotacAll, such as `/rh/tactile`, and sensor_msgs/JointState,
`/joint_states`. Times are those of the headers, or of the bag where a header has none. Tactile
messages come at 100 Hz, new values of the sensors at 71.43 Hz.
"""

from __future__ import annotations

import bz2
import logging
import math
import struct
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import compress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import apsw
import lz4.frame
import numpy as np
from numpy.typing import NDArray
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection, MessageDefinitionFormat, Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from graspd.biotac import COUNT_MAX, ELECTRODES, FINGERS, FORMER_ELECTRODES, Finger
from graspd.drivers.base import (
    DriverCounters,
    ElectrodeFault,
    JointReading,
    Reading,
    RecordingError,
    TactileReading,
    joint_name,
)
from graspd.drivers.recordings.kinds import SQLITE, ZSTD, Kind, Unpacked, is_packed, kind_of
from graspd.drivers.recordings.player import ReadingsDriver, within_limits

TACTILE: Final = "sr_robot_msgs/msg/BiotacAll"
SENSOR: Final = "sr_robot_msgs/msg/Biotac"
JOINTS: Final = "sensor_msgs/msg/JointState"
HANDS: Final = ("rh", "lh")
"""First part of a topic, and of the names of joints; the right hand is preferred."""
DEFINITIONS: Final = {
    TACTILE: "std_msgs/Header header\nsr_robot_msgs/Biotac[5] tactiles\n",
    SENSOR: ("int16 pac0\nint16 pac1\nint16 pdc\nint16 tac\nint16 tdc\nint16[] electrodes\n"),
}
"""Definitions of Shadow's messages, for bags that do not hold them."""
LOOKED_AT: Final = 20
"""Number of messages from which it is decided which fingers have a sensor."""
REPEAT_NS: Final = 1_000_000_000
"""A step back in time, ns, below which a message is a repeated one; else the clock was set."""
CHUNK_MAX_BYTES: Final = 256 << 20
"""Largest unpacked chunk, bytes; `rosbag record` ends one at 768 KiB, not within a message."""

_UNPACKERS: Final[dict[Callable[[bytes], bytes], Callable[[], Any]]] = {
    bz2.decompress: bz2.BZ2Decompressor,
    lz4.frame.decompress: lz4.frame.LZ4FrameDecompressor,
}
"""Bounded unpackers, by the unbounded function of rosbags that each replaces."""
_zstd: Final[Any] = vars(rosbag2.reader)["zstd"]
_DAMAGE = (
    *(
        _zstd.ZstdError,
        rosbag1.ReaderError,
        rosbag2.ReaderError,
        SerdeError,
        TypesysError,
        apsw.Error,
    ),
    *(ValueError, LookupError, AssertionError, RuntimeError, struct.error),
    *(TypeError, OSError, EOFError, MemoryError, OverflowError),
)
"""Exceptions of the library for a damaged bag."""
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class BagCounters(DriverCounters):
    """Counters of a replay."""

    repeats: int = 0
    """Messages with the counts of the one before, or its time or up to 1 s less; dropped."""
    malformed: int = 0
    """Messages without five sensors that each have 24 electrodes or none; dropped."""


class BagDriver(ReadingsDriver[Reading]):
    """Play the bags of one run, at most one reading per call of `read_ready`."""

    def reset(self) -> None:
        super().reset()
        self.counters = BagCounters()
        self._rows = [list[str](FINGERS).index(finger) for finger in self._fingers]
        self._last: NDArray[np.int64] | None = None
        self._old = 0
        """Messages of the time of the one before, or of an earlier time."""

    def open(self) -> None:
        """Check that each bag has the fingers to play, then start. Raises `RecordingError`."""
        self.close()
        self.reset()
        for path in self.paths:
            found = fingers_of(path)
            missing = [finger for finger in self._fingers if finger not in found]
            if missing:
                raise RecordingError(
                    path, f"has no sensor on {', '.join(missing)}, only on {', '.join(found)}"
                )
        self.start(self._items())

    def read_ready(self) -> Sequence[Reading]:
        """Return the next reading, alone, if it is due. Raises `RecordingError`."""
        taken = self.take()
        if taken is None:
            return ()
        at_ns, reading = taken
        if isinstance(reading, TactileReading):
            self.counters.faulty_readings += bool(reading.faults.any())
        return [self.hand_over(reading, at_ns)]

    def _items(self) -> Generator[tuple[int, Reading], None, None]:
        topic: str | None = None
        for path in self.paths:
            with _opened(path) as bag:
                topic = topic or bag.tactile.topic
                if bag.tactile.topic != topic:
                    problem = f"has {bag.tactile.topic}, {self.paths[0]} {topic}: replay each alone"
                    raise RecordingError(path, problem)
                for t_ns, message in bag.messages():
                    reading = self._reading_of(path, t_ns, message)
                    if reading is not None:
                        yield t_ns, reading
        if self._old > self.counters.readings:
            problem = "%s: the header of %d of %d messages has no newer stamp than the one before"
            of = self._old + self.counters.readings
            _log.warning(problem, self.paths[0], self._old, of)

    def _reading_of(self, path: Path, t_ns: int, message: Any) -> Reading | None:  # noqa: ANN401
        if not hasattr(message, "tactiles"):
            return _joints(t_ns, message)
        sensors = sensors_of(path, message)
        if sensors is None:
            self.counters.malformed += 1
            return None
        last_ns, values = self._last_ns, sensors[self._rows]
        if last_ns is not None and 0 <= last_ns - t_ns < REPEAT_NS:
            self.counters.repeats += 1
            self._old += 1
            return None
        if self._last is not None and np.array_equal(values, self._last):
            self.counters.repeats += 1
            return None
        self.follow(t_ns)
        self._last = values
        wrong = (values < 0) | (values > COUNT_MAX)
        faults = wrong * np.uint8(ElectrodeFault.NOT_A_COUNT)
        counts = np.where(wrong, 0, values).astype(np.uint16)
        self.counters.readings += 1
        return TactileReading(t_ns, self.counters.readings - 1, counts, faults)


class _Bag:
    """An open bag: the topics chosen from it, `tactile` and `joints` or None, and its messages."""

    def __init__(self, path: Path, reader: Any, *, is_ros1: bool) -> None:  # noqa: ANN401
        self._path, self._reader = path, reader
        store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
        types = dict[str, Any]()
        for name, definition in DEFINITIONS.items():
            types |= get_types_from_msg(definition, name)
        for connection in reader.connections:
            if connection.msgdef.format is MessageDefinitionFormat.MSG:
                types |= get_types_from_msg(connection.msgdef.data, connection.msgtype)
        store.register({name: each for name, each in types.items() if name not in store.fielddefs})
        _refuse_other_fields(
            path, dict(store.fielddefs[TACTILE][1]), dict(store.fielddefs[SENSOR][1])
        )
        self._decode = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
        tactile = self._choose(TACTILE)
        if tactile is None:
            topics = ", ".join(sorted({each.topic for each in reader.connections})) or "no topic"
            raise RecordingError(path, f"has no topic of sr_robot_msgs/BiotacAll, but {topics}")
        self.tactile = tactile
        hand = tactile.topic.strip("/").partition("/")[0]
        self._others = tuple(f"{other}_" for other in HANDS if hand in HANDS and other != hand)
        """Prefixes of the names of another hand's joints."""
        self.joints = self._choose(JOINTS)

    def _choose(self, kind: str) -> Connection | None:
        """Return the connection of this message type; None if the bag has none.

        It is that of `/joint_states`, else of the right hand's topic, else of the shortest name.
        """
        found = [each for each in self._reader.connections if each.msgtype == kind]
        found.sort(key=lambda each: (not each.topic.startswith("/rh/"), len(each.topic)))
        if kind == JOINTS:
            found.sort(key=lambda each: each.topic != "/joint_states")
        for other in found:
            if other.topic != found[0].topic:
                _log.warning("%s: %s is left out", self._path, other.topic)
        return found[0] if found else None

    def messages(self) -> Iterator[tuple[int, Any]]:
        """Yield time, ns, and message of both topics, in the order of the bag.

        The time is the header's, or the bag's if that is 0. Raises `RecordingError` for damage, and
        for a time that is too late.
        """
        read = {(each.topic, each.msgtype) for each in (self.tactile, self.joints) if each}
        everything = self._reader.connections
        chosen = [each for each in everything if (each.topic, each.msgtype) in read]
        try:
            for connection, bag_ns, content in self._reader.messages(connections=chosen):
                if content[: len(ZSTD)] == ZSTD:  # only the folder's metadata says so
                    problem = "its messages are packed (zstd), each alone: give the bag's folder"
                    raise RecordingError(self._path, problem)
                message: Any = self._decode(content, connection.msgtype)
                stamp = message.header.stamp
                t_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
                if connection.msgtype == JOINTS:
                    message.name = [
                        "" if name.lower().startswith(self._others) else name
                        for name in message.name
                    ]
                yield within_limits(self._path, t_ns or bag_ns), message
        except _DAMAGE as error:
            raise RecordingError(self._path, f"is damaged: {error}") from error


@contextmanager
def _opened(path: Path) -> Iterator[_Bag]:
    is_ros1 = kind_of(path) is Kind.ROS1_BAG
    if is_packed(path):
        raise RecordingError(path, "is a packed bag: `gunzip` it first")
    try:
        reader = rosbag1.Reader(path) if is_ros1 else _reader_of(path)
        reader.open()
        if isinstance(reader, rosbag1.Reader):
            _bound(reader)
    except _DAMAGE as error:
        advice = "; `rosbag reindex` may mend it" if is_ros1 else ""
        raise RecordingError(path, f"cannot be read: {error}{advice}") from error
    try:
        try:
            bag = _Bag(path, reader, is_ros1=is_ros1)
        except (TypesysError, AssertionError, SyntaxError) as error:
            raise RecordingError(path, f"has a wrong message definition: {error}") from error
        yield bag
    finally:
        reader.close()


def _reader_of(path: Path) -> Any:  # noqa: ANN401
    """Return a reader of a ROS 2 bag by its content; rosbags itself goes by the file's suffix."""
    if path.is_dir():
        return rosbag2.Reader(path)
    with path.open("rb") as file:
        suffix = ".db3" if file.read(len(SQLITE)) == SQLITE else ".mcap"
    return rosbag2.Reader.STORAGE_PLUGINS[suffix](path)


def _bound(reader: rosbag1.Reader) -> None:
    """Make the reader raise for a chunk that unpacks to more than `CHUNK_MAX_BYTES`."""
    for place, chunk in reader.chunks.items():
        if chunk.decompressor in _UNPACKERS:
            unpack = partial(_unpacked, _UNPACKERS[chunk.decompressor])
            reader.chunks[place] = chunk._replace(decompressor=unpack)


def _unpacked(make: Callable[[], Any], packed: bytes) -> bytes:
    unpacker = make()
    content: bytes = unpacker.decompress(packed, CHUNK_MAX_BYTES)
    if not unpacker.eof:
        raise ValueError(f"a chunk is cut off or unpacks to more than {CHUNK_MAX_BYTES} bytes")
    return content


def _bound_ros2() -> None:
    """Make rosbags unpack ROS 2 bags by functions with a limit, in place of its own."""
    bounded = SimpleNamespace(**vars(_zstd))
    bounded.decompress = partial(_unpacked, _zstd.ZstdDecompressor)
    bounded.open = lambda file, _mode: Unpacked(file, _zstd.open(file))
    vars(rosbag2.reader)["zstd"] = vars(rosbag2.storage_mcap)["zstd"] = bounded
    lz4_unpack = partial(_unpacked, lz4.frame.LZ4FrameDecompressor)
    vars(rosbag2.storage_mcap)["lz4_decompress"] = lz4_unpack


_bound_ros2()


def _refuse_other_fields(path: Path, hand: dict[str, Any], sensor: dict[str, Any]) -> None:
    """Raise `RecordingError` if BiotacAll (`hand`) or Biotac (`sensor`) lacks a field to read."""
    header = Nodetype.NAME, "std_msgs/msg/Header"
    if hand.get("header") != header or _element(hand.get("tactiles")) != SENSOR:
        problem = "has a sr_robot_msgs/BiotacAll without header or list of tactiles"
        raise RecordingError(path, problem)
    if "int" not in _element(sensor.get("electrodes")):
        problem = "has a sr_robot_msgs/Biotac without whole numbers of electrodes"
        raise RecordingError(path, problem)


def _element(field: Any) -> str:  # noqa: ANN401
    """Return the type of a list's elements; empty if the field is not a list."""
    if field is None or field[0] not in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return ""
    _, ((kind, name), _) = field
    return str(name[0] if kind is Nodetype.BASE else name)


def sensors_of(path: Path, message: Any) -> NDArray[np.int64] | None:  # noqa: ANN401
    """Return the electrodes' values in a message, shape (5, 24), in the order of `FINGERS`.

    A sensor without electrodes (absent) is a row of 0. None if the message is malformed.
    Raises `RecordingError` for the former BioTac, which has 19 electrodes.
    """
    electrodes = [
        each.electrodes if len(each.electrodes) else np.zeros(ELECTRODES)
        for each in message.tactiles
    ]
    if any(len(each) == FORMER_ELECTRODES for each in electrodes):
        problem = f"is of a BioTac with {FORMER_ELECTRODES} electrodes; an SP has {ELECTRODES}"
        raise RecordingError(path, problem)
    if [len(each) for each in electrodes] != [ELECTRODES] * len(FINGERS):
        return None
    return np.array(electrodes, dtype=np.int64)


def fingers_of(path: Path) -> tuple[Finger, ...]:
    """Return the fingers whose sensor is present in most of the first `LOOKED_AT` messages.

    An absent sensor has no values, or at least half of them at a rail: 0 or below, 4095 or above.
    Raises `RecordingError` if no finger has a sensor.
    """
    seen = np.zeros(len(FINGERS), dtype=np.intp)
    number = 0
    with _opened(path) as bag:
        for _, message in bag.messages():
            sensors = sensors_of(path, message) if hasattr(message, "tactiles") else None
            if sensors is None:
                continue
            good = (sensors > 0) & (sensors < COUNT_MAX)
            seen += np.count_nonzero(good, axis=1) > ELECTRODES // 2
            number += 1
            if number == LOOKED_AT:
                break
    if not number:
        raise RecordingError(path, "has no message with five sensors of 24 electrodes")
    fingers = tuple(compress(FINGERS, seen > number // 2))
    if not fingers:
        raise RecordingError(path, f"has no sensor with counts in 1..{COUNT_MAX - 1}")
    return fingers


def has_joints(path: Path) -> bool:
    """Return True if the bag has messages of joint states, whatever joints they name."""
    with _opened(path) as bag:
        return bag.joints is not None and bag.joints.msgcount > 0


def _joints(t_ns: int, message: Any) -> JointReading | None:  # noqa: ANN401
    """Return the angles of a hand's joints in a message; None: it has none."""
    angles: dict[str, float] = {}
    for name, angle in zip(message.name, message.position, strict=False):
        if joint := joint_name(name.upper().removeprefix("RH_").removeprefix("LH_")):
            # `rh_FFJ3` and `lh_FFJ3` are one joint with two angles, of which neither is trusted.
            angles[joint] = math.nan if joint in angles else float(angle)
    if not angles:
        return None
    position_rad = np.array(list(angles.values()))
    return JointReading(t_ns, 0, tuple(angles), position_rad)
