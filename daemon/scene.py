"""The scene: one TOML file that says what this hand has and how to judge with it."""

from __future__ import annotations

import ipaddress
import os
import stat
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from daemon.endpoint import check_endpoint
from daemon.scene_errors import MESSAGE_MAX, lines_of
from daemon.text import printable
from drivers.base import COUNT_MAX, ELECTRODES
from models.contract import Finger

StrOrPath = TypeVar("StrOrPath", str, Path)


def _without_nul(value: StrOrPath) -> StrOrPath:
    if "\0" in str(value):
        raise ValueError("has a NUL character")
    return value


Probability = Annotated[float, Field(ge=0.0, le=1.0)]
Name = Annotated[str, Field(min_length=1), AfterValidator(_without_nul)]
FilePath = Annotated[Path, Field(strict=False), AfterValidator(_without_nul)]
"""TOML has no paths: a string is taken."""

SCENE_MAX_BYTES = 1 << 20
"""A scene has a kilobyte; a larger file was named by mistake."""


STATE_DIRECTORY = Path("/var/lib/graspd")
"""Where a service keeps its state (file-hierarchy(7))."""


class SceneError(Exception):
    """The scene file is missing or wrong; the message is one line per mistake, naming the key."""


class Section(BaseModel):
    """Base of all sections: no unknown keys, no silent conversion, nothing changes later."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, validate_default=True
    )


class Hand(Section):
    """`[hand]`: which hand, and which of its fingers carry a BioTac SP."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9_-]{1,32}$")] = "right"
    """Part of the topics and of the default socket's name."""
    fingers: Annotated[tuple[Finger, ...], Field(min_length=1, strict=False)] = ("ff", "mf", "th")

    @field_validator("fingers")
    @classmethod
    def _no_finger_twice(cls, fingers: tuple[Finger, ...]) -> tuple[Finger, ...]:
        if len(set(fingers)) != len(fingers):
            raise ValueError("names a finger twice")
        return fingers


class ReplayFaultsSection(Section):
    """`[tactile.faults]`: break the replayed sensor on purpose, to test what listens to graspd."""

    off_from: Annotated[int, Field(ge=0)] | None = None
    """From this reading on nothing comes."""
    stuck_from: Annotated[int, Field(ge=1)] | None = None
    """From this reading on the counts are those of the reading before it."""
    garbage_probability: Probability = 0.0
    """Chance per reading that the counts are random 16-bit values."""
    wrong_counts: Annotated[int, Field(ge=-COUNT_MAX, le=COUNT_MAX)] = 0
    """Constant offset added to the counts."""
    slow_every: Annotated[int, Field(ge=1)] = 1
    """Only every n-th reading arrives."""
    delayed_s: Annotated[float, Field(ge=0.0, le=3600.0)] = 0.0
    """Readings arrive this much late, s."""
    intermittent_probability: Probability = 0.0
    """Chance that a reading is lost."""
    fingers: Annotated[tuple[Finger, ...], Field(min_length=1, strict=False)] | None = None
    """Fingers that stuck, garbage and wrong apply to; all unless given."""
    electrodes: (
        Annotated[
            tuple[Annotated[int, Field(ge=1, le=ELECTRODES)], ...],
            Field(min_length=1, strict=False),
        ]
        | None
    ) = None
    """Electrodes 1..24 that stuck, garbage and wrong apply to; all unless given."""
    seed: Annotated[int, Field(ge=0)] = 0


class ReplayTactile(Section):
    """`[tactile]` with `driver = "replay"`: recorded CSV files instead of sensors."""

    driver: Literal["replay"]
    recordings: Annotated[tuple[FilePath, ...], Field(min_length=1, strict=False)]
    """Grasp tables or streams, relative to the scene file."""
    pace: Literal["realtime", "fast"] = "realtime"
    speed: Annotated[float, Field(ge=1e-3, le=1e3)] = 1.0
    """Factor on real time."""
    rate_hz: Annotated[float, Field(ge=1e-3, le=1e5)] = 100.0
    """Readings per second of a grasp table, which has no times of its own."""
    loop: bool = False
    strict: bool = False
    """Stop at the first value that is not a 12-bit count."""
    faults: ReplayFaultsSection = ReplayFaultsSection()

    @field_validator("recordings")
    @classmethod
    def _beside_the_scene(cls, paths: tuple[Path, ...], info: ValidationInfo) -> tuple[Path, ...]:
        base: Path = (info.context or {}).get("base", Path())
        return tuple(base / path for path in paths)


class SpiTactile(Section):
    """`[tactile]` with `driver = "spi"`: a bridge on a serial line (deploy/bridge/PROTOCOL.md)."""

    driver: Literal["spi"]
    port: Name
    """Serial port, best by its name in `/dev/serial/by-id/`, or a pyserial URL."""
    sensors: (
        Annotated[tuple[Finger, ...], Field(min_length=1, max_length=5, strict=False)] | None
    ) = None
    """Fingers in the order of the chip selects; `hand.fingers` unless given."""
    baud: Annotated[int, Field(ge=115_200, le=12_000_000)] = 921_600
    """Line rate, bit/s; USB CDC ignores it."""


