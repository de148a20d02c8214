"""Common parts of all drivers: readings, the driver interface, exceptions, counters."""

from __future__ import annotations

import errno
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, IntFlag, auto
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES

JOINTS = (
    *(f"{finger}J{joint}" for finger in ("FF", "MF", "RF") for joint in (1, 2, 3, 4)),
    *("LFJ1", "LFJ2", "LFJ3", "LFJ4", "LFJ5", "THJ1", "THJ2", "THJ3", "THJ4", "THJ5"),
    *("WRJ1", "WRJ2", "FFJ0", "MFJ0", "RFJ0", "LFJ0"),
)
"""Joints of the Shadow hand: 24 with sensors, then J0, the sum of J1 and J2, of four fingers."""
ANGLE_MAX_RAD = math.radians(200)
"""Largest angle, rad: J0, the sum of two joints, reaches 180 degrees. More is another unit."""


def joint_name(name: str) -> str | None:
    """Return the joint of a message's name (`rh_FFJ3` gives `FFJ3`); None if it names no joint."""
    name = name[3:] if name.startswith(("rh_", "lh_")) else name
    return name if name in JOINTS else None


def sensor_rows(fingers: Sequence[str], sensors: Sequence[str] | None) -> tuple[int, ...]:
    """Return, for each of `fingers`, the number of its sensor at the device, from 0.

    `sensors`: all fingers in the order of the device; None: the same as `fingers`. Raises
    `ValueError` if one of `fingers` is not among them.
    """
    return tuple((sensors or fingers).index(finger) for finger in fingers)


class ElectrodeFault(IntFlag):
    """Faults of one electrode of one reading. Zero: a fresh 12-bit count."""

    NONE = 0
    MISSING = 1
    """No sample of this electrode arrived in this reading, or no sensor drove the line."""
    NOT_A_COUNT = 2
    """The value is not an integer in 0..4095."""
    PARITY = 4
    """A byte of the word has even parity, or has a bit set that must be 0 (manual figure 15)."""
    ERROR_WORD = 8
    """The sensor answered with an error word instead of data (manual table 8)."""
    HELD = 16
    """The value repeats an earlier sweep; nothing new was sampled."""
    CUT_OFF = 32
    """The row is the last of a file and has no line end, so its values may be cut off."""


@dataclass(frozen=True, slots=True)
class Annotation:
    """Place of a reading in a table or stream, and its labels. Never used for judging."""

    source: Path
    line: int
    """Line of the file, from 1."""
    object_name: str | None = None
    slipped: bool | None = None
    """How the lift ended: True slip, False stable, None not recorded."""


class TactileReading(msgspec.Struct, frozen=True, eq=False, gc=False):
    """One sweep over all electrodes of all fingers of a hand."""

    t_ns: int
    """Monotonic time, ns, of the end of the sweep, or of its last byte's arrival if unknown."""
    seq: int
    """Number of the reading; one more per reading that the sensor made. A gap is a loss."""
    counts: NDArray[np.uint16]
    """Shape (fingers, 24), raw counts 0..4095, meaningless where `faults` is not zero."""
    faults: NDArray[np.uint8]
    """Shape (fingers, 24), `ElectrodeFault` bits per electrode."""
    annotation: Annotation | None = None
    recorded_ns: int | None = None
    """Time since the recording's zero, ns, whatever the speed of playing; None: a live reading."""
    interrupted: bool = False
    """True if the reading does not continue the last one: its sender restarted or was lost."""

    @property
    def made_ns(self) -> int:
        """Time, ns, for intervals between readings: `recorded_ns`, or else `t_ns`. Not for ages."""
        return self.t_ns if self.recorded_ns is None else self.recorded_ns

    def __post_init__(self) -> None:
        """Raise `ValueError` for wrong shapes, which are a bug in the driver."""
        if self.counts.ndim != 2 or self.counts.shape[1] != ELECTRODES:
            raise ValueError(f"counts have shape {self.counts.shape}, not (fingers, {ELECTRODES})")
        if self.faults.shape != self.counts.shape:
            raise ValueError(f"faults {self.faults.shape} do not fit counts {self.counts.shape}")


class JointReading(msgspec.Struct, frozen=True, eq=False, gc=False):
    """Joint angles of a hand at one time. Fields are as in `TactileReading`; `seq` is 0 in bags."""

    t_ns: int
    seq: int
    names: tuple[str, ...]
    """Joint names without hand prefix, such as `FFJ3`."""
    position_rad: NDArray[np.float64]
    """Shape (joints,), radians; NaN where a joint has no valid angle."""
    recorded_ns: int | None = None
    interrupted: bool = False

    @property
    def made_ns(self) -> int:
        return self.t_ns if self.recorded_ns is None else self.recorded_ns


Reading = TactileReading | JointReading


@dataclass(slots=True)
class DriverCounters:
    """Counts since `open`. A driver adds its own fields by subclassing."""

    readings: int = 0
    """Readings handed over, valid or not."""
    faulty_readings: int = 0
    """Readings handed over with at least one electrode fault."""
    missed_readings: int = 0
    """Readings that never arrived, by the sensor's own sequence."""

    def as_dict(self) -> dict[str, int]:
        return {name: getattr(self, name) for name in self.__dataclass_fields__}


