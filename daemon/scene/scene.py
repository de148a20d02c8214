"""The scene: one TOML file that says what this hand has and how to judge with it."""

# Without postponed annotations, as in `graspd.daemon.scene.drivers`.

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from graspd.daemon.judge.decision import ContactLimits, GateLimits, JointLimits, Limits
from graspd.daemon.process.files import read_regular
from graspd.daemon.process.text import printable
from graspd.daemon.scene.drivers import (
    CanTactile,
    FilePath,
    Joints,
    Name,
    PalmJoints,
    PalmTactile,
    ReplayTactile,
    Section,
    SpiTactile,
    Tactile,
    unit,
)
from graspd.daemon.scene.endpoints import check_endpoint, is_private
from graspd.drivers import toml
from graspd.models.contract import Finger

SCENE_MAX_BYTES = 128 << 10
"""Largest scene file: one that names a thousand recordings has 100 kB."""

STATE_DIRECTORY = Path("/var/lib/graspd")
"""Where a service keeps its state (file-hierarchy(7))."""


class SceneError(Exception):
    """The scene file is missing or wrong; the message is one line per mistake, naming the key."""


class Hand(Section):
    """`[hand]`: which hand, and which of its fingers carry a BioTac SP."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9_-]{1,32}$")] = "right"
    """Part of the topics and of the default socket's name."""
    fingers: Annotated[tuple[Finger, ...], Field(min_length=1, strict=False)] = ("ff", "mf", "th")
    """First, middle, ring, little finger, thumb: those with a sensor, in the order of the model."""

    @field_validator("fingers")
    @classmethod
    def _no_finger_twice(cls, fingers: tuple[Finger, ...]) -> tuple[Finger, ...]:
        if len(set(fingers)) != len(fingers):
            raise ValueError("names a finger twice")
        return fingers


class Model(Section):
    """`[model]`: which network judges."""

    name: Name | None = None
    """A model that ships with graspd or was added by `graspd models add`; `small-session` unless
    name or path is given. A hand of fewer fingers gets its form for these, if there is one."""
    path: FilePath | None = None
    """A model file of your own, relative to the scene file."""
    slip_threshold: Annotated[float, Field(gt=0.0, lt=1.0), unit()] = Limits.slip_threshold
    """`p_slip` from here on is slip."""
    min_confidence: Annotated[float, Field(ge=0.0, lt=1.0), unit()] = Limits.min_confidence
    """Least confidence: `p_slip` of a slip, 1 - `p_slip` of `stable`; below it the verdict is
    `unknown`. How many `stable` ones are right is for `[risk]`."""

    @model_validator(mode="after")
    def _one_of_name_and_path(self) -> Self:
        if self.name is not None and self.path is not None:
            raise ValueError("give either name or path, not both")
        return self


class SessionSection(Section):
    """`[session]`: where a session model keeps what it knows of today's sensors."""

    keep: bool | None = None
    """False: begin a new session at every start, and write nothing. Unless given, kept for live
    sensors and not for recordings."""
    learn: bool = True
    """True: judged grasps calibrate the session."""
    required: bool = False
    """True: verdicts are `unknown` until the session is calibrated."""
    file: FilePath | None = None
    """`/var/lib/graspd/<hand>.session.json` unless given."""


class RiskSection(Section):
    """`[risk]`: how many lifts of `stable` verdicts may slip, by the outcomes that were told.

    Without it there is no such limit.
    """

    max_slip_when_stable: Annotated[float, Field(ge=0.001, le=0.5), unit()] = 0.05
    """Share of the `stable` lifts that may slip."""
    warm_up: Annotated[int, Field(ge=0, le=1000), unit("outcomes")] = 50
    """Number of outcomes in the session before which all grasps are lifted under supervision."""
    explore: Annotated[float, Field(ge=0.0, le=1.0), unit()] = 0.05
    """Share of the grasps that are not `stable` to lift under supervision after that: only their
    outcomes show that the rule is too strict."""
    outstanding_max: Annotated[int, Field(ge=1, le=100), unit("lifts")] = 5
    """Number of lifts, announced by the question `lift`, whose outcome may be out at once. From
    there on nothing is `stable`."""