class CanTactile(Section):
    """`[tactile]` with `driver = "can"`: sensors behind a CAN board (deploy/can/PROTOCOL.md)."""

    driver: Literal["can"]
    interface: Name = "socketcan"
    """Name of a python-can interface."""
    channel: Name = "can0"
    sensors: (
        Annotated[tuple[Finger, ...], Field(min_length=1, max_length=3, strict=False)] | None
    ) = None
    """Fingers in the order of the board's words (`syntouch`); `hand.fingers` unless given."""
    format: Literal["syntouch", "sweep_fd"] = "syntouch"
    """SynTouch's frame per sample, or graspd's CAN FD frame per sweep and finger."""
    arbitration_id: Annotated[int, Field(ge=0, le=0x1FFF_FFFF)] | None = None
    """Of the samples, or of finger `ff` of the sweep frames. With `syntouch`, where it is not
    documented, every frame of the right form is taken unless given."""
    sequence: Literal["electrodes", "all", "interleaved"] = "interleaved"
    """Order in which the board samples (`syntouch` only)."""
    data_length: Annotated[int, Field(ge=3, le=8)] | None = None
    """Bytes of a sample frame, where the board pads it."""
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] | None = None
    """Bit/s; not with socketcan, where it belongs to `ip link`."""
    data_bitrate: Annotated[int, Field(ge=10_000, le=8_000_000)] | None = None
    """Bit/s of the data phase of CAN FD; not with socketcan."""


class PalmTactile(Section):
    """`[tactile]` with `driver = "palm"`: status packets of the hand's palm."""

    driver: Literal["palm"]
    source: Name
    """`udp://ADDRESS:PORT` to listen on, or a file of packets, relative to the scene file."""
    only_from: str | None = None
    """IP address of the relay, if packets of no other may be heard."""
    heed_finger_bits: bool = True
    """False for a palm that does not set the bits which say that a finger's data is valid."""

    @field_validator("source")
    @classmethod
    def _file_beside_the_scene(cls, source: str, info: ValidationInfo) -> str:
        base: Path = (info.context or {}).get("base", Path())
        return source if "://" in source else str(base / source)

    @field_validator("only_from")
    @classmethod
    def _is_an_address(cls, address: str | None) -> str | None:
        if address is not None:
            ipaddress.ip_address(address)
        return address


Tactile = Annotated[
    ReplayTactile | SpiTactile | CanTactile | PalmTactile, Field(discriminator="driver")
]
"""Section of each tactile driver, told apart by its key `driver`."""


class PalmJoints(Section):
    """`[joints]` with `driver = "palm"`: Hall sensors in the palm's packets."""

    driver: Literal["palm"]
    calibration: FilePath
    """The hand's calibration (TOML), relative to the scene file."""

    @field_validator("calibration")
    @classmethod
    def _beside_the_scene(cls, path: Path, info: ValidationInfo) -> Path:
        base: Path = (info.context or {}).get("base", Path())
        return base / path


class StreamJoints(Section):
    """`[joints]` with `driver = "stream"`: joint angles from elsewhere (deploy/wire/JOINTS.md)."""

    driver: Literal["stream"]
    source: Annotated[Name, Field(pattern=r"^udp://")]
    """`udp://ADDRESS:PORT` to listen on."""


Joints = Annotated[PalmJoints | StreamJoints, Field(discriminator="driver")]
"""Section of each source of joint angles, told apart by its key `driver`."""


class Model(Section):
    """`[model]`: which network judges."""

    name: Name | None = None
    """A model of the zoo; `small-session` when neither name nor path is given."""
    path: FilePath | None = None
    """A model file of your own, relative to the scene file."""
    slip_threshold: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.5
    """`p_slip` from here on is slip."""
    min_accuracy: Annotated[float, Field(gt=0.5, lt=1.0)] | None = None
    """Verdicts must be right this often, by the model's card; less sure ones become `unknown`."""

    @field_validator("path")
    @classmethod
    def _beside_the_scene(cls, path: Path | None, info: ValidationInfo) -> Path | None:
        base: Path = (info.context or {}).get("base", Path())
        return None if path is None else base / path

    @model_validator(mode="after")
    def _one_of_name_and_path(self) -> Self:
        if self.name is not None and self.path is not None:
            raise ValueError("give either name or path, not both")
        return self


class Session(Section):
    """`[session]`: where a session model keeps what it knows of today's sensors."""

    keep: bool | None = None
    """False: begin a new session at every start, and write nothing. Unless given, kept for live
    sensors and not for recordings."""
    learn: bool | None = None
    """Whether every reading counts as a grasp of the session. Unless given, yes for recordings, and
    no for live sensors: most of their readings are of an open hand, so seed the session instead."""
    file: FilePath | None = None
    """`/var/lib/graspd/<hand>.session.json` unless given; relative to the scene file."""

    @field_validator("file")
    @classmethod
    def _beside_the_scene(cls, path: Path | None, info: ValidationInfo) -> Path | None:
        base: Path = (info.context or {}).get("base", Path())
        return None if path is None else base / path