class LinkCause(Enum):
    """Cause of a link that is not up. Programs compare this, never the text."""

    UNKNOWN = auto()
    """The link was not tried yet, or only the text names the cause."""
    NOT_FOUND = auto()
    DENIED = auto()
    IN_USE = auto()
    NO_INTERFACE = auto()
    """The network interface or device does not exist."""
    INTERFACE_DOWN = auto()
    NO_ADDRESS = auto()
    """The address to listen on is not one of this computer."""
    BUS_OFF = auto()
    SILENT = auto()
    """The port is open, but nothing valid has arrived yet."""
    NO_ANSWER = auto()
    FOREIGN = auto()
    """Data arrives only from a sender that is refused."""
    TIMEOUT = auto()
    """The link was given up because nothing valid arrived within its timeout."""
    DISCONNECTED = auto()
    """The device went away or was reset."""
    VERSION = auto()
    SETTINGS = auto()
    """The device's sensors, samples or rate do not fit the scene, or have changed."""
    SERIALS = auto()
    """The device's serial numbers have changed, or differ each time it is asked."""
    CLOCK = auto()
    """The device's clock stands still, goes back or jumps."""


_CAUSES: dict[int | None, LinkCause] = {
    errno.ENOENT: LinkCause.NOT_FOUND,
    errno.EACCES: LinkCause.DENIED,
    errno.EAGAIN: LinkCause.IN_USE,  # the port is locked
    errno.EBUSY: LinkCause.IN_USE,
    errno.EADDRINUSE: LinkCause.IN_USE,
    errno.ENODEV: LinkCause.NO_INTERFACE,
    errno.ENXIO: LinkCause.NO_INTERFACE,
    errno.ENETDOWN: LinkCause.INTERFACE_DOWN,
    errno.EADDRNOTAVAIL: LinkCause.NO_ADDRESS,
}


class DeviceFault(Enum):
    """Faults of a device whose link is up. Programs compare these, never the text."""

    OLD_FIRMWARE = auto()
    NO_SENSOR = auto()
    SENSOR_ABSENT = auto()
    SENSOR_TWICE = auto()
    """One serial number is read at two chip selects."""
    SENSOR_WORDS = auto()
    """Words from a sensor reached the device damaged."""
    SWEEP_TOO_LONG = auto()
    BUS_ERROR = auto()
    SEQUENCE = auto()
    """The device samples other channels than the scene says."""


class Fact(NamedTuple):
    """One fact about a device: a text for people, and the fault that it shows, if any."""

    text: str
    fault: LinkCause | DeviceFault | None = None


class Opened(ABC):
    """Base of context managers: `with` calls `open`, and `close` at the end."""

    @abstractmethod
    def open(self) -> None:
        """Take the device."""

    @abstractmethod
    def close(self) -> None:
        """Release the device."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()


class Driver(Protocol):
    """A source of readings for the service loop.

    The loop calls `read_ready` when `fileno` is readable or when `due_ns` has passed. No method
    blocks. `close` may be called more than once.
    """

    @property
    def name(self) -> str:
        """Short name for logs and status, such as `replay`."""

    @property
    def counters(self) -> DriverCounters:
        """Counters since `open`."""

    @property
    def exhausted(self) -> bool:
        """True when a recording has ended or failed; always False for live links."""

    @property
    def live(self) -> bool:
        """True for a sensor, False for a recording."""

    @property
    def period_ns(self) -> int | None:
        """Nominal time between tactile readings, ns; None: not known yet."""

    @property
    def serials(self) -> dict[str, str]:
        """Serial numbers of the sensors by finger; a link without any gives its sender's address.

        A new number means that the sensor was exchanged. Between the readings of two sensors,
        `read_ready` returns nothing once. Fingers whose number is unknown are left out.
        """

    def describe(self) -> dict[str, Fact]:
        """Return facts about the device by name: versions, serials, why a link is down.

        Live links have the fact `link`; its fault is None while the link is up.
        """

    def open(self) -> None:
        """Take the device. Raises `DriverError`."""

    def close(self) -> None:
        """Release everything that `open` took."""

    def fileno(self) -> int | None:
        """Return the descriptor to wait on, or None if there is none now."""

    def due_ns(self) -> int | None:
        """Return when to call `read_ready` without input, monotonic ns; None: never."""

    def read_ready(self) -> Sequence[Reading]:
        """Return the readings that are complete now, oldest first. Raises `DriverError`."""


class DriverError(Exception):
    """Base of all driver failures."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle text and fields, so that a process pool can raise the error in its parent."""
        return type(self).__new__, (type(self), *self.args), self.__dict__


class LinkError(DriverError):
    """The device does not answer or went away; a later try may succeed."""

    def __init__(self, cause: LinkCause, text: str, endpoint: str | None = None) -> None:
        """`text` is for people. `cause` and `endpoint`, the address, are for programs."""
        super().__init__(text)
        self.cause = cause
        self.endpoint = endpoint

    @classmethod
    def from_errno(cls, error: BaseException, text: str, endpoint: str | None = None) -> LinkError:
        """Return an error whose `cause` is by the `errno` of `error` or of an error behind it.

        Without a known `errno` it is `UNKNOWN`.
        """
        reason: BaseException | None = error
        while reason is not None:
            cause = _CAUSES.get(getattr(reason, "errno", None))
            if cause is not None:
                return cls(cause, text, endpoint)
            reason = reason.__cause__ or reason.__context__
        return cls(LinkCause.UNKNOWN, text, endpoint)


class RecordingError(DriverError):
    """A recording cannot be read or has the wrong content; no later try can succeed."""

    def __init__(
        self, path: Path, problem: str, *, line: int | None = None, column: str | None = None
    ) -> None:
        place = str(path)
        if line is not None:
            place += f", line {line}"
        if column is not None:
            place += f", column {column}"
        super().__init__(f"{place}: {problem}")
        self.path = path