class Learn(Section):
    """`[learn]`: what outcomes of lifts are used for."""

    enabled: bool = True
    """True: outcomes change the verdicts of later grasps."""


GateMode = Literal["settled", "every", "request"]
Milliseconds = Annotated[float, Field(gt=0.0, le=10_000.0), unit("ms")]


class GateSection(Section):
    """`[gate]`: when a grasp is judged, and when it is refused."""

    mode: GateMode | None = None
    """`settled`: judge a grasp when it has settled; `request`: when the controller asks, too;
    `every`: each reading is a grasp of its own, in recordings only. Unless given, `every` for grasp
    tables, else `settled`."""
    max_age_ms: Milliseconds = Limits.max_age_ns / 1e6
    """An older reading gives `unknown`; silence for that long does, too."""
    sweeps: Annotated[Literal[1, 3], unit("readings")] | None = None
    """`1`: judge a single reading; `3`: each electrode's median of three. Unless given, 3; with
    mode `every`, 1."""
    fingers: Annotated[tuple[Finger, ...], Field(min_length=1, strict=False)] | None = None
    """Fingers that must touch; all of `hand.fingers` unless given."""
    contact_counts: Annotated[float, Field(ge=5, le=1000), unit("counts")] = ContactLimits.counts
    """A finger touches when three electrodes fall this far below their baseline, and
    `contact_sigmas`."""
    contact_sigmas: Annotated[float, Field(ge=3, le=100), unit("sigma")] = ContactLimits.sigmas
    """The same in standard deviations of the finger's noise: both must be reached."""
    false_alarms: Annotated[float, Field(ge=0.001, le=0.3), unit()] = GateLimits.false_alarms
    """Share of the time in which a settled hand that holds may be taken for moving; until it has
    settled the limit is stricter. A smaller share lets more slow slides pass for stillness
    (deploy/JUDGING.md)."""
    early: bool = GateLimits.early
    """True: judge as soon as nothing moves fast, marked `early`, and again when nothing slides
    slowly either."""
    joint_rad_per_s: Annotated[float, Field(ge=0.02, le=10), unit("rad/s")] = JointLimits.rad_per_s
    """A joint that turns faster is moving; only with `[joints]`."""
    joints_lost_ms: Annotated[float, Field(ge=200.0, le=10_000.0), unit("ms")] = (
        JointLimits.lost_ns / 1e6
    )
    """Late joint angles block a verdict no longer than this; only with `[joints]`."""
    request_ms: Milliseconds = GateLimits.request_ns / 1e6
    """A question without a judgement after this time is answered with `unknown`."""
    gap_ms: Milliseconds = GateLimits.gap_ns / 1e6
    """After this long without a usable reading the grasp must settle again. More than two periods
    of the readings."""
    change_counts: Annotated[float, Field(ge=10, le=1000), unit("counts")] = (
        GateLimits.change_counts
    )
    """A finger whose electrodes are this far, in the mean, from where they were judged holds
    another grasp."""


Endpoint = Annotated[str, AfterValidator(check_endpoint)]
FileMode = Annotated[str, Field(pattern=r"^0?[0-7]{3}$")]
"""Mode of a socket's file, as in chmod: users who may write may connect."""
OTHERS = 0o007
"""Bits of a file's mode for users who are neither its owner nor in its group."""


