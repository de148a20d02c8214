"""The scene: one TOML file that says what this hand has and how to judge with it."""

from __future__ import annotations

import difflib
import ipaddress
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import ErrorDetails

from models.contract import Finger

Probability = Annotated[float, Field(ge=0.0, le=1.0)]
FilePath = Annotated[Path, Field(strict=False)]
"""TOML has no paths: a string is taken."""

IPC_PATH_MAX_BYTES = 107
"""Longest path of a Unix socket on Linux (sun_path, less the closing NUL)."""


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
    wrong_counts: int = 0
    """Constant offset added to the counts."""
    slow_every: Annotated[int, Field(ge=1)] = 1
    """Only every n-th reading arrives."""
    delayed_s: Annotated[float, Field(ge=0.0, le=3600.0)] = 0.0
    """Readings arrive this much late, s."""
    intermittent_probability: Probability = 0.0
    """Chance that a reading is lost."""
    fingers: Annotated[tuple[Finger, ...], Field(strict=False)] | None = None
    """Fingers that stuck, garbage and wrong apply to; all unless given."""
    electrodes: (
        Annotated[tuple[Annotated[int, Field(ge=1, le=24)], ...], Field(strict=False)] | None
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


Tactile = ReplayTactile
"""Section of each tactile driver, told apart by its key `driver`."""


class Model(Section):
    """`[model]`: which network judges."""

    name: str | None = None
    """A model of the zoo; `cnn1` when neither name nor path is given."""
    path: FilePath | None = None
    """A model file of your own, relative to the scene file."""
    slip_threshold: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.5
    """`p_slip` from here on is slip."""

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
    model: Model = Model()
    gate: Gate = Gate()
    publish: Publish = Publish()

    @model_validator(mode="after")
    def _faults_are_of_this_hand(self) -> Self:
        for finger in self.tactile.faults.fingers or ():
            if finger not in self.hand.fingers:
                raise ValueError(f"tactile.faults.fingers names {finger}, which the hand lacks")
        return self

    @property
    def endpoint(self) -> str:
        """Where verdicts are published."""
        return self.publish.endpoint or f"ipc:///run/graspd/{self.hand.name}.ipc"

    @property
    def max_age_ns(self) -> int:
        """Age limit of a reading, ns."""
        return round(self.gate.max_age_ms * 1e6)


def check_endpoint(endpoint: str) -> None:
    """Raise ValueError unless ZeroMQ can bind here and only this computer can connect."""
    scheme, separator, address = endpoint.partition("://")
    if not separator or scheme not in {"ipc", "tcp"}:
        raise ValueError("must start with ipc:// or tcp://")
    if scheme == "ipc":
        if not address or len(address.encode()) > IPC_PATH_MAX_BYTES:
            raise ValueError(f"needs a path of 1 to {IPC_PATH_MAX_BYTES} bytes after ipc://")
        return
    host, separator, port = address.rpartition(":")
    if not separator or not port.isascii() or not port.isdigit() or not 0 < int(port) < 65536:
        raise ValueError("needs a port of 1 to 65535, as in tcp://127.0.0.1:5555")
    try:
        loopback = ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        raise ValueError(f"needs an IP address, not '{host}'") from None
    if not loopback:
        raise ValueError(f"{host} is not a loopback address; anyone could listen")


def load(path: Path) -> Scene:
    """Read a scene file. Raises `SceneError`, whose text has one line per mistake."""
    try:
        text = path.read_bytes().decode()
    except OSError as error:
        raise SceneError(f"{path}: cannot read the scene: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: not a text file (byte {error.start} is not UTF-8)") from error
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"{path}: not TOML: {error}") from error
    return parse(data, path)


def parse(data: Mapping[str, Any], path: Path) -> Scene:
    """Check the content of a scene file at `path`. Raises `SceneError`."""
    try:
        return Scene.model_validate(data, context={"base": path.parent})
    except ValidationError as error:
        mistakes = error.errors(include_url=False)
        inner = {
            mistake["loc"][:depth] for mistake in mistakes for depth in range(len(mistake["loc"]))
        }
        # A wrong item also makes its list wrong; only the item is worth a line.
        lines = [_line(path, mistake) for mistake in mistakes if mistake["loc"] not in inner]
        raise SceneError("\n".join(lines)) from error


def _line(path: Path, mistake: ErrorDetails) -> str:
    location = tuple(mistake["loc"])
    key = ".".join(str(part) for part in location)
    if mistake["type"] == "extra_forbidden":
        return f"{path}: {key}: no such key{_suggestion(location)}"
    if mistake["type"] == "missing":
        return f"{path}: {key}: is missing"
    message = mistake["msg"].removeprefix("Value error, ").replace("tuple", "list")
    given = mistake["input"]
    shown = "" if isinstance(given, dict | BaseModel) else f" (is {given!r})"
    return f"{path}: {key or 'scene'}: {message[0].lower()}{message[1:]}{shown}"


def _suggestion(location: tuple[int | str, ...]) -> str:
    *parents, wrong = (str(part) for part in location)
    known = list(_keys_of(Scene, parents))
    stem = wrong.rsplit("_", 1)[0]  # `max_age_s` for `max_age_ms`: the unit is the mistake
    close = difflib.get_close_matches(wrong, known, n=1) or [
        name for name in known if name.rsplit("_", 1)[0] == stem
    ]
    return f"; did you mean {close[0]}?" if close else f"; there are: {', '.join(known)}"


def _keys_of(section: type[BaseModel], parents: list[str]) -> Iterator[str]:
    if not parents:
        yield from section.model_fields
        return
    field = section.model_fields.get(parents[0])
    inner = field.annotation if field else None
    if isinstance(inner, type) and issubclass(inner, BaseModel):
        yield from _keys_of(inner, parents[1:])
