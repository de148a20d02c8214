"""Sections of a scene that name a driver: `[tactile]` and `[joints]`."""

# Without postponed annotations, which pydantic would evaluate at every start.
import ipaddress
from abc import ABC, abstractmethod
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo

from graspd.biotac import Finger

StrOrPath = TypeVar("StrOrPath", str, Path)


def unit(symbol: str = "-") -> Any:  # noqa: ANN401 - as pydantic's `Field`
    """Return the field that names a number's unit in the schema; `-`: no unit."""
    return Field(json_schema_extra={"unit": symbol})


def _without_nul(value: StrOrPath) -> StrOrPath:
    if "\0" in str(value):
        raise ValueError("has a NUL character")
    return value


def _ip_address(address: str) -> str:
    ipaddress.ip_address(address)
    return address


def _scalar(value: object) -> object:
    if not isinstance(value, str | bool | int | float):
        raise ValueError("must be a string, a number or a boolean")
    return value


def _beside_the_scene(path: Path, info: ValidationInfo) -> Path:
    base: Path = (info.context or {}).get("base", Path())
    return base / path


Option = Annotated[str | bool | int | float, BeforeValidator(_scalar)]
Fingers = Annotated[tuple[Finger, ...], Field(min_length=1, strict=False)]
Name = Annotated[str, Field(min_length=1), AfterValidator(_without_nul)]
UdpSource = Annotated[str, Field(pattern=r"^udp://"), AfterValidator(_without_nul)]
Address = Annotated[str, AfterValidator(_ip_address)]
FilePath = Annotated[
    Path, Field(strict=False), AfterValidator(_without_nul), AfterValidator(_beside_the_scene)
]
"""A path, written as a string, relative to the folder of the scene file."""


class Section(BaseModel):
    """Base of all sections: frozen, without unknown keys or silent conversion."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        allow_inf_nan=False,
        validate_default=True,
        use_attribute_docstrings=True,
    )


class DeviceKind(Enum):
    """Kind of a device of this computer."""

    SERIAL = "serial"
    SOCKETCAN = "socketcan"
    BUS = "bus"
    """A CAN bus at neither a serial port nor an interface of the kernel."""
    UDP = "udp"


BUS_KINDS: Final = {"slcan": DeviceKind.SERIAL, "socketcan": DeviceKind.SOCKETCAN}
"""Kind of a bus by its python-can interface."""


class Device(NamedTuple):
    """Device of this computer that a driver takes for itself."""

    kind: DeviceKind
    name: str
    """Path or pyserial URL of a port, name of a bus, `udp://ADDRESS:PORT`."""
    keys: str
    """Keys of the section that name the device, as text."""
    part: str = ""
    """Part of the device that the driver takes: a CAN frame id, `None` if not given; empty: all."""
    only_from: str | None = None
    """IP address of the sender over UDP; None: any may send."""


class DriverSection(Section, ABC):
    """Base of the sections that name a driver."""

    @property
    @abstractmethod
    def device(self) -> Device | None:
        """Device that the driver takes for itself; None: it takes none."""


class ReplayTactile(DriverSection):
    """`[tactile]` with `driver = "replay"`: recorded files instead of sensors."""

    driver: Literal["replay"]
    """Selects this driver."""
    recordings: Annotated[tuple[FilePath, ...], Field(min_length=1, strict=False)]
    """Recordings of any kind (deploy/RECORDING.md), in this order."""
    pace: Literal["realtime", "fast"] = "realtime"
    """`realtime`: a grasp table has 100 rows a second; `fast`: as fast as they can be judged."""
    loop: bool = False
    """True: start again at the end."""
    outcomes: bool = False
    """True: tell the recorded outcome of each lift that a verdict allows."""
    read_as: Literal["table", "stream"] | None = None
    """Decides for files that may be either (deploy/RECORDING.md)."""
    rate_hz: Annotated[float, Field(ge=0.001, le=10_000), unit("1/s")] | None = None
    """Rows a second of a stream without times, and of a table as played."""

    @property
    def device(self) -> None:
        """None: it reads files."""


class SpiTactile(DriverSection):
    """`[tactile]` with `driver = "spi"`: a bridge on a serial line (deploy/bridge/PROTOCOL.md)."""

    driver: Literal["spi"]
    """Selects this driver."""
    port: Name
    """Path in `/dev/serial/by-id/`, or a pyserial URL."""
    sensors: Annotated[Fingers, Field(max_length=5)] | None = None
    """Fingers in the order of the chip selects; without it `hand.fingers`."""
    baud: Annotated[int, Field(ge=115_200, le=12_000_000), unit("bit/s")] = 921_600
    """Line rate; ports of USB CDC ignore it."""

    @property
    def device(self) -> Device:
        """Return the serial port, as a `Device`."""
        return Device(DeviceKind.SERIAL, self.port, "port")


class CanTactile(DriverSection):
    """`[tactile]` with `driver = "can"`: sensors behind a CAN board (deploy/can/PROTOCOL.md)."""

    driver: Literal["can"]
    """Selects this driver."""
    interface: Name = "socketcan"
    """Name of a python-can interface."""
    channel: Name = "can0"
    """Name of the bus at that interface."""
    sensors: Annotated[Fingers, Field(max_length=3)] | None = None
    """Fingers in the order of a frame's words; without it `hand.fingers`."""
    arbitration_id: Annotated[int, Field(ge=0, le=0x1FFF_FFFF), unit()] | None = None
    """Id of the samples; without it that of the first sound sample."""
    sequence: Literal["electrodes", "all", "interleaved"] = "interleaved"
    """Order of the samples of a sweep: 24, 28 or 54."""
    data_length: Annotated[int, Field(ge=3, le=8), unit("bytes")] | None = None
    """Length of a frame if the board pads it."""
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000), unit("bit/s")] | None = None
    """Rate of the bus, unless set elsewhere."""
    options: dict[str, Option] = {}
    """More arguments of the interface, as `{ host = "10.0.0.7", port = 29536 }` of socketcand."""

    @property
    def device(self) -> Device:
        """Return the bus, as a `Device`; two drivers can share it if their frames' ids differ."""
        kind = BUS_KINDS.get(self.interface, DeviceKind.BUS)
        part = "" if self.arbitration_id is None else f"{self.arbitration_id:#x}"
        return Device(kind, self.channel, "channel and arbitration_id", part)


