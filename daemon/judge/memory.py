"""What a judge knows between two readings, as bytes and back: where it goes on, another one can.

Each class here names the attributes of one part of the judge that readings change, under their own
names: not limits and models, nor changes of the gate that nobody was told yet. Copying is quick,
encoding is not.
"""

from __future__ import annotations

import zlib
from collections import deque
from functools import cache
from typing import Annotated, Any, Final, Self, get_args, get_type_hints

import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon.judge.pipeline import NO_OPINION, Opinion, Pipeline
from daemon.judge.reasons import GateState, Reason

MAX_BYTES: Final = 1 << 20
"""Before it is compressed; three fingers take 37 kB."""

Array = NDArray[Any]
Number = Annotated[int, msgspec.Meta(ge=0, le=1 << 62)]


class _Memory(msgspec.Struct, forbid_unknown_fields=True):
    """Some attributes of an object."""

    @classmethod
    def of(cls, part: Any) -> Self:  # noqa: ANN401 (each class is of a part of its own)
        """As they are now; what changes later does not change this."""
        found = {}
        for name, kind in _fields(cls):
            value = getattr(part, name)
            if kind is None or value is None:
                found[name] = _copied(value)
            elif isinstance(value, list):
                found[name] = [kind.of(each) for each in value]
            else:
                found[name] = kind.of(value)
        return cls(**found)

    def give(self, part: Any) -> None:  # noqa: ANN401
        """Set them. Raises `ValueError` if they cannot be of this object."""
        for name, kind in _fields(type(self)):
            value, former = getattr(self, name), getattr(part, name)
            if kind is None:
                _check(value, former)
                setattr(part, name, _copied(value))
            elif isinstance(value, list):
                for one, memory in zip(former, value, strict=True):
                    memory.give(one)
            elif value is not None and former is not None:
                value.give(former)


class _Health(_Memory):
    _previous: Array
    _number: Number
    _changed: Array
    _jumps: Array
    _has_jumped: bool
    _faults: Array


class _Fresh(_Memory):
    _oldest: Array
    _middle: Array
    _newest: Array
    _last: Array
    _held: Array
    _number: Array
    _all_full: bool
    counts: Array


class _Touch(_Memory):
    threshold: float
    touching: bool
    fall: float
    _depth: float
    _lowest: float
    _let_go_ns: int | None
    _since_ns: int | None
    _alone_since_ns: int | None
    _held_long: bool


class _Tare(_Memory):
    _window: Array
    _usable: Array
    _number: Number
    settled_ns: int | None


class _Contact(_Memory):
    _tares: list[_Tare]
    _touches: list[_Touch]
    _baseline: Array
    _known: Array
    _last_ns: int | None
    touching: Array
    tared: Array

    def give(self, part: Any) -> None:  # noqa: ANN401
        super().give(part)
        for finger, known in enumerate(self._known):
            part._know(finger, known)


class _Stillness(_Memory):
    _times_ns: list[int]
    _sweeps: Array
    _first: Number

    def give(self, part: Any) -> None:  # noqa: ANN401
        if self._first + len(self._times_ns) > len(self._sweeps):
            raise ValueError("the window is longer than what is remembered")
        super().give(part)


class _Gate(_Memory):
    _stillness: _Stillness
    _reference: Array | None
    _last_ns: int | None
    _held_since_ns: int | None
    _released_ns: int
    _asked: bool
    _asked_until_ns: int | None
    state: GateState
    grasp: int
    in_contact: bool
    _against: tuple[Reason, ...]

    def give(self, part: Any) -> None:  # noqa: ANN401
        super().give(part)
        if self._reference is not None:
            _check(self._reference, part._stillness._sweeps[0])


