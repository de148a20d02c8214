"""The scene: one TOML file that describes a hand, and how to judge its grasps."""

# Without postponed annotations, as in `graspd.daemon.scene.drivers`.
import codecs
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, ValidationError, field_validator, model_validator

from graspd.biotac import TABLE_FINGERS, Finger
from graspd.daemon.judge.decision import GateLimits, Limits
from graspd.daemon.process.files import SceneError, read_regular
from graspd.daemon.process.text import printable
from graspd.daemon.scene.drivers import (
    CanTactile,
    FilePath,
    Fingers,
    Joints,
    Name,
    PalmJoints,
    PalmTactile,
    ReplayTactile,
    Section,
    SpiTactile,
    Tactile,
    UdpSection,
    unit,
)
from graspd.daemon.scene.endpoints import check_endpoint, clash, is_private
from graspd.drivers import toml

SCENE_MAX_BYTES = 128 << 10
"""Largest scene file, bytes; one that names a thousand recordings has 100 kB."""

STATE_DIRECTORY = Path("/var/lib/graspd")
"""Folder for the state of a service (file-hierarchy(7))."""


class Hand(Section):
    """`[hand]`: name of the hand, and its fingers with a BioTac SP."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9_-]{1,32}$")] = "right"
    """Name in the topics and in the default socket."""
    fingers: Fingers = TABLE_FINGERS
    """Fingers with a sensor, in the order of the model."""

    @field_validator("fingers")
    @classmethod
    def _no_finger_twice(cls, fingers: tuple[Finger, ...]) -> tuple[Finger, ...]:
        if len(set(fingers)) != len(fingers):
            raise ValueError("names a finger twice")
        return fingers


class Model(Section):
    """`[model]`: the network that judges, and its thresholds."""

    name: Name | None = None
    """Model that `graspd models` lists; without name and path `small-session`."""
    path: FilePath | None = None
    """Model file of your own."""
    slip_threshold: Annotated[float, Field(gt=0.0, lt=1.0), unit()] = Limits.slip_threshold
    """Smallest `p_slip` of a slip."""
    min_confidence: Annotated[float, Field(ge=0.0, lt=1.0), unit()] = Limits.min_confidence
    """Smallest `p_slip` of a slip, and 1 - `p_slip` of `stable`; below it the verdict is
    `unknown`."""

    @model_validator(mode="after")
    def _one_of_name_and_path(self) -> Self:
        if self.name is not None and self.path is not None:
            raise ValueError("give either name or path, not both")
        return self


class SessionSection(Section):
    """`[session]`: calibration of a session model by its grasps."""

    keep: bool | None = None
    """True: keep sessions on the disk. Without it only those of live sensors are kept."""
    learn: bool = True
    """True: judged grasps calibrate the session."""
    required: bool = False
    """True: the verdict is `unknown` until the session is calibrated."""
    folder: FilePath | None = None
    """Without it `/var/lib/graspd/<hand>.session`."""


class RiskSection(Section):
    """`[risk]`: limit of the share of slips among `stable` lifts, kept by the outcomes told.

    Without this section there is no such limit.
    """

    max_slip_when_stable: Annotated[float, Field(ge=0.001, le=0.5), unit()] = 0.05
    """Largest share of the `stable` lifts that may slip."""
    warm_up: Annotated[int, Field(ge=0, le=1000), unit("outcomes")] = 50
    """Outcomes until which each grasp that is not `stable` is to be lifted supervised."""
    explore: Annotated[float, Field(ge=0.0, le=1.0), unit()] = 0.05
    """Share of the grasps that are not `stable` to lift supervised after that."""
    outstanding_max: Annotated[int, Field(ge=1, le=100), unit("lifts")] = 5
    """Number of announced lifts without outcome from which no other grasp is `stable`."""


class Learn(Section):
    """`[learn]`: learning from the outcomes of lifts."""

    enabled: bool = True
    """True: outcomes change the verdicts of later grasps."""


GateMode = Literal["settled", "every", "request"]
Milliseconds = Annotated[float, Field(gt=0.0, le=10_000.0), unit("ms")]


class GateSection(Section):
    """`[gate]`: the conditions for judging a grasp."""

    mode: GateMode | None = None
    """`settled`: judge a grasp once it has settled; `request`: only if the controller asks, too;
    `every`: each reading is a grasp, in recordings only. Without it `every` for grasp tables, else
    `settled`."""
    max_age_ms: Milliseconds = Limits.max_age_ns / 1e6
    """Largest age of a reading. An older one, or silence, gives `unknown`."""
    fingers: Fingers | None = None
    """Fingers that must touch; without it all of `hand.fingers`."""
    false_alarms: Annotated[float, Field(ge=0.001, le=0.3), unit()] = GateLimits.false_alarms
    """Share of the time in which a settled hand that holds may count as moving. A smaller share
    finds fewer slow slides (deploy/JUDGING.md)."""
    early: bool = GateLimits.early
    """True: judge once nothing moves fast, marked `early`, and again once nothing slides slowly."""
    request_ms: Milliseconds = GateLimits.request_ns / 1e6
    """Time after which a question is answered with `unknown`."""


Endpoint = Annotated[str, AfterValidator(check_endpoint)]
FileMode = Annotated[str, Field(pattern=r"^0?[0-7]{3}$")]
"""Mode of a socket's file, as in chmod; users who may write may connect."""
OTHERS = 0o007
"""Bits of a file's mode for users outside of its owner and group."""


