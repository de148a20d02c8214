"""Recorded messages without null and tables, and schemas without references, for viewers."""

from __future__ import annotations

from itertools import chain
from typing import Any, Final

import msgspec
from msgspec import inspect

from graspd.drivers.base import ELECTRODES

JsonSchema = dict[str, Any]
TABLE: Final = (
    f"Shape (fingers, {ELECTRODES}), row by row: finger f's electrode e is at "
    f"{ELECTRODES} * f + e - 1, with f from 0 and e from 1."
)
UNKNOWN: Final = "unknown"
"""State of a finger that is not known. A viewer draws the last state on where there is none."""


def flat(value: object) -> object:
    """Return a message without null, each table as one list, row by row."""
    if isinstance(value, dict):
        return {name: _part(name, one) for name, one in value.items() if one is not None}
    if isinstance(value, list) and value and isinstance(value[0], list):
        return list(chain.from_iterable(value))
    return value


def _part(name: str, value: object) -> object:
    if name == "fingers" and isinstance(value, dict):  # of a verdict
        return {finger: UNKNOWN if state is None else state for finger, state in value.items()}
    return flat(value)


def table(values: object) -> object:
    """Return recorded counts by finger, in rows of 24, as older recordings have them."""
    if not isinstance(values, list) or not values or isinstance(values[0], list):
        return values
    return [values[first : first + ELECTRODES] for first in range(0, len(values), ELECTRODES)]


def schema_of(message: type[msgspec.Struct]) -> JsonSchema:
    """Return the schema of flat messages. Raises `TypeError` for a field no viewer can read."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **_schema(inspect.type_info(message)),
    }


def _schema(kind: inspect.Type) -> JsonSchema:
    match kind:
        case inspect.Metadata():
            return {**_schema(kind.type), **(kind.extra_json_schema or {})}
        case inspect.UnionType(types=(inner, inspect.NoneType())):
            return _schema(inner)
        case inspect.StructType():
            return _object(kind)
        case inspect.DictType():
            more = _schema(kind.value_type)
            if isinstance(kind.value_type, inspect.UnionType) and "enum" in more:
                more["enum"] = [*more["enum"], UNKNOWN]
            named = dict.fromkeys(_values(kind.key_type), more)
            return {"type": "object", "properties": named, "additionalProperties": more}
        case inspect.ListType(item_type=inspect.ListType(item_type=count)):
            return {"type": "array", "description": TABLE, "items": _schema(count)}
        case inspect.ListType() | inspect.VarTupleType():
            return {"type": "array", "items": _schema(kind.item_type)}
        case inspect.EnumType() | inspect.LiteralType():
            values = _values(kind)
            plain = "integer" if isinstance(values[0], int) else "string"
            return {"type": plain, "enum": values}
        case inspect.BytesType():
            return {"type": "string", "contentEncoding": "base64"}
        case inspect.BoolType():
            return {"type": "boolean"}
        case inspect.IntType():
            return {"type": "integer"}
        case inspect.FloatType():
            return {"type": "number"}
        case inspect.StrType():
            return {"type": "string"}
    raise TypeError(f"no viewer can read {kind}")


def _object(kind: inspect.StructType) -> JsonSchema:
    required = [
        field.encode_name
        for field in kind.fields
        if field.required and not isinstance(field.type, inspect.UnionType)
    ]
    return {
        "title": kind.cls.__name__,
        "description": (kind.cls.__doc__ or "").strip(),
        "type": "object",
        "properties": {field.encode_name: _schema(field.type) for field in kind.fields},
        "required": required,
    }


def _values(kind: inspect.Type) -> list[Any]:
    """Return the values of an enumeration or a literal, in its order."""
    if isinstance(kind, inspect.EnumType):
        return [member.value for member in kind.cls]
    return list(kind.values) if isinstance(kind, inspect.LiteralType) else []
