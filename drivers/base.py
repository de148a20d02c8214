"""What every driver has in common: readings, the driver interface, exceptions, counters."""

from __future__ import annotations

import errno
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, IntFlag, auto
from pathlib import Path
from typing import NamedTuple, Protocol, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

FINGERS = ("ff", "mf", "rf", "lf", "th")
"""Finger names in the order of the Shadow hand: first, middle, ring, little, thumb."""
ELECTRODES = 24
"""Electrodes of one BioTac SP (manual section 5)."""
COUNT_MAX = 4095
"""Largest 12-bit reading of an electrode (manual section 5.1)."""


def check_fingers(fingers: Sequence[str]) -> None:
    """Raise `ValueError` unless these are one or more different `FINGERS`."""
    if not fingers or len(set(fingers)) != len(fingers) or not set(fingers) <= set(FINGERS):
        raise ValueError(f"fingers {list(fingers)} are not different ones of {list(FINGERS)}")


def sensor_rows(fingers: Sequence[str], sensors: Sequence[str] | None) -> tuple[int, ...]:
    """Return the sensor of a device, from 0, for each of `fingers`. Raises `ValueError`.
    `sensors`: all fingers in the order of the device; None: `fingers`."""
    check_fingers(fingers)
    if sensors is None:
        return tuple(range(len(fingers)))
    check_fingers(sensors)
    if not set(fingers) <= set(sensors):
        raise ValueError(f"fingers {list(fingers)} are not all of {list(sensors)}")
    return tuple(list(sensors).index(finger) for finger in fingers)


class ElectrodeFault(IntFlag):
    """Faults of one electrode of one reading. Zero: a fresh 12-bit count."""

    NONE = 0
    MISSING = 1
    """No sample of this electrode arrived in this reading."""
    NOT_A_COUNT = 2
    """The value is not an integer in 0..4095."""
    PARITY = 4
    """A byte of the response word has even parity (manual figure 15)."""
    ERROR_WORD = 8
    """The sensor answered with an error word instead of data (manual table 8)."""
    HELD = 16
    """The value repeats an earlier sweep: nothing new was sampled."""
    CUT_OFF = 32
    """The record ends in the middle, so its values may be cut off."""


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
    """Monotonic time, ns, when the last byte of the reading was received."""
    seq: int
    """Counts up by one per reading that the sensor made; a gap is a loss."""
    counts: NDArray[np.uint16]
    """Shape (fingers, 24), raw counts 0..4095, meaningless where `faults` is not zero."""
    faults: NDArray[np.uint8]
    """Shape (fingers, 24), `ElectrodeFault` bits per electrode."""
    annotation: Annotation | None = None
    recorded_ns: int | None = None
    """Recordings only, which may be played at any speed: time since the recording's zero, ns."""

    @property
    def made_ns(self) -> int:
        """Time when the sensor made it, ns, for intervals. `t_ns` is for age."""
        return self.t_ns if self.recorded_ns is None else self.recorded_ns

    def __post_init__(self) -> None:
        """Check the shapes: another one is a bug in the driver."""
        if self.counts.ndim != 2 or self.counts.shape[1] != ELECTRODES:
            raise ValueError(f"counts have shape {self.counts.shape}, not (fingers, {ELECTRODES})")
        if self.faults.shape != self.counts.shape:
            raise ValueError(f"faults {self.faults.shape} do not fit counts {self.counts.shape}")


class JointReading(msgspec.Struct, frozen=True, eq=False, gc=False):
    """Joint angles of a hand at one time."""

    t_ns: int
    """Monotonic time, ns, when the last byte of the reading was received."""
    seq: int
    names: tuple[str, ...]
    """Joint names without hand prefix, such as `FFJ3`."""
    position_rad: NDArray[np.float64]
    """Shape (joints,), radians; NaN where a joint has no valid angle."""
    recorded_ns: int | None = None
    """See `TactileReading.recorded_ns`."""

    @property
    def made_ns(self) -> int:
        """See `TactileReading.made_ns`."""
        return self.t_ns if self.recorded_ns is None else self.recorded_ns


Reading = TactileReading | JointReading