class Publish(Section):
    """`[publish]`: the socket of the verdicts."""

    endpoint: Endpoint | None = None
    """Without it `ipc:///run/graspd/<hand>.ipc`. `tcp://` needs `[curve]`, except on loopback."""
    tactile_hz: Annotated[float, Field(ge=0.0, le=10_000.0), unit("1/s")] = 25.0
    """Rate of readings on `tactile.<hand>`; 0: none; the sensor's rate or more: all."""
    file_mode: FileMode | None = None
    """Mode of an `ipc://` socket's file; users who may write may connect. Without it the umask
    decides."""
    group: Name | None = None
    """Group of an `ipc://` socket's file; without it that of the process."""


class Curve(Section):
    """`[curve]`: keys for `tcp://`; with it all peers need keys (`graspd keys`)."""

    secret_key: FilePath
    """The daemon's own `.key_secret` file, of mode 0600."""
    clients: FilePath
    """Folder with the `.key` files of peers that may connect. No peer may connect while users other
    than root and the daemon's can write there."""


class Ask(Section):
    """`[ask]`: the socket for questions of the grasp controller (deploy/wire/README.md).

    Its file has mode and group of `[publish]`, but only owner and group may ask.
    """

    endpoint: Endpoint | None = None
    """Without it `ipc:///run/graspd/<hand>.ask.ipc`. `tcp://` needs `[curve]`, except on
    loopback."""
    tell: Annotated[tuple[Name, ...], Field(strict=False)] | None = None
    """Users, on `tcp://` names of `.key` files, that may lift and tell outcomes. Without it the
    user or key of the first peer that may lift. They are trusted with the truth."""


Processor = Annotated[int, Field(ge=0, le=8191), unit()]


class Realtime(Section):
    """`[realtime]`: run with realtime priority."""

    priority: Annotated[int, Field(ge=1, le=98), unit()] | None = 50
    """Priority of SCHED_FIFO; below that of the hand's own controller."""
    cpus: Annotated[tuple[Processor, ...], Field(min_length=1, strict=False)] | None = None
    """Processors to run on, from 0; without it all."""


class Record(Section):
    """`[record]`: keep readings, verdicts and outcomes in MCAP files (extra `record`)."""

    directory: FilePath | None = None
    """Folder of the files; without it `/var/lib/graspd/record`."""
    keep_mb: Annotated[float, Field(ge=1.0, le=10_000_000.0), unit("MB")] = 4096.0
    """Largest size of all files of this hand together; at most 1000 recordings."""
    raw: bool = False
    """True: also record the link: CAN frames (candump text) or serial bytes."""

    @property
    def folder(self) -> Path:
        """Folder of the files, with the default."""
        return self.directory or STATE_DIRECTORY / "record"