class _Joints(_Memory):
    _past: dict[tuple[str, ...], list[tuple[int, Array]]]
    _latest_ns: dict[tuple[str, ...], int]
    _waits_since_ns: int | None
    _lost: set[str]

    def give(self, part: Any) -> None:  # noqa: ANN401
        for names, past in self._past.items():
            if any(angles.shape != (len(names),) for _, angles in past):
                raise ValueError("as many angles as names are needed")
        if self._past.keys() != self._latest_ns.keys():
            raise ValueError("joints without a time")
        super().give(part)
        from daemon.judge.joint_motion import ANGLES  # only where there are joints

        part._past = {names: deque(past, ANGLES + 2) for names, past in self._past.items()}


class _Grip(_Memory):
    _contact: _Contact
    _fresh: _Fresh
    _gate: _Gate
    _joints: _Joints | None
    _last_ns: int | None
    _unsettled: Number = 0


class JudgeMemory(_Memory):
    """What a `Pipeline` knows, but for its session."""

    _readings: Number
    _learnt_grasp: Number
    _opinion: Opinion
    _health: _Health
    grip: _Grip | None

    @classmethod
    def of(cls, part: Pipeline) -> Self:
        """As it is now, with all that was judged learnt."""
        part.learn()
        return super().of(part)

    def give_judge(self, pipeline: Pipeline, *, same_model: bool) -> None:
        """Let a judge that has judged nothing yet go on from here.

        With another model or gate, what was said of the grasp at hand no longer counts. Raises
        `ValueError`, with the judge half changed, if this is not of these fingers.
        """
        self.give(pipeline)
        grip = pipeline.grip
        if same_model and (self.grip is None) == (grip is None):
            return
        pipeline._opinion, pipeline._learnt_grasp = NO_OPINION, 0
        if grip is not None and grip._last_ns is not None:
            grip._gate.restart(grip._last_ns)


def encode(memory: JudgeMemory) -> bytes:
    """As `decode` wants it; some 15 kB."""
    return zlib.compress(msgspec.msgpack.encode(memory, enc_hook=_flattened))


def decode(data: bytes) -> JudgeMemory:
    """Raises `ValueError` for what is no memory, or that of another graspd."""
    try:
        plain = zlib.decompressobj().decompress(data, MAX_BYTES)
        return msgspec.msgpack.decode(plain, type=JudgeMemory, dec_hook=_shaped)
    except (zlib.error, msgspec.DecodeError) as error:
        raise ValueError(str(error)) from error


def _flattened(value: object) -> tuple[str, tuple[int, ...], bytes]:
    if not isinstance(value, np.ndarray):
        raise NotImplementedError(f"{type(value)} is no part of a memory")
    return value.dtype.str, value.shape, value.tobytes()


def _shaped(_kind: type, flat: Any) -> Array:  # noqa: ANN401 (whatever stands there)
    """Raises `ValueError` or `TypeError`, which msgspec takes for what does not fit."""
    name, shape, data = flat
    return np.frombuffer(data, np.dtype(name)).reshape(shape).copy()


@cache
def _fields(kind: type[_Memory]) -> list[tuple[str, type[_Memory] | None]]:
    """Names of a memory, each with the kind of memory that stands there, or in its list."""
    found: list[tuple[str, type[_Memory] | None]] = []
    for name, hint in get_type_hints(kind).items():
        kinds = [each for each in (hint, *get_args(hint)) if isinstance(each, type)]
        nested = [each for each in kinds if issubclass(each, _Memory)]
        found.append((name, nested[0] if nested else None))
    return found


def _copied(value: Any) -> Any:  # noqa: ANN401
    """So far that the judge, going on, does not change it: it replaces what lies deeper."""
    kind = type(value)
    if kind is np.ndarray or kind is set:
        return value.copy()
    if kind is list or kind is deque:
        return list(value)
    if kind is dict:
        return {key: _copied(each) for key, each in value.items()}
    return value


def _check(value: object, former: object) -> None:
    """Raises `ValueError` for an array of another kind or shape than there is."""
    if not isinstance(former, np.ndarray):
        return
    if not isinstance(value, np.ndarray) or (value.dtype, value.shape) != (
        former.dtype,
        former.shape,
    ):
        raise ValueError("an array of another shape than this hand's")
