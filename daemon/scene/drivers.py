"""Sections of a scene that name a driver: `[tactile]` and `[joints]`."""

# Without postponed annotations: pydantic would evaluate each of them at every start.

import ipaddress
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
)

from graspd.drivers.base import COUNT_MAX, ELECTRODES
from graspd.models.contract import Finger

StrOrPath = TypeVar("StrOrPath", str, Path)


def unit(symbol: str = "-") -> Any:  # noqa: ANN401 - as pydantic's `Field`
    """Name the unit of a number in the schema; `-` where it has none."""
    return Field(json_schema_extra={"unit": symbol})


def _without_nul(value: StrOrPath) -> StrOrPath:
    if "\0" in str(value):
        raise ValueError("has a NUL character")
    return value


def _ip_address(address: str) -> str:
    ipaddress.ip_address(address)
    return address


def _beside_the_scene(path: Path, info: ValidationInfo) -> Path:
    base: Path = (info.context or {}).get("base", Path())
    return base / path


Probability = Annotated[float, Field(ge=0.0, le=1.0), unit()]
Name = Annotated[str, Field(min_length=1), AfterValidator(_without_nul)]
Address = Annotated[str, AfterValidator(_ip_address)]
FilePath = Annotated[
    Path, Field(strict=False), AfterValidator(_without_nul), AfterValidator(_beside_the_scene)
]
"""A path, relative to the folder of the scene file. TOML has no paths: a string is taken."""


class Section(BaseModel):
    """Base of all sections: no unknown keys, no silent conversion, nothing changes later."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        allow_inf_nan=False,
        validate_default=True,
        use_attribute_docstrings=True,
    )


class ReplayFaultsSection(Section):
    """`[tactile.faults]`: break the replayed sensor on purpose, to test what listens to graspd."""

    off_from: Annotated[int, Field(ge=0), unit("readings")] | None = None
    """From this reading on nothing comes; unless given, all come."""
    stuck_from: Annotated[int, Field(ge=1), unit("readings")] | None = None
    """From this reading on the counts are those of the reading before it; unless given, never."""
    garbage_probability: Probability = 0.0
    """Chance per reading that the counts are random 16-bit values."""
    wrong_counts: Annotated[int, Field(ge=-COUNT_MAX, le=COUNT_MAX), unit("counts")] = 0
    """Constant offset added to the counts."""
    slow_every: Annotated[int, Field(ge=1), unit("readings")] = 1
    """Only every n-th reading arrives."""
    delayed_s: Annotated[float, Field(ge=0.0, le=3600.0), unit("s")] = 0.0
    """Readings arrive this much late."""
    intermittent_probability: Probability = 0.0
    """Chance that a reading is lost."""
    fingers: Annotated[tuple[Finger, ...], Field(min_length=1, strict=False)] | None = None
    """Fingers that stuck, garbage and wrong apply to; all unless given."""
    electrodes: (
        Annotated[
            tuple[Annotated[int, Field(ge=1, le=ELECTRODES), unit()], ...],
            Field(min_length=1, strict=False),
        ]
        | None
    ) = None
    """Electrodes 1..24 that stuck, garbage and wrong apply to; all unless given."""
    seed: Annotated[int, Field(ge=0), unit()] = 0
    """Of the chance: the same seed breaks the same readings."""


class ReplayTactile(Section):
    """`[tactile]` with `driver = "replay"`: recorded CSV files instead of sensors."""

    driver: Literal["replay"]
    """Makes this section one of this driver."""
    recordings: Annotated[tuple[FilePath, ...], Field(min_length=1, strict=False)]
    """Grasp tables or streams (deploy/RECORDING.md), played one after the other."""
    pace: Literal["realtime", "fast"] = "realtime"
    """`fast`: as fast as they can be judged."""
    speed: Annotated[float, Field(ge=1e-3, le=1e3), unit()] = 1.0
    """Factor on real time: 2 plays twice as fast. Not with pace `fast`."""
    rate_hz: Annotated[float, Field(ge=1e-3, le=1e5), unit("1/s")] = 100.0
    """Readings per second of a grasp table, which has no times of its own."""
    loop: bool = False
    """Begin again at the end, for ever."""
    outcomes: bool = False
    """Tell the recorded outcome of each lift that the verdict allows, as a controller would."""
    strict: bool = False
    """Stop at the first value that is not a 12-bit count."""
    faults: ReplayFaultsSection = ReplayFaultsSection()
    """`[tactile.faults]`."""


class SpiTactile(Section):
    """`[tactile]` with `driver = "spi"`: a bridge on a serial line (deploy/bridge/PROTOCOL.md)."""

    driver: Literal["spi"]
    """Makes this section one of this driver."""
    port: Name
    """Serial port, best by its name in `/dev/serial/by-id/`, or a pyserial URL."""
    sensors: (
        Annotated[tuple[Finger, ...], Field(min_length=1, max_length=5, strict=False)] | None
    ) = None
    """Fingers in the order of the chip selects; `hand.fingers` unless given."""
    baud: Annotated[int, Field(ge=115_200, le=12_000_000), unit("bit/s")] = 921_600
    """Line rate; USB CDC ignores it."""


class CanTactile(Section):
    """`[tactile]` with `driver = "can"`: sensors behind a CAN board (deploy/can/PROTOCOL.md)."""

    driver: Literal["can"]
    """Makes this section one of this driver."""
    interface: Name = "socketcan"
    """Name of a python-can interface."""
    channel: Name = "can0"
    """Name of the bus at that interface, as `ip link` lists it for socketcan."""
    sensors: (
        Annotated[tuple[Finger, ...], Field(min_length=1, max_length=3, strict=False)] | None
    ) = None
    """Fingers in the order of the board's words (`syntouch`); `hand.fingers` unless given."""
    format: Literal["syntouch", "sweep_fd"] = "syntouch"
    """SynTouch's frame per sample, or graspd's CAN FD frame per sweep and finger."""
    arbitration_id: Annotated[int, Field(ge=0, le=0x1FFF_FFFF), unit()] | None = None
    """Of the samples, or of finger `ff` of the sweep frames. With `syntouch`, where it is not
    documented, every frame of the right form is taken unless given."""
    sequence: Literal["electrodes", "all", "interleaved"] = "interleaved"
    """Order in which the board samples (`syntouch` only)."""
    data_length: Annotated[int, Field(ge=3, le=8), unit("bytes")] | None = None
    """Length of a sample frame, where the board pads it."""
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000), unit("bit/s")] | None = None
    """Rate of the bus; not with socketcan, where it belongs to `ip link`."""
    data_bitrate: Annotated[int, Field(ge=10_000, le=8_000_000), unit("bit/s")] | None = None
    """Rate of the data phase of CAN FD; not with socketcan."""