class Scene(Section):
    """The whole scene file."""

    hand: Hand = Hand()
    tactile: Tactile
    """Source of the readings of the fingers; the keys depend on `driver`."""
    joints: Joints | None = None
    """Source of joint angles; the keys depend on `driver`. Without it none are used."""
    model: Model = Model()
    session: SessionSection = SessionSection()
    learn: Learn = Learn()
    risk: RiskSection | None = None
    gate: GateSection = GateSection()
    publish: Publish = Publish()
    ask: Ask | None = None
    curve: Curve | None = None
    realtime: Realtime | None = None
    record: Record | None = None

    @model_validator(mode="after")
    def _sections_fit_together(self) -> Self:
        tactile, fingers = self.tactile, self.hand.fingers
        for finger in self.gate.fingers or ():
            if finger not in fingers:
                raise ValueError(f"gate.fingers names {finger}, not in hand.fingers")
        if self.gate.mode == "every" and not isinstance(tactile, ReplayTactile):
            raise ValueError(
                "gate.mode every is for grasp tables (tactile.driver replay): of live sensors it "
                'would judge the open hand too; use "settled" or "request"'
            )
        if isinstance(tactile, SpiTactile | CanTactile) and tactile.sensors is not None:
            without = [finger for finger in fingers if finger not in tactile.sensors]
            if without or len(set(tactile.sensors)) != len(tactile.sensors):
                raise ValueError("tactile.sensors must name every finger of hand.fingers once")
        if isinstance(tactile, CanTactile) and len(fingers) > 3:
            raise ValueError("a frame on CAN carries three sensors, hand.fingers has more")
        self._refuse_strangers()
        raw = self.record is not None and self.record.raw
        if raw and not isinstance(tactile, SpiTactile | CanTactile):
            raise ValueError("record.raw is for tactile.driver spi and can")
        if isinstance(self.joints, PalmJoints) and not isinstance(tactile, PalmTactile):
            raise ValueError("joints.driver palm needs tactile.driver palm: it is the same stream")
        if isinstance(tactile, UdpSection) and isinstance(self.joints, UdpSection):
            _refuse_one_port(tactile.source, self.joints.source)
        return self

    def _refuse_strangers(self) -> None:
        endpoints = {
            "publish.endpoint": self.publish.endpoint,
            "ask.endpoint": None if self.ask is None else self.ask.endpoint,
        }
        if self.ask_endpoint is not None and clash(self.endpoint, self.ask_endpoint):
            raise ValueError(
                f"publish.endpoint {self.endpoint} and ask.endpoint {self.ask_endpoint} must differ"
            )
        for key, endpoint in endpoints.items():
            if endpoint is not None and self.curve is None and not is_private(endpoint):
                raise ValueError(
                    f"{key} {endpoint} is not a loopback address; anyone could listen: [curve] "
                    "says who may"
                )
        is_named = (self.ask_endpoint or "").startswith("ipc://") or self.curve is not None
        if self.ask is not None and self.ask.tell is not None and not is_named:
            raise ValueError("ask.tell needs an ipc:// socket, or [curve]: who connects is unknown")

    @property
    def endpoint(self) -> str:
        """Endpoint of the socket for verdicts."""
        return self.publish.endpoint or f"ipc:///run/graspd/{self.hand.name}.ipc"

    @property
    def ask_endpoint(self) -> str | None:
        """Endpoint of the socket for questions; None: peers cannot ask."""
        if self.ask is None and self.gate.mode != "request":
            return None
        endpoint = None if self.ask is None else self.ask.endpoint
        return endpoint or f"ipc:///run/graspd/{self.hand.name}.ask.ipc"

    @property
    def ask_file_mode(self) -> int | None:
        """Mode of the questions' socket file, with no rights for others; None: by the umask."""
        mode = self.publish.file_mode
        return None if mode is None else int(mode, 8) & ~OTHERS

    @property
    def session_path(self) -> Path:
        """Folder of the sessions, also if none are kept."""
        return self.session.folder or STATE_DIRECTORY / f"{self.hand.name}.session"

    @property
    def keeps_session(self) -> bool:
        """True if sessions are kept on the disk."""
        if self.session.keep is None:
            return not isinstance(self.tactile, ReplayTactile)
        return self.session.keep

    @property
    def max_age_ns(self) -> int:
        """Age limit of a reading, ns."""
        return round(self.gate.max_age_ms * 1e6)


def _refuse_one_port(tactile: str, joints: str) -> None:
    """Raise `ValueError` if the two sources, `udp://ADDRESS:PORT`, cannot both be listened on."""
    from graspd.drivers.udp import Endpoint  # only where it is needed

    try:
        ends = Endpoint.parse(tactile), Endpoint.parse(joints)
    except ValueError:
        return  # the driver says what is wrong
    if ends[0].port and clash(*map(str, ends)):  # the kernel chooses another port for each 0
        raise ValueError(
            f"tactile.source {tactile} and joints.source {joints} must have different ports"
        )


def load(path: Path) -> Scene:
    """Read and check a scene file. Raises `SceneError`."""
    try:
        text = read_regular(path, SCENE_MAX_BYTES).decode("utf-8-sig")
    except OSError as error:
        raise SceneError(f"{path}: cannot read the scene: {error.strerror}") from error
    except UnicodeDecodeError as error:
        if error.object.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            raise SceneError(f"{path}: is UTF-16; save it as UTF-8") from error
        raise SceneError(f"{path}: not a text file (byte {error.start} is not UTF-8)") from error
    try:
        data = toml.loads(text)
    except toml.NestedTooDeeplyError as error:
        raise SceneError(f"{path}: not TOML that can be read: {error}") from error
    except ValueError as error:  # TOMLDecodeError, or Python's limit on long numbers
        from graspd.daemon.scene.errors import MESSAGE_MAX

        raise SceneError(f"{path}: not TOML: {printable(str(error), MESSAGE_MAX)}") from error
    return parse(data, path)


def parse(data: Mapping[str, Any], path: Path) -> Scene:
    """Check the content of a scene file at `path`, to whose folder paths in it are relative.

    Raises `SceneError`.
    """
    try:
        return Scene.model_validate(data, context={"base": path.parent})
    except ValidationError as error:
        from graspd.daemon.scene.errors import lines_of

        raise SceneError("\n".join(lines_of(error, Scene, path))) from error
