"""Save and restore the judge's state, so that a replay can start in the middle of a run.

Each part of the judge has a dataclass `memory` with everything that readings change in it.
"""

from __future__ import annotations

import zlib
from dataclasses import fields, is_dataclass
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from graspd.daemon.judge.pipeline import Pipeline

MAX_BYTES: Final = 1 << 20  # before it is compressed; three fingers take 80 kB
KINDS: Final = {np.dtype(kind).str: np.dtype(kind) for kind in ("u1", "u2", "i8", "f4", "f8", "?")}


def remember(pipeline: Pipeline) -> bytes:
    """Return the state of a judge without its session, after it has learnt from ended grasps."""
    pipeline.learn()
    return _packed(pipeline.memories())


def encode(memory: bytes) -> bytes:
    """Return the compressed result of `remember`, for `recall`; about 25 kB."""
    return zlib.compress(memory)


def recall(pipeline: Pipeline, data: bytes, *, same_model: bool) -> None:
    """Restore the state of a judge that has judged nothing yet; `data`: from `encode`.

    With another model or gate, the verdict of the current grasp is discarded. Raises `ValueError`,
    and changes nothing, if `data` is no such state, or is one of other fingers.
    """
    own = pipeline.memories()
    try:
        plain = zlib.decompressobj().decompress(data, MAX_BYTES)
        known = msgspec.msgpack.decode(plain, type=dict[str, dict[str, msgspec.Raw]])
        recalled = [
            (part, _part(known[group][name], part))
            for group, parts in own.items()
            if group in known or group == "judge"
            for name, part in parts.items()
        ]
    except (zlib.error, msgspec.DecodeError, KeyError) as error:
        raise ValueError(f"is no memory of a judge: {error}") from error
    for part, memory in recalled:
        for each in fields(part):
            setattr(part, each.name, getattr(memory, each.name))
    if not same_model or ("hand" in known) != ("hand" in own):
        pipeline.restart()


def _part(raw: msgspec.Raw, own: Any) -> Any:  # noqa: ANN401 (each part has a memory of its own)
    """Return the memory of a part as it was written, checked against the one that it has now."""
    memory = msgspec.msgpack.decode(raw, type=type(own), dec_hook=_array)
    if _packed(memory) != bytes(raw):
        raise ValueError("holds what this graspd does not write")
    if _shape(memory) != _shape(own):
        raise ValueError("an array of another shape than this hand's")
    return memory


def _shape(value: object) -> object:
    """Return types and shapes of all arrays, and the number of fingers."""
    if isinstance(value, np.ndarray):
        return value.dtype, value.shape
    if is_dataclass(value):
        return [_shape(getattr(value, each.name)) for each in fields(value)]
    return [_shape(each) for each in value if is_dataclass(each)] if isinstance(value, list) else 0


def _packed(memory: object) -> bytes:
    def flat(array: Any) -> tuple[str, tuple[int, ...], bytes]:  # noqa: ANN401
        return array.dtype.str, array.shape, array.tobytes()

    return msgspec.msgpack.encode(memory, enc_hook=flat)


def _array(_kind: type, flat: Any) -> NDArray[Any]:  # noqa: ANN401 (whatever stands there)
    name, shape, data = flat  # what does not fit raises what msgspec takes for that
    return np.frombuffer(data, KINDS.get(name, np.dtype(np.void))).reshape(shape).copy()