class Gate(Section):
    """`[gate]`: when a reading may be judged."""

    mode: Literal["every"] = "every"
    """`every`: each reading is a grasp of its own."""
    max_age_ms: Annotated[float, Field(gt=0.0, le=10_000.0)] = 100.0
    """An older reading gives `unknown`; so does silence for that long."""


class Publish(Section):
    """`[publish]`: where verdicts go."""

    endpoint: str | None = None
    """`ipc:///run/graspd/<hand>.ipc` unless given. `tcp://` is for loopback addresses only."""
    high_water_mark: Annotated[int, Field(ge=1, le=100_000)] = 1000
    """Messages kept for a slow subscriber before its oldest are dropped."""

    @field_validator("endpoint")
    @classmethod
    def _endpoint_is_local(cls, endpoint: str | None) -> str | None:
        if endpoint is not None:
            check_endpoint(endpoint)
        return endpoint


class Scene(Section):
    """The whole file."""

    hand: Hand = Hand()
    tactile: Tactile
    joints: Joints | None = None
    model: Model = Model()
    session: Session = Session()
    gate: Gate = Gate()
    publish: Publish = Publish()

    @model_validator(mode="after")
    def _sections_fit_together(self) -> Self:
        tactile, fingers = self.tactile, self.hand.fingers
        if isinstance(tactile, ReplayTactile):
            for finger in tactile.faults.fingers or ():
                if finger not in fingers:
                    raise ValueError(f"tactile.faults.fingers names {finger}, not in hand.fingers")
        if isinstance(tactile, SpiTactile | CanTactile) and tactile.sensors is not None:
            without = [finger for finger in fingers if finger not in tactile.sensors]
            if without or len(set(tactile.sensors)) != len(tactile.sensors):
                raise ValueError("tactile.sensors must name every finger of hand.fingers once")
            if isinstance(tactile, CanTactile) and tactile.format == "sweep_fd":
                raise ValueError("tactile.sensors is for syntouch: frames of sweep_fd say whose")
        if isinstance(tactile, CanTactile) and tactile.format == "syntouch" and len(fingers) > 3:
            raise ValueError("tactile.format syntouch carries three sensors, hand.fingers has more")
        if isinstance(self.joints, PalmJoints) and not isinstance(tactile, PalmTactile):
            raise ValueError("joints.driver palm needs tactile.driver palm: it is the same stream")
        return self

    @property
    def endpoint(self) -> str:
        """Where verdicts are published."""
        return self.publish.endpoint or f"ipc:///run/graspd/{self.hand.name}.ipc"

    @property
    def session_path(self) -> Path:
        """Where the session is kept."""
        return self.session.file or STATE_DIRECTORY / f"{self.hand.name}.session.json"

    @property
    def keeps_session(self) -> bool:
        """Whether the session outlives the daemon."""
        if self.session.keep is None:
            return not isinstance(self.tactile, ReplayTactile)
        return self.session.keep

    @property
    def session_learns(self) -> bool:
        """Whether readings are taken into the session."""
        if self.session.learn is None:
            return isinstance(self.tactile, ReplayTactile)
        return self.session.learn

    @property
    def max_age_ns(self) -> int:
        """Age limit of a reading, ns."""
        return round(self.gate.max_age_ms * 1e6)


def load(path: Path) -> Scene:
    """Read a scene file. Raises `SceneError`, whose text has one line per mistake."""
    try:
        text = _read(path).decode()
    except OSError as error:
        raise SceneError(f"{path}: cannot read the scene: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: not a text file (byte {error.start} is not UTF-8)") from error
    try:
        data = tomllib.loads(text)
    except RecursionError as error:
        raise SceneError(f"{path}: not TOML that can be read: nested too deeply") from error
    except ValueError as error:  # TOMLDecodeError, and Python's own limit on long numbers
        raise SceneError(f"{path}: not TOML: {printable(str(error), MESSAGE_MAX)}") from error
    return parse(data, path)


def _read(path: Path) -> bytes:
    """The content of a regular file of bounded size, without waiting for anything else."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise SceneError(f"{path}: cannot read the scene: not a regular file")
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        content = file.read(SCENE_MAX_BYTES + 1)
    if len(content) > SCENE_MAX_BYTES:
        raise SceneError(f"{path}: larger than {SCENE_MAX_BYTES} bytes, not a scene")
    return content


def parse(data: Mapping[str, Any], path: Path) -> Scene:
    """Check the content of a scene file at `path`. Raises `SceneError`."""
    try:
        return Scene.model_validate(data, context={"base": path.parent})
    except ValidationError as error:
        raise SceneError("\n".join(lines_of(error, Scene, path))) from error