class Publish(Section):
    """`[publish]`: where verdicts go."""

    endpoint: Endpoint | None = None
    """`ipc:///run/graspd/<hand>.ipc` unless given. `tcp://` needs `[curve]`, except on loopback
    addresses."""
    high_water_mark: Annotated[int, Field(ge=1, le=100_000), unit("messages")] = 1000
    """Messages that wait for a slow subscriber; it loses further ones."""
    tactile_hz: Annotated[float, Field(ge=0.0, le=10_000.0), unit("1/s")] = 25.0
    """Readings published a second on `tactile.<hand>`; 0: none; at the sensor's rate or above, all.
    Recordings always have every reading."""
    file_mode: FileMode | None = None
    """Mode of the file of an `ipc://` socket, as in chmod: users who may write may connect. As the
    umask has it unless given."""
    group: Name | None = None
    """Group of the file of an `ipc://` socket; the process's unless given."""


class Curve(Section):
    """`[curve]`: who may connect by `tcp://`; all peers need keys then (`graspd keys`)."""

    secret_key: FilePath
    """The daemon's own `.key_secret` file, of mode 0600."""
    clients: FilePath
    """Folder with the `.key` files of peers that may connect, read again when it changes. If users
    other than root and the daemon's may write there, no peer may connect."""


class Ask(Section):
    """`[ask]`: where the grasp controller asks for a verdict (deploy/wire/README.md)."""

    endpoint: Endpoint | None = None
    """`ipc:///run/graspd/<hand>.ask.ipc` unless given. `tcp://` needs `[curve]`, except on loopback
    addresses."""
    file_mode: FileMode | None = None
    """Mode of the file of an `ipc://` socket: users who may write may ask, and tell outcomes. That
    of `[publish]` unless given, for owner and group only."""
    group: Name | None = None
    """Group of the file of an `ipc://` socket; that of `[publish]` unless given."""


class Realtime(Section):
    """`[realtime]`: run in realtime. Without it the process is an ordinary one."""

    priority: Annotated[int, Field(ge=1, le=98), unit()] | None = 50
    """Priority under SCHED_FIFO; below that of the hand's own controller."""
    cpus: (
        Annotated[tuple[Annotated[int, unit()], ...], Field(min_length=1, strict=False)] | None
    ) = None
    """Processors to run on, numbered from 0; all unless given."""
    lock_memory: bool = True
    """Lock memory that was used (mlockall), so that no reading waits for a disk."""


class Record(Section):
    """`[record]`: keep readings, verdicts and outcomes in MCAP files (extra `record`)."""

    directory: FilePath | None = None
    """`/var/lib/graspd/record` unless given. Created if it is missing."""
    flush_ms: Annotated[float, Field(ge=100.0, le=60_000.0), unit("ms")] = 1000.0
    """Most that a killed daemon or a power cut loses."""
    rotate_mb: Annotated[float, Field(ge=0.1, le=10_000.0), unit("MB")] = 256.0
    """A file that is larger is followed by the next."""
    rotate_minutes: Annotated[float, Field(ge=0.01, le=10_080.0), unit("minutes")] = 60.0
    """A file that is older is followed by the next."""
    keep_files: Annotated[int, Field(ge=1, le=100_000), unit("files")] = 1000
    """Most files of this hand; the oldest are removed."""
    keep_mb: Annotated[float, Field(ge=1.0, le=10_000_000.0), unit("MB")] = 4096.0
    """Most that all files of this hand have together, the one being written included."""
    images_hz: Annotated[float, Field(ge=0.0, le=1000.0), unit("1/s")] = 10.0
    """Tactile images a second, for viewers; 0 draws none. All counts are recorded anyway."""
    raw: bool = False
    """True: also record the link: CAN frames as candump text, serial bytes in frames."""