class PalmTactile(Section):
    """`[tactile]` with `driver = "palm"`: status packets of the hand's palm."""

    driver: Literal["palm"]
    """Makes this section one of this driver."""
    source: Name
    """`udp://ADDRESS:PORT` to listen on, or a file of packets, relative to the scene file."""
    only_from: Address | None = None
    """IP address of the relay, if packets of no other may be heard."""
    heed_finger_bits: bool = True
    """False for a palm that does not set the bits which say that a finger's data is valid."""

    @field_validator("source")
    @classmethod
    def _file_beside_the_scene(cls, source: str, info: ValidationInfo) -> str:
        return source if "://" in source else str(_beside_the_scene(Path(source), info))


Tactile = Annotated[
    ReplayTactile | SpiTactile | CanTactile | PalmTactile, Field(discriminator="driver")
]
"""Section of each tactile driver, told apart by its key `driver`."""


class PalmJoints(Section):
    """`[joints]` with `driver = "palm"`: Hall sensors in the palm's packets."""

    driver: Literal["palm"]
    """Makes this section one of this driver."""
    calibration: FilePath
    """The hand's calibration (TOML, as deploy/calibration/example_hand.toml)."""


class StreamJoints(Section):
    """`[joints]` with `driver = "stream"`: joint angles from elsewhere (deploy/wire/JOINTS.md)."""

    driver: Literal["stream"]
    """Makes this section one of this driver."""
    source: Annotated[str, Field(pattern=r"^udp://"), AfterValidator(_without_nul)]
    """`udp://ADDRESS:PORT` to listen on."""
    only_from: Address | None = None
    """IP address of the sender, if messages of no other may be heard."""


Joints = Annotated[PalmJoints | StreamJoints, Field(discriminator="driver")]
"""Section of each source of joint angles, told apart by its key `driver`."""