class UdpSection(DriverSection):
    """Section of a driver that listens to UDP."""

    source: UdpSource
    """`udp://ADDRESS:PORT` to listen on."""
    only_from: Address | None = None
    """IP address of the sender; without it any may send."""

    @property
    def device(self) -> Device:
        """Return the address that the driver listens on, as a `Device`."""
        return Device(DeviceKind.UDP, self.source, "source", only_from=self.only_from)


class PalmTactile(UdpSection):
    """`[tactile]` with `driver = "palm"`: status packets of the hand's palm."""

    driver: Literal["palm"]
    """Selects this driver."""
    heed_finger_bits: bool = True
    """False for a palm that never sets the bits of valid fingers."""


class DatagramsTactile(UdpSection):
    """`[tactile]` with `driver = "datagrams"`: counts from elsewhere (deploy/wire/TACTILE.md)."""

    driver: Literal["datagrams"]
    """Selects this driver."""


Tactile = Annotated[
    ReplayTactile | SpiTactile | CanTactile | PalmTactile | DatagramsTactile,
    Field(discriminator="driver"),
]
"""Section of a tactile driver; its key `driver` tells which."""


class PalmJoints(DriverSection):
    """`[joints]` with `driver = "palm"`: Hall sensors in the palm's packets."""

    driver: Literal["palm"]
    """Selects this driver."""
    calibration: FilePath
    """Calibration of the hand, as deploy/calibration/example_hand.toml."""

    @property
    def device(self) -> None:
        """None: the tactile driver has the packets."""


class StreamJoints(UdpSection):
    """`[joints]` with `driver = "stream"`: joint angles from elsewhere (deploy/wire/JOINTS.md)."""

    driver: Literal["stream"]
    """Selects this driver."""


Joints = Annotated[PalmJoints | StreamJoints, Field(discriminator="driver")]
"""Section of a source of joint angles; its key `driver` tells which."""
