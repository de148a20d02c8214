"""Bags as a Shadow hand's topics fill them, written by rosbags."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

BIOTAC = "int16 pac0\nint16 pac1\nint16 pdc\n\nint16 tac\nint16 tdc\n\nint16[] electrodes\n"
"""Definition of sr_robot_msgs/msg/Biotac.msg in sr_common."""
BIOTAC_ALL = "Header header\nBiotac[5] tactiles\n"
WITH_ARRAY = BIOTAC.replace("int16 pdc", "int16[] pac\nint16 pdc")
"""Another version of that message, with an array of PAC values."""
ABSENT: NDArray[np.int16] = np.zeros(24, dtype=np.int16)
ORDER = ("ff", "mf", "rf", "lf", "th")


class Sweep(NamedTuple):
    """One message of `/rh/tactile`."""

    t_ns: int
    """Stamp of the header, ns."""
    electrodes: dict[str, NDArray[np.int16]]
    angles: Mapping[str, float] = MappingProxyType({})
    """Angles of a message of `/joint_states` 1 ms earlier; empty: no such message."""
    later_ns: int = 700_000
    """The bag's own time of both messages less their stamps, ns."""


def held(sweeps: list[Sweep], *, same_stamp: bool) -> list[Sweep]:
    """Sweeps of which the fourth and seventh of each seven repeat the one before; `same_stamp`:
    its stamp too."""
    found: list[Sweep] = []
    for number, sweep in enumerate(sweeps):
        if number % 7 in (3, 6):
            sweep = found[-1] if same_stamp else found[-1]._replace(t_ns=sweep.t_ns)
        found.append(sweep)
    return found


class BagOf:
    """Makes messages and bags of one version of ROS. `biotac`: definition of Biotac."""

    def __init__(self, version: int, biotac: str = BIOTAC) -> None:
        self.version = version
        self._has_array = biotac == WITH_ARRAY
        self.store: Typestore = get_typestore(
            Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE
        )
        header = BIOTAC_ALL if version == 1 else f"std_msgs/{BIOTAC_ALL}"
        self.store.register(
            {
                **get_types_from_msg(biotac, "sr_robot_msgs/msg/Biotac"),
                **get_types_from_msg(header, "sr_robot_msgs/msg/BiotacAll"),
            }
        )

    def header(self, t_ns: int) -> Any:  # noqa: ANN401
        time = self.store.types["builtin_interfaces/msg/Time"]
        stamp = time(sec=t_ns // 10**9, nanosec=t_ns % 10**9)
        more = {"seq": 0} if self.version == 1 else {}
        return self.store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="", **more)

    def tactile(self, sweep: Sweep) -> Any:  # noqa: ANN401
        sensor = self.store.types["sr_robot_msgs/msg/Biotac"]
        more: dict[str, Any] = {"pac": np.zeros(22, dtype=np.int16)} if self._has_array else {}
        tactiles = [
            sensor(
                **{"pac0": 2000, "pac1": 2000, "pdc": 2100, "tac": 2000, "tdc": 3000, **more},
                electrodes=sweep.electrodes.get(finger, ABSENT),
            )
            for finger in ORDER
        ]
        everything = self.store.types["sr_robot_msgs/msg/BiotacAll"]
        return everything(header=self.header(sweep.t_ns), tactiles=tactiles)

    def joints(self, t_ns: int, angles: Mapping[str, float]) -> Any:  # noqa: ANN401
        state = self.store.types["sensor_msgs/msg/JointState"]
        nothing = np.zeros(len(angles))
        return state(
            header=self.header(t_ns),
            name=list(angles),
            position=np.array(list(angles.values())),
            velocity=nothing,
            effort=nothing,
        )

    def write(
        self,
        path: Path,
        sweeps: Iterable[Sweep],
        topic: str = "/rh/tactile",
        packing: rosbag1.Writer.CompressionFormat | rosbag2.CompressionMode | None = None,
        **options: Any,  # noqa: ANN401
    ) -> Path:
        """Write a bag and return `path`. `topic`: that of sweeps. `packing`: None for a plain bag.
        `options`: of the writer of ROS 2."""
        if self.version == 1:
            writer: Any = rosbag1.Writer(path)
        else:
            writer = rosbag2.Writer(path, **{"version": 9, **options})
        if packing is not None:
            zstd = () if self.version == 1 else (rosbag2.CompressionFormat.ZSTD,)
            writer.set_compression(packing, *zstd)
        pack = self.store.serialize_ros1 if self.version == 1 else self.store.serialize_cdr
        with writer:
            connections: dict[str, Connection] = {}

            def add(where: str, at_ns: int, message: Any) -> None:  # noqa: ANN401
                kind = message.__msgtype__
                if where not in connections:
                    connections[where] = writer.add_connection(where, kind, typestore=self.store)
                writer.write(connections[where], at_ns, pack(message, kind))

            for sweep in sweeps:
                if sweep.angles:
                    t_ns = sweep.t_ns - 1_000_000
                    add("/joint_states", t_ns + sweep.later_ns, self.joints(t_ns, sweep.angles))
                add(topic, sweep.t_ns + sweep.later_ns, self.tactile(sweep))
        return path