@dataclass(slots=True)
class DriverCounters:
    """Counts since `open`. A driver adds its own fields by subclassing."""

    readings: int = 0
    """Readings handed over, valid or not."""
    faulty_readings: int = 0
    """Of these, readings with at least one electrode fault."""
    missed_readings: int = 0
    """Readings that the sensor made (by its sequence) and that never arrived."""

    def as_dict(self) -> dict[str, int]:
        """Return all counters by name."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}


class LinkCause(Enum):
    """Cause of a link that is not up, for programs."""

    UNKNOWN = auto()
    """Not tried yet, or known from the text alone."""
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
    """The port is open, and nothing has come yet."""
    NO_ANSWER = auto()
    TIMEOUT = auto()
    """Readings came, and then none for too long."""
    DISCONNECTED = auto()
    """The device went away or was reset."""
    VERSION = auto()
    SETTINGS = auto()
    """The device does not sample what the scene needs, or has changed what it samples."""
    SERIALS = auto()
    """The device names other serial numbers each time."""


_CAUSES: dict[int | None, LinkCause] = {
    errno.ENOENT: LinkCause.NOT_FOUND,
    errno.EACCES: LinkCause.DENIED,
    errno.EAGAIN: LinkCause.IN_USE,  # of a lock
    errno.EBUSY: LinkCause.IN_USE,
    errno.EADDRINUSE: LinkCause.IN_USE,
    errno.ENODEV: LinkCause.NO_INTERFACE,
    errno.ENXIO: LinkCause.NO_INTERFACE,
    errno.ENETDOWN: LinkCause.INTERFACE_DOWN,
    errno.EADDRNOTAVAIL: LinkCause.NO_ADDRESS,
}


class DeviceFault(Enum):
    """Faults of a device whose link is up, for programs."""

    OLD_FIRMWARE = auto()
    NO_SENSOR = auto()
    SENSOR_ABSENT = auto()
    SENSOR_TWICE = auto()
    """One sensor answers in two places."""
    SENSOR_WORDS = auto()
    """Words between a sensor and the device were damaged."""
    SWEEP_TOO_LONG = auto()
    CLOCK_NOT_TRUSTED = auto()
    BUS_ERROR = auto()


class Fact(NamedTuple):
    """One fact about a device: a text for people, and its fault."""

    text: str
    fault: LinkCause | DeviceFault | None = None


class Opened(ABC):
    """A context manager: `with` opens it, and closes it at the end."""

    @abstractmethod
    def open(self) -> None:
        """Take the device."""

    @abstractmethod
    def close(self) -> None:
        """Release it."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()


class Driver(Protocol):
    """A source of readings that the service loop waits on.

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
        """True when a recording has ended. False for live links."""

    @property
    def live(self) -> bool:
        """True if readings come when the sensor makes them, False for recordings."""

    @property
    def period_ns(self) -> int | None:
        """Nominal time between tactile readings, ns, or None while it is not known."""

    @property
    def serials(self) -> dict[str, str]:
        """Known serial numbers of the sensors by finger, or the sender if a link has none.
        Another number is another sensor; between the two, `read_ready` returns nothing once."""

    def describe(self) -> dict[str, Fact]:
        """Return facts about the device by name: versions, serials, why a link is down.
        Live links have the fact `link`, whose fault is None while it is up."""

    def open(self) -> None:
        """Take the device. Raises `DriverError`."""

    def close(self) -> None:
        """Release everything that `open` took."""

    def fileno(self) -> int | None:
        """Descriptor to wait on, or None while there is none."""

    def due_ns(self) -> int | None:
        """Monotonic time, ns, to call `read_ready` even if nothing has come, or None."""

    def read_ready(self) -> Sequence[Reading]:
        """Return the readings that are complete now, oldest first. Raises `DriverError`."""


class DriverError(Exception):
    """Base of all driver failures."""


class LinkError(DriverError):
    """The device does not answer or went away: try again later."""

    def __init__(self, cause: LinkCause, text: str, endpoint: str | None = None) -> None:
        """`cause` and `endpoint`, if the link has one, are for programs, `text` for people."""
        super().__init__(text)
        self.cause = cause
        self.endpoint = endpoint

    @classmethod
    def from_errno(cls, error: BaseException, text: str, endpoint: str | None = None) -> LinkError:
        """Take the cause from the `errno` of `error`, or of the errors that led to it."""
        reason: BaseException | None = error
        while reason is not None:
            cause = _CAUSES.get(getattr(reason, "errno", None))
            if cause is not None:
                return cls(cause, text, endpoint)
            reason = reason.__cause__ or reason.__context__
        return cls(LinkCause.UNKNOWN, text, endpoint)


class RecordingError(DriverError):
    """A recording has the wrong content: give up."""

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
        self.line = line
        self.column = column