class Scene(Section):
    """The whole file."""

    hand: Hand = Hand()
    tactile: Tactile
    """Where the readings of the fingers come from; the keys depend on `driver`."""
    joints: Joints | None = None
    """Where joint angles come from; the keys depend on `driver`. Without it none are used."""
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
        self._refuse_strangers()
        raw = self.record is not None and self.record.raw
        if raw and not isinstance(tactile, SpiTactile | CanTactile):
            raise ValueError("record.raw is for tactile.driver spi and can")
        if isinstance(self.joints, PalmJoints) and not isinstance(tactile, PalmTactile):
            raise ValueError("joints.driver palm needs tactile.driver palm: it is the same stream")
        return self

    def _refuse_strangers(self) -> None:
        endpoints = {
            "publish.endpoint": self.publish.endpoint,
            "ask.endpoint": None if self.ask is None else self.ask.endpoint,
        }
        given = [endpoint for endpoint in endpoints.values() if endpoint is not None]
        if len(set(given)) != len(given):
            raise ValueError("publish.endpoint and ask.endpoint must differ")
        for key, endpoint in endpoints.items():
            if endpoint is not None and self.curve is None and not is_private(endpoint):
                raise ValueError(
                    f"{key} {endpoint} is not a loopback address; anyone could listen: [curve] "
                    "says who may"
                )

    @property
    def endpoint(self) -> str:
        """Endpoint where verdicts are published."""
        return self.publish.endpoint or f"ipc:///run/graspd/{self.hand.name}.ipc"

    @property
    def ask_endpoint(self) -> str | None:
        """Endpoint where questions are taken; None: peers cannot ask."""
        if self.ask is None and self.gate.mode != "request":
            return None
        endpoint = None if self.ask is None else self.ask.endpoint
        return endpoint or f"ipc:///run/graspd/{self.hand.name}.ask.ipc"

    @property
    def ask_file_mode(self) -> int | None:
        """Mode of the file of the socket for questions; None: as the umask has it."""
        if self.ask is not None and self.ask.file_mode is not None:
            return int(self.ask.file_mode, 8)
        mode = self.publish.file_mode
        return None if mode is None else int(mode, 8) & ~OTHERS

    @property
    def ask_group(self) -> str | None:
        """Group of that file; None: the process's."""
        own = None if self.ask is None else self.ask.group
        return own or self.publish.group

    @property
    def session_path(self) -> Path:
        """File of the session."""
        return self.session.file or STATE_DIRECTORY / f"{self.hand.name}.session.json"

    @property
    def record_directory(self) -> Path | None:
        """Folder of the recordings; None: the scene does not record."""
        if self.record is None:
            return None
        return self.record.directory or STATE_DIRECTORY / "record"

    @property
    def keeps_session(self) -> bool:
        """True if the session outlives the daemon."""
        if self.session.keep is None:
            return not isinstance(self.tactile, ReplayTactile)
        return self.session.keep

    @property
    def max_age_ns(self) -> int:
        """Age limit of a reading, ns."""
        return round(self.gate.max_age_ms * 1e6)


def load(path: Path) -> Scene:
    """Read a scene file. Raises `SceneError`, whose text has one line per mistake."""
    try:
        text = read_regular(path, SCENE_MAX_BYTES).decode()
    except OSError as error:
        raise SceneError(f"{path}: cannot read the scene: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: not a text file (byte {error.start} is not UTF-8)") from error
    try:
        data = toml.loads(text)
    except toml.NestedTooDeeplyError as error:
        raise SceneError(f"{path}: not TOML that can be read: {error}") from error
    except ValueError as error:  # TOMLDecodeError, and Python's own limit on long numbers
        from graspd.daemon.scene.errors import MESSAGE_MAX

        raise SceneError(f"{path}: not TOML: {printable(str(error), MESSAGE_MAX)}") from error
    return parse(data, path)


def parse(data: Mapping[str, Any], path: Path) -> Scene:
    """Check the content of a scene file at `path`. Raises `SceneError`."""
    try:
        return Scene.model_validate(data, context={"base": path.parent})
    except ValidationError as error:
        from graspd.daemon.scene.errors import lines_of

        raise SceneError("\n".join(lines_of(error, Scene, path))) from error
